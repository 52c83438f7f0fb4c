"""A robot that no step would catch folds its legs while it falls; one that would have caught itself is left alone."""

from __future__ import annotations

import numpy as np
import pytest
from faults.computer import Push
from faults.rig import Rig

from runtime.messages.mode import Mode

BODY = "sim"


def knocked(force: float, believed: bool = True) -> tuple[Rig, float]:
    """A walk after a push to the left, N for 0.2 s, and the body's fastest way down until it landed, m/s."""
    rig = Rig(BODY, 0)
    rig.stand()
    rig.walk_on()
    if not believed:
        rig.cycle.guard.bounds["overreach"] = np.inf
    rig.inject(Push((0.0, force, 0.0), 0.2))
    down = 0.0
    for _ in range(round(2.0 / rig.period)):
        down = max(down, -float(rig.world.truth.linear_velocity[2]))
        rig.tick()
        if rig.world.fallen(np.pi):
            break
    rig.world.close()
    return rig, down


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_robot_that_is_knocked_over_is_low_before_it_lands(side: float) -> None:
    """One that damps when it has tilted falls down faster, and lands with a third more energy or above."""
    slow, fast = [], []
    for force in (500.0, 550.0, 600.0):
        soft, down = knocked(side * force)
        slow.append(down)
        hard, down = knocked(side * force, believed=False)
        fast.append(down)
        assert next(fault.evidence.reason for fault in soft.cycle.faults) == "falling"
        assert "falling" not in [fault.evidence.reason for fault in hard.cycle.faults]
    assert (np.array(slow) < 0.9 * np.array(fast)).all(), (slow, fast)
    assert np.square(slow).sum() < 0.75 * np.square(fast).sum(), (slow, fast)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_push_that_a_step_makes_good_is_left_to_the_walk(side: float) -> None:
    rig, _ = knocked(side * 200.0)
    assert rig.mode is Mode.WALK and not rig.cycle.state.fault
