"""The ground that the engine was given is the ground that the terrains describe, with their friction."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pybullet
import pytest
from worlds import FIELD, STOCH3, along, hold, stand, stoch3_world

from sim.scenario import Push, Scenario
from sim.sensing import GRAVITY
from sim.terrain import Plane, Slope, Steps, Terrain
from sim.world import World


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    with stoch3_world() as world:
        yield world


def test_it_starts_with_the_lowest_foot_just_on_the_ground(world: World) -> None:
    for scenario in (Scenario(), Scenario(rpy=(0.3, -0.2, 1.0)), Scenario(terrain=Slope(0.3)), Scenario(terrain=FIELD)):
        command = hold(world.reset(scenario).joints.position)
        for _ in range(4):
            world.step(command)
            assert world.truth.foot_forces[:, 2].max() < 6 * STOCH3.mass * GRAVITY
        assert world.truth.foot_contacts.any()


def test_the_ground_answers_a_steady_push(world: World) -> None:
    truth = stand(world, Scenario(pushes=(Push(0.5, 9.0, (15.0, 40.0, 0.0)),)), 2.0)
    expected = [-15.0, -40.0, STOCH3.mass * GRAVITY]
    np.testing.assert_allclose(truth.foot_forces.sum(axis=0), expected, atol=2.0)


@pytest.mark.parametrize("friction", [0.1, 0.3])
def test_a_sliding_foot_feels_the_coefficient_of_friction(world: World, friction: float) -> None:
    slope = Slope(0.45)
    scenario = Scenario(terrain=slope, rpy=along(slope), friction=friction)
    normal = np.array(slope.normal)
    for foot in stand(world, scenario, 0.4).foot_forces:
        load = foot @ normal
        assert np.linalg.norm(foot - load * normal) == pytest.approx(friction * load, rel=1e-3)


def test_enough_friction_holds_on_a_slope(world: World) -> None:
    slope = Slope(0.2)
    scenario = Scenario(terrain=slope, rpy=along(slope), friction=0.6)
    start, end = stand(world, scenario, 1.5), stand(world, scenario, 2.5)
    assert np.linalg.norm(end.position - start.position) < 0.01


@pytest.mark.parametrize("terrain", [Plane(), Slope(0.2, 0.5), Steps(0.06, start=0.1), FIELD])
def test_feet_rest_on_the_height_that_the_terrain_names(world: World, terrain: Terrain) -> None:
    touching = 0
    rpy = along(terrain) if isinstance(terrain, Slope) else (0.0, 0.0, 0.0)
    for x, y in ((0.0, 0.0), (0.33, -0.21)):
        truth = stand(world, Scenario(terrain=terrain, rpy=rpy, position_xy=(x, y), friction=1.2), 2.0)
        rotation = truth.rotation_body_to_world
        feet = truth.position + world.model.foot_positions(truth.joint_position) @ rotation.T
        for foot, contact, force in zip(feet, truth.foot_contacts, truth.foot_forces, strict=True):
            below = foot - STOCH3.foot_radius * force / max(np.linalg.norm(force), 1e-9)
            gap = foot[2] - terrain.height_at(foot[0], foot[1]) - STOCH3.foot_radius
            assert gap > -0.02, "a foot sank into the ground"
            if contact and isinstance(terrain, Plane):
                assert below[2] == pytest.approx(0.0, abs=2e-3)
            if contact and isinstance(terrain, Slope):
                distance = np.dot(foot, terrain.normal) - STOCH3.foot_radius
                assert distance == pytest.approx(0.0, abs=2e-3)
            touching += contact
        assert truth.foot_forces[:, 2].sum() == pytest.approx(STOCH3.mass * GRAVITY, rel=0.1)
    assert touching >= 5


@pytest.mark.parametrize("terrain", [Slope(-0.2, 0.5), Steps(0.06, start=0.1), FIELD])
def test_rays_meet_the_ground_at_the_height_that_the_terrain_names(world: World, terrain: Terrain) -> None:
    world.reset(Scenario(terrain=terrain, height=50.0))
    drawn = np.random.default_rng(0).uniform(-1.9, 1.9, (300, 2))
    places = [(x, y) for x, y in drawn if abs(terrain.height_at(x + 1e-3, y) - terrain.height_at(x - 1e-3, y)) < 0.01]
    assert len(places) > 250
    hits = pybullet.rayTestBatch(
        [[x, y, 3.0] for x, y in places], [[x, y, -3.0] for x, y in places], physicsClientId=world._engine.client
    )
    heights = [hit[3][2] for hit in hits]
    np.testing.assert_allclose(heights, [terrain.height_at(x, y) for x, y in places], atol=1e-6)
