"""The policy for uneven ground through the whole tick, guards and all: a foot that slips off an edge is no fault."""

from __future__ import annotations

from pathlib import Path

import pytest
from walks import Walk

from runtime import policies
from runtime.cycle import Cycle
from runtime.messages.mode import Mode, Request
from sim.scenario import Scenario
from sim.terrain import HeightField
from sim.twin import REAL_NOISE


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("amplitude", [0.05, 0.08])
def test_it_walks_on_and_no_guard_damps_it(tmp_path: Path, amplitude: float, seed: int) -> None:
    walk = Walk(tmp_path)
    ground = HeightField(amplitude, 0.10, seed=seed, extent=24.0)
    walk.policy = policies.load(policies.find_policy("trot-rough"), "stoch3")
    walk.measurement = walk.world.reset(Scenario(seed=seed, noise=REAL_NOISE, terrain=ground))
    walk.cycle = Cycle(walk.config, walk.policy)
    walk.cycle.warm_up(walk.measurement)
    walk.command, walk.index = walk.cycle.sources.damp, 0
    walk.stand()
    walk.ask(Request.WALK)
    walk.run(10.0, (0.5, 0.0, 0.0))
    assert walk.cycle.state.mode is Mode.WALK, walk.cycle.state
    assert walk.world.truth.position[0] > 3.5
    walk.world.close()
