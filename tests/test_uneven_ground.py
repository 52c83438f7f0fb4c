"""The policy for uneven ground through the whole tick, guards and all: a foot that slips off an edge is no fault."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from walks import Walk

from runtime import policies
from runtime.messages.mode import Mode, Request
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
