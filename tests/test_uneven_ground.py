"""The policy for uneven ground through the whole tick, guards and all: a foot that slips off an edge is no fault."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from walks import Walk

from runtime import config as configuration
from runtime import policies
from runtime.messages.mode import Mode, Request
from runtime.reasons import Reason
from sim.scenario import Scenario
from sim.terrain import HeightField
from sim.twin import REAL_NOISE


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Walk]:
    walk = Walk(tmp_path_factory.mktemp("recordings"))
    walk.policy = policies.load(policies.find_policy("trot-rough"), "stoch3")
    yield walk
    walk.world.close()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("amplitude", [0.05, 0.08])
def test_it_walks_on_and_no_guard_damps_it(walk: Walk, amplitude: float, seed: int) -> None:
    ground = HeightField(amplitude, 0.10, seed=seed, extent=24.0)
    walk.set_down(Scenario(seed=seed, noise=REAL_NOISE, terrain=ground))
    walk.stand()
    walk.ask(Request.WALK)
    walk.run(10.0, (0.5, 0.0, 0.0))
    assert walk.cycle.state.mode is Mode.WALK, walk.cycle.state
    assert walk.world.truth.position[0] > 3.5


def test_without_the_moment_that_a_walking_joint_is_given_it_would_be_damped(
    walk: Walk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So the walks above do cross what they are said to cross."""
    strict = configuration.override(walk.config, "test", {"limits.overspeed_time": 0.002})
    monkeypatch.setattr(walk, "config", strict)
    walk.set_down(Scenario(seed=0, noise=REAL_NOISE, terrain=HeightField(0.08, 0.10, seed=0, extent=24.0)))
    walk.stand()
    walk.ask(Request.WALK)
    walk.run(4.0, (0.5, 0.0, 0.0))
    assert (walk.cycle.state.mode, walk.cycle.state.reason) == (Mode.DAMP, Reason.JOINT_SPEED)
