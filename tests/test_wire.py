"""The robot over its own wires: real drivers, CAN frames over UDP, an IMU on a pseudo-terminal, noise on all of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from twin_walk import WireWalk

from runtime.messages import Mode, Request


@pytest.fixture
def walk(tmp_path: Path) -> Iterator[WireWalk]:
    with WireWalk(tmp_path) as made:
        yield made


def test_it_walks_a_tour_over_the_wires(walk: WireWalk) -> None:
    walk.stand()
    walk.ask(Request.WALK)
    walk.run(1.0, (0.5, 0.0, 0.0))
    assert walk.mean_velocity(1.0, (0.5, 0.0, 0.0)) == pytest.approx((0.5, 0.0, 0.0), abs=0.1)
    walk.run(0.5, (0.0, 0.0, 0.8))
    assert walk.mean_velocity(1.0, (0.0, 0.0, 0.8)) == pytest.approx((0.0, 0.0, 0.8), abs=0.15)
    walk.world.push((0.0, 0.5 * walk.config.robot.mass / 0.1, 0.0), 0.1)
    walk.run(1.0, (0.0, 0.0, 0.0))
    assert walk.mean_velocity(0.5, (0.0, 0.0, 0.0))[:2] == pytest.approx((0.0, 0.0), abs=0.1)
    assert not walk.world.fallen()
    walk.ask(Request.STAND)
    walk.run(1.0)
    walk.ask(Request.SIT)
    walk.run(2.0)
    assert walk.cycle.state.mode is Mode.DAMP
    assert walk.faults == []
    assert walk.motors.counters.missed == 0
    assert walk.imu.counters.lost == walk.imu.counters.restarts == 0
