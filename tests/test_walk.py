"""Whole walks: the control core on the simulated body, from torque-estimated contact and the estimator alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import msgspec
import numpy as np
import pytest

from drivers.robot import Array, JointCommand
from runtime import policies
from runtime.config import Config, find_robot, load
from runtime.control.controller import Controller
from runtime.control.parameters import ControlConfig
from runtime.control.records import SolverStatus, VelocityCommand
from sim.scenario import Noise, Push, Scenario
from sim.terrain import HeightField, Slope
from sim.world import World

SENSORS = Noise(
    joint_position=0.001,
    joint_velocity=0.1,
    joint_torque=0.3,
    orientation=0.004,
    angular_velocity=0.02,
    linear_acceleration=0.2,
)


@dataclass
class Walk:
    """What a stretch of walking showed."""

    fell: bool = False
    velocity: list[Array] = field(default_factory=list)
    estimated: list[Array] = field(default_factory=list)
    height_error: list[float] = field(default_factory=list)
    contacts: list[tuple[Array, Array]] = field(default_factory=list)
    tilt: float = 0.0
    statuses: set[int] = field(default_factory=set)
    commands: list[JointCommand] = field(default_factory=list)

    @property
    def mean(self) -> Array:
        return np.mean(self.velocity, axis=0)

    @property
    def rmse(self) -> float:
        """Of the estimated velocity against the truth, m/s."""
        error = np.array(self.estimated)[:, :2] - np.array(self.velocity)[:, :2]
        return float(np.sqrt((error**2).sum(axis=1).mean()))


class Stage:
    """One robot in one world, ready to walk."""

    def __init__(self, robot: str, **changes: dict[str, object]) -> None:
        self.config: Config = load(find_robot(robot))
        self.control: ControlConfig = self.config.control
        for section, values in changes.items():
            if section == "rate_hz":
                self.control = msgspec.structs.replace(self.control, rate_hz=values)
            else:
                part = msgspec.structs.replace(getattr(self.control, section), **values)
                self.control = msgspec.structs.replace(self.control, **{section: part})
        self.world = World(self.config.robot, self.control.rate_hz, self.control.gait.walking_height)
        policy = policies.load(policies.find_policy(self.control.policy), self.config.robot.name)
        self.controller = Controller(self.config.robot, self.control, policy)

    def walk(self, velocity: tuple[float, float, float], seconds: float, scenario: Scenario | None = None) -> Walk:
        """Walk at ``velocity`` from rest; figures are taken after the first 1.2 s."""
        world, controller, result = self.world, self.controller, Walk()
        measurement = world.reset(scenario or Scenario())
        controller.reset(measurement)
        command = controller.step(measurement, VelocityCommand(), standing=True)
        wanted = VelocityCommand(linear=np.array(velocity[:2]), yaw_rate=velocity[2])
        for tick in range(int(seconds * self.control.rate_hz)):
            before = world.truth
            measurement = world.step(command)
            command = controller.step(measurement, wanted)
            record = controller.record[0]
            result.statuses.add(int(record["solver_status"]))
            if tick > 1.2 * self.control.rate_hz:
                rotation = before.rotation_body_to_world
                yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
                c, s = np.cos(yaw), np.sin(yaw)
                v = before.linear_velocity
                truth = np.array([c * v[0] + s * v[1], c * v[1] - s * v[0], before.angular_velocity[2]])
                result.velocity.append(truth)
                result.estimated.append(record["twist"][[0, 1, 5]].copy())
                result.height_error.append(float(record["height"] - before.position[2]))
                result.contacts.append((record["contacts"].astype(bool), before.foot_contacts))
                result.tilt = max(result.tilt, float(np.abs(record["rpy"][:2]).max()))
                result.commands.append(command)
            if world.fallen():
                result.fell = True
                break
        return result


@pytest.fixture(scope="module")
def stoch3() -> Iterator[Stage]:
    stage = Stage("stoch3")
    yield stage
    stage.world.close()


@pytest.mark.parametrize(
    "velocity",
    [(0, 0, 0), (0.4, 0, 0), (0.8, 0, 0), (-0.4, 0, 0), (0, 0.3, 0), (0, -0.3, 0), (0, 0, 0.8), (0.5, 0.2, 0.5)],
)
def test_follows_every_command(stoch3: Stage, velocity: tuple[float, float, float]) -> None:
    walk = stoch3.walk(velocity, 3.2)
    assert not walk.fell
    assert np.abs(walk.mean - velocity)[:2].max() < 0.03
    assert abs(walk.mean[2] - velocity[2]) < 0.03
    assert walk.statuses <= {SolverStatus.IDLE, SolverStatus.SOLVED}


@pytest.mark.parametrize("rate_hz", [100.0, 250.0, 500.0, 1000.0])
def test_one_matrix_walks_at_every_rate(rate_hz: float) -> None:
    stage = Stage("stoch3", rate_hz=rate_hz)
    walk = stage.walk((0.8, 0, 0), 2.5)
    stage.world.close()
    assert not walk.fell
    assert abs(walk.mean[0] - 0.8) < 0.1


@pytest.mark.parametrize("robot", ["stoch3", "a1", "mini_cheetah"])
@pytest.mark.parametrize("gait", ["trot", "walk", "pace", "bound"])
def test_gaits_on_all_robots(robot: str, gait: str) -> None:
    stage = Stage(robot, gait={"name": gait})
    walk = stage.walk((0.2, 0, 0), 3.0)
    stage.world.close()
    assert not walk.fell
    assert abs(walk.mean[0] - 0.2) < 0.06


def test_pronk() -> None:
    stage = Stage("stoch3", gait={"name": "pronk"})
    walk = stage.walk((0.2, 0, 0), 3.0)
    stage.world.close()
    airborne = np.mean([not truth.any() for _, truth in walk.contacts])
    assert not walk.fell
    assert airborne > 0.2
    assert abs(walk.mean[0] - 0.2) < 0.06


def test_walks_with_noisy_late_sensors(stoch3: Stage) -> None:
    walk = stoch3.walk((0.5, 0.1, 0.3), 4.0, Scenario(seed=3, noise=SENSORS, extra_delay=0.005))
    assert not walk.fell
    assert np.abs(walk.mean - (0.5, 0.1, 0.3))[:2].max() < 0.06


def test_estimator_against_the_truth(stoch3: Stage) -> None:
    for scenario, bound in ((Scenario(), 0.03), (Scenario(seed=5, noise=SENSORS), 0.05)):
        walk = stoch3.walk((0.8, 0, 0), 4.0, scenario)
        assert walk.rmse < bound
        assert np.sqrt(np.mean(np.square(walk.height_error))) < 0.01


def test_contact_from_torque_against_the_truth(stoch3: Stage) -> None:
    felt, true = (np.array(side) for side in zip(*stoch3.walk((0.8, 0, 0), 5.0).contacts, strict=True))
    assert (felt & ~true).sum() / (~true).sum() < 0.03
    assert (~felt & true).sum() / true.sum() < 0.03


@pytest.mark.parametrize("force", [(0.0, 150.0, 0.0), (0.0, -150.0, 0.0), (200.0, 0.0, 0.0), (-200.0, 0.0, 0.0)])
def test_withstands_a_push(stoch3: Stage, force: tuple[float, float, float]) -> None:
    walk = stoch3.walk((0.4, 0, 0), 4.5, Scenario(pushes=(Push(1.5, 0.1, force),)))
    assert not walk.fell
    assert np.abs(np.mean(walk.velocity[-160:], axis=0)[:2] - (0.4, 0.0)).max() < 0.08


@pytest.mark.parametrize(
    "terrain", [Slope(0.12), Slope(-0.12), HeightField(amplitude=0.03, spacing=0.1, seed=1)], ids=repr
)
def test_walks_off_the_plane(stoch3: Stage, terrain: Slope | HeightField) -> None:
    walk = stoch3.walk((0.4, 0, 0), 5.0, Scenario(terrain=terrain))
    assert not walk.fell
    assert abs(walk.mean[0] - 0.4) < 0.1


def test_same_seed_same_bits(stoch3: Stage) -> None:
    scenario = Scenario(seed=11, noise=SENSORS, pushes=(Push(0.5, 0.1, (0.0, 80.0, 0.0)),), rpy=(0.1, -0.05, 0.2))
    first = stoch3.walk((0.3, 0.1, 0.2), 2.0, scenario)
    stoch3.walk((-0.4, 0, 0), 0.5)
    again = stoch3.walk((0.3, 0.1, 0.2), 2.0, scenario)
    other = stoch3.walk((0.3, 0.1, 0.2), 2.0, Scenario(seed=12, noise=SENSORS))
    bits = [np.array([c.torque for c in walk.commands]).tobytes() for walk in (first, again, other)]
    assert bits[0] == bits[1]
    assert bits[0] != bits[2]


def test_no_policy_no_walk(stoch3: Stage) -> None:
    """The matrix is what balances: with zeros the robot tips over, so the walks above mean something."""
    policy = stoch3.controller.policy
    zero = tuple(tuple(0.0 for _ in row) for row in policy.matrix)
    terms = type(policy.terms)()
    stoch3.controller.policy = msgspec.structs.replace(policy, matrix=zero, terms=terms)
    try:
        walk = stoch3.walk((0.4, 0, 0), 4.0)
        assert walk.fell or walk.tilt > 0.3
    finally:
        stoch3.controller.policy = policy
