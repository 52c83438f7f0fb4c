"""One episode: a World, a Controller and a reward → an ``Episode``. Seeded, picklable, the same bits every time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from drivers.robot import Array, JointCommand, Measurement
from runtime.config import Config
from runtime.control.controller import Controller
from runtime.control.policy import Policy, set_parameters
from runtime.control.records import Records, SolverStatus, VelocityCommand
from sim.world import World
from training.randomize import Conditions
from training.reward import TABLE_TERMS, TASK_TERMS, TableReward, TaskReward, named
from training.score import score_table, score_task

FALL_CHECK = 5
"""Ticks between two questions whether the body touches the ground; leaning is seen at once."""


@dataclass(frozen=True, slots=True)
class Episode:
    """What came of one rollout."""

    fitness: float
    """Sum of the reward; NaN where it could not be told."""
    steps: int
    """Ticks until the end or the fall."""
    fell: bool
    terms: dict[str, float] = field(default_factory=dict)
    """The fitness by its terms."""


@dataclass(frozen=True, slots=True)
class Setup:
    """All that the episodes of a run have in common: a worker gets it once."""

    config: Config
    policy: Policy
    """Shape, scales and terms; its numbers come with each task."""
    reward: TableReward | TaskReward
    ticks: int
    features: Array | None = None
    """The reference, tick by tick, for Table I. Shape (ticks, 30)."""
    commands: Array | None = None
    """Its commands. Shape (ticks, 3)."""
    physics_rate_hz: float = 1000.0


@dataclass(frozen=True, slots=True)
class Task:
    """One episode to do."""

    parameters: Array
    """The policy's trained numbers. Shape (n,)."""
    conditions: Conditions


class Walker(Protocol):
    """A controller: the linear policy's, the teacher's or a baseline's."""

    @property
    def record(self) -> Records:
        """What the last step computed, (1,) of ``CONTROL_DTYPE``."""

    @property
    def geometry(self) -> Records:
        """The legs, (1,) of ``GEOMETRY_DTYPE``."""

    def reset(self, measurement: Measurement) -> None:
        """Forget everything."""

    def step(self, measurement: Measurement, command: VelocityCommand, standing: bool = False) -> JointCommand:
        """One tick; ``standing`` begins no new swing."""


Watch = Callable[[int, Array], bool]
"""Called after every tick with its index and command (3,); False says that the robot is down, and ends the episode."""
LOWEST = 0.6
"""Share of the walking height below which the robot is down, whatever part of it touches the ground."""


def walk(world: World, walker: Walker, conditions: Conditions, commands: Array, watch: Watch) -> tuple[int, bool]:
    """Reset both, then run a tick for each of ``commands`` (n, 3): vx, vy, yaw rate. Returns ticks and whether it fell.

    The walker sees each measurement one tick before its command acts, as on the robot; until the first one it stands.
    """
    measurement = world.reset(conditions.scenario)
    walker.reset(measurement)
    command = standing_command(measurement, world)
    status, failed = walker.record["solver_status"], int(SolverStatus.FAILED)
    changes = [True, *(commands[1:] != commands[:-1]).any(axis=1).tolist()]
    asked = VelocityCommand()
    for tick, (wanted, changed) in enumerate(zip(commands, changes, strict=True)):
        measurement = world.step(command)
        if changed:
            asked = VelocityCommand(linear=wanted[:2], yaw_rate=float(wanted[2]))
        command = walker.step(measurement, asked, conditions.standing)
        if status[0] == failed or (tick % FALL_CHECK == 0 and world.fallen()):
            return tick, True
        if not watch(tick, wanted):
            return tick + 1, True
    return len(commands), world.fallen()


def standing_command(measurement: Measurement, world: World) -> JointCommand:
    """Hold the joints where they are."""
    joints = world.description.joints
    stiffness = np.tile(4.0 * np.array(joints.continuous_torque), (4, 1))
    return JointCommand(
        position=measurement.joints.position, velocity=np.zeros((4, 3)), kp=stiffness, kd=stiffness / 40.0,
        torque=np.zeros((4, 3)),
    )  # fmt: skip


class Stage:
    """Where a worker plays its episodes: one World and one Controller, used again and again."""

    def __init__(self, setup: Setup, walker: Walker | None = None) -> None:
        """Build both; ``walker`` plays in the place of the setup's policy, and tasks then bring no numbers."""
        control = setup.config.control
        self.setup = setup
        self.world = World(setup.config.robot, control.rate_hz, control.gait.walking_height, setup.physics_rate_hz)
        self._controller = Controller(setup.config.robot, control, setup.policy) if walker is None else None
        self._walker: Walker = self._controller or walker  # type: ignore[assignment]
        self._lowest = LOWEST * control.gait.walking_height
        self._weight = setup.config.robot.mass * 9.81

    def rollout(self, task: Task) -> Episode:
        """Play one episode; its result depends on the task alone."""
        if self._controller is not None:
            set_parameters(self._controller.policy_record, self.setup.policy, task.parameters)
        reward = self.setup.reward
        if isinstance(reward, TableReward):
            return self._imitate(task, reward)
        return self._serve(task, reward)

    def close(self) -> None:
        """Release the simulator."""
        self.world.close()

    def _commands(self, conditions: Conditions) -> Array:
        if conditions.command is not None:
            return np.tile(np.array(conditions.command), (self.setup.ticks, 1))
        if self.setup.commands is None:
            raise ValueError("conditions without a command need a reference's")
        return self.setup.commands[: self.setup.ticks]

    def _imitate(self, task: Task, reward: TableReward) -> Episode:
        features = self.setup.features
        assert features is not None, "Table I compares with a reference"
        table, sums = reward.table(), np.zeros(len(TABLE_TERMS))
        world, record, lowest = self.world, self._walker.record, self._lowest
        ground, start_yaw = task.conditions.scenario.terrain, task.conditions.scenario.rpy[2]

        forces, weight = record["grf"][0], self._weight

        def watch(tick: int, _: Array) -> bool:
            body = world.body
            score_table(table, features[tick], start_yaw, body, forces, weight, sums)
            x, y, z = body[:3].tolist()
            return bool(z - ground.height_at(x, y) > lowest)

        return self._play(task, watch, TABLE_TERMS, sums)

    def _serve(self, task: Task, reward: TaskReward) -> Episode:
        table, sums, smoothed = reward.table(), np.zeros(len(TASK_TERMS)), np.zeros(3)
        world, geometry = self.world, self._walker.geometry
        dt, height = world.period, self.setup.config.control.gait.walking_height
        ground = task.conditions.scenario.terrain

        def watch(_: int, command: Array) -> bool:
            body = world.body
            x, y, z = body[:3].tolist()
            above = z - ground.height_at(x, y)
            score_task(
                table, dt, smoothed, command, above - height, body, world.joints, world.foot_contacts, geometry, sums
            )
            return bool(above > self._lowest)

        return self._play(task, watch, TASK_TERMS, sums)

    def _play(self, task: Task, watch: Watch, names: tuple[str, ...], sums: Array) -> Episode:
        steps, fell = walk(self.world, self._walker, task.conditions, self._commands(task.conditions), watch)
        return Episode(float(sums.sum()), steps, fell, named(names, sums))
