"""A foot that feels the ground always, or never, is found out by its strides; the robot walks on by the schedule."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from walks import Walk

from drivers.robot import LEGS
from runtime.control.records import Clamp
from runtime.messages.mode import Mode, Request
from runtime.reasons import Reason
from sim.scenario import Scenario
from sim.terrain import HeightField
from sim.twin import REAL_NOISE


@pytest.fixture(scope="module")
def only(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Walk]:
    walk = Walk(tmp_path_factory.mktemp("recordings"))
    yield walk
    walk.world.close()


@pytest.fixture
def walk(only: Walk) -> Walk:
    """A robot that walks at 0.5 m/s."""
    only.set_down(Scenario())
    only.stand()
    only.run(0.3)
    only.ask(Request.WALK)
    only.run(1.0, (0.5, 0.0, 0.0))
    return only


def feign(walk: Walk, force: dict[int, float]) -> None:
    """From now on some feet feel so much more force than there is, N: their legs' baselines have gone wrong."""
    baseline = walk.cycle.controller.parameters["contact_baseline"][0]
    baseline[:] = walk.config.control.contact.baseline
    for leg, more in force.items():
        baseline[leg] -= more


def marked(walk: Walk) -> bool:
    return bool(Clamp(int(walk.cycle.tick["clamps"][0])) & Clamp.CONTACT)


def told(walk: Walk) -> list[str]:
    return [event.text for event in walk.recorder.events if event.kind == "contact"]


@pytest.mark.parametrize("force", [80.0, -1000.0], ids=["always", "never"])
@pytest.mark.parametrize("leg", [0, 3])
def test_a_foot_that_lies_is_found_and_the_robot_walks_on(walk: Walk, leg: int, force: float) -> None:
    feign(walk, {leg: force})
    walk.run(1.6, (0.5, 0.0, 0.0))  # three strides and what was left of one
    assert marked(walk) and any(LEGS[leg] in text for text in told(walk)) and len(told(walk)) == 1
    furthest = 0.0
    for _ in range(600):
        walk.run(0.005, (0.5, 0.0, 0.0))
        furthest = max(furthest, float(np.arccos(min(1.0, walk.world.truth.rotation_body_to_world[2, 2]))))
    assert walk.cycle.state.mode is Mode.WALK and furthest < 0.3
    assert abs(walk.world.truth.linear_velocity[0] - 0.5) < 0.25
    assert walk.cycle.clamps[list(Clamp).index(Clamp.CONTACT)] > 500
    feign(walk, {})
    walk.run(3.0, (0.5, 0.0, 0.0))
    assert not marked(walk) and "believed again" in told(walk)[-1]


def test_two_feet_that_lie_end_the_walk(walk: Walk) -> None:
    feign(walk, {0: 80.0, 3: 80.0})
    walk.run(2.4, (0.5, 0.0, 0.0))
    assert walk.cycle.state.fault is Reason.LYING_CONTACTS
    assert walk.cycle.evidence is not None and "FL BR" in walk.cycle.evidence.words
    walk.run(6.0)
    assert walk.cycle.state.mode is Mode.DAMP and walk.cycle.state.reason is Reason.SAT_DOWN


@pytest.mark.parametrize("push", [0.0, 120.0])
def test_nobody_is_suspected_of_a_walk_with_pushes(walk: Walk, push: float) -> None:
    for _ in range(4):
        if push:
            walk.world.push((0.0, push, 0.0), 0.1)
        walk.run(1.0, (0.5, 0.1, 0.4))
        assert not marked(walk)
    assert walk.cycle.clamps[list(Clamp).index(Clamp.CONTACT)] == 0


@pytest.mark.parametrize("seed", range(5))  # with 0 a slipping foot spins its knee beyond 30 rad/s
def test_nobody_is_suspected_of_starts_and_stops_on_rough_ground(only: Walk, seed: int) -> None:
    """Stiff legs share the load as the ground lies, and feet slip off its edges."""
    only.set_down(Scenario(seed=seed, noise=REAL_NOISE, terrain=HeightField(0.03, seed=seed), friction=0.7))
    only.stand()
    for _ in range(4):
        only.ask(Request.WALK)
        only.run(1.0, (0.3, 0.1, 0.4))
        only.ask(Request.STAND)
        only.until(lambda: only.cycle.state.mode is Mode.STAND)
        only.run(0.5)
    assert only.cycle.clamps[list(Clamp).index(Clamp.CONTACT)] == 0
