"""Which body a daemon drives: the only place that knows both the runtime and the simulator."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import asin, atan2, cos, sin
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from drivers.robot import Array, Robot
from runtime.config import Config
from runtime.link import Channel
from runtime.messages import Keys, SimTruth, decode_push

if TYPE_CHECKING:
    from sim.robot import SimRobot

KINDS = ("sim", "null")


class BodyError(ValueError):
    """No such body: the message says which there are."""


@dataclass(frozen=True, slots=True)
class Body:
    """A body and the keys that it alone has."""

    robot: Robot
    channels: Callable[[Keys], Sequence[Channel]]


def build_body(kind: str, config: Config, robot_file: Path) -> Body:
    """The body that ``kind`` names, folded on the ground, not yet connected.

    Raises:
        BodyError: an unknown kind.
        ValueError: the robot's poses cannot be.
    """
    if kind == "null":
        return _null(config)
    if kind == "sim":
        return _sim(config, robot_file)
    raise BodyError(f"body {kind!r} is not known; there are {', '.join(KINDS)}")


def _null(config: Config) -> Body:
    from drivers.null import NullRobot
    from runtime.control.posture import Posture

    posture = Posture(config.robot, config.control, config.posture)
    return Body(NullRobot(posture.folded_joints), lambda _keys: ())


class _Clock:
    """Monotonic time, and when it was last asked: once an exchange."""

    last = 0.0

    def __call__(self) -> float:
        self.last = time.monotonic()
        return self.last


def _sim(config: Config, robot_file: Path) -> Body:
    from runtime.control.posture import Posture
    from sim.robot import SimRobot
    from sim.scenario import Scenario
    from sim.world import World

    posture = Posture(config.robot, config.control, config.posture)
    control, clock = config.control, _Clock()
    robot = SimRobot(
        lambda: World(
            config.robot, control.rate_hz, control.gait.walking_height, urdf_search=robot_file.resolve().parent
        ),
        Scenario(joint_position=posture.folded_joints),
        clock,
    )
    period = 1.0 / control.rate_hz

    def channels(keys: Keys) -> Sequence[Channel]:
        return (
            Channel(keys.sim_truth, produce=lambda: _truth(robot, clock.last + period)),
            Channel(keys.sim_push, accept=lambda data: _push(robot, data)),
        )

    return Body(robot, channels)


def _truth(robot: SimRobot, stamp: float) -> bytes:
    """The state after the last exchange, which the next measurement will be of."""
    truth = robot.world.truth
    roll, pitch, yaw = _rpy(truth.rotation_body_to_world)
    forward, left = _turned(truth.linear_velocity[0], truth.linear_velocity[1], -yaw)
    x, y, z = truth.position.tolist()
    velocity = (forward, left, float(truth.angular_velocity[2]))
    return msgspec.json.encode(SimTruth(stamp, (x, y, z), (roll, pitch, yaw), velocity, bool(robot.world.fallen())))


def _push(robot: SimRobot, data: bytes) -> None:
    push = decode_push(data)
    _, _, yaw = _rpy(robot.world.truth.rotation_body_to_world)
    x, y = _turned(push.force[0], push.force[1], yaw)
    robot.push((x, y, push.force[2]), push.duration)


def _rpy(rotation: Array) -> tuple[float, float, float]:
    """Roll, pitch, yaw of a rotation matrix (3, 3), rad."""
    r = rotation.tolist()
    return atan2(r[2][1], r[2][2]), -asin(max(-1.0, min(1.0, r[2][0]))), atan2(r[1][0], r[0][0])


def _turned(x: float, y: float, angle: float) -> tuple[float, float]:
    return float(x * cos(angle) - y * sin(angle)), float(x * sin(angle) + y * cos(angle))
