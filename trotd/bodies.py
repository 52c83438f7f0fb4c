"""Which body a daemon drives: the only place that knows both the runtime and the simulator."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import asin, atan2, cos, sin
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from drivers.robot import Array, Robot
from runtime.config import Config
from runtime.doors.answers import Channel
from runtime.messages.keys import Keys
from runtime.messages.mode import ArmingCheck
from runtime.messages.simulation import SimTruth, decode_hold, decode_push

if TYPE_CHECKING:
    from sim.world import World

KINDS = ("sim", "hardware", "twin", "null")
TWIN_MAX_AGE = 1.0
"""The guard's bound on ages and late loops for a twin, s: more than it stands still for a daemon that is held up, since
nothing grows old in it meanwhile."""
STALL_STAND, STALL_DAMP = 0.25, 1.0
"""The guard's bounds on a late loop for bodies that wait for it, s."""
MISSED = 0.9
"""Share of missed ticks with which such a body may still be armed."""


class BodyError(ValueError):
    """No such body: the message says which there are."""


@dataclass(frozen=True, slots=True)
class Body:
    """A body and the keys that it alone has."""

    robot: Robot
    channels: Callable[[Keys], Sequence[Channel]]
    checks: Callable[[], Sequence[ArmingCheck]] = lambda: (ArmingCheck("calibration", True, "exact by construction"),)
    """What it adds to the arming list."""


def lenient(kind: str, config: Config) -> Config:
    """``config`` with those bounds of the guard that a busy computer would pass instead of a robot."""
    if kind == "hardware":
        return config
    limits = config.limits
    limits = msgspec.structs.replace(
        limits,
        max_age=max(limits.max_age, TWIN_MAX_AGE if kind == "twin" else 0.0),
        stall_stand=max(limits.stall_stand, TWIN_MAX_AGE if kind == "twin" else STALL_STAND),
        stall_damp=max(limits.stall_damp, STALL_DAMP),
    )
    arming = config.arming
    if kind == "twin":  # it waits, so a loop that is late here and now says nothing about the next step
        arming = msgspec.structs.replace(arming, max_missed=1.0, max_lateness=max(arming.max_lateness, TWIN_MAX_AGE))
    if kind == "null":  # it is at once where it was told to be, without any speed
        limits = msgspec.structs.replace(limits, max_position_jump=3.0, max_position_noise=3.0)
    arming = msgspec.structs.replace(
        config.arming,
        max_missed=max(config.arming.max_missed, MISSED),
        max_lateness=max(config.arming.max_lateness, STALL_DAMP),
    )
    return msgspec.structs.replace(config, limits=limits, arming=arming)


def build_body(kind: str, config: Config, robot_file: Path, folder: Path, observe: bool = False) -> Body:
    """The body that ``kind`` names, not yet connected; a simulated one lies folded on the ground.

    Args:
        kind: one of ``KINDS``.
        config: of the robot.
        robot_file: where ``config`` was read from.
        folder: state folder, where a real body's calibration is.
        observe: no motor is ever energised; only for bodies on wires.

    Raises:
        BodyError: an unknown kind, or one that cannot be observed.
        DriverError: a body on wires without them, or without its calibration.
        ValueError: the robot's poses cannot be.
    """
    if kind in ("hardware", "twin"):
        from trotd.wire import check_calibration, wired_body

        robot = wired_body(kind, config, folder, observe)
        return Body(robot, lambda _keys: (), lambda: (check_calibration(kind, config, folder),))
    if observe:
        raise BodyError(f"body {kind!r} has no motors that could be left alone: --observe is for hardware and twin")
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
            Channel(keys.sim_truth, produce=lambda: truth_message(robot.world, clock.last + period)),
            Channel(keys.sim_push, accept=lambda data: push_world(robot.world, data)),
        )

    return Body(robot, channels)


def truth_message(world: World, stamp: float) -> bytes:
    """What ``sim/truth`` carries: the world's state now, which is that of ``stamp`` on the daemon's clock."""
    truth = world.truth
    roll, pitch, yaw = _rpy(truth.rotation_body_to_world)
    forward, left = _turned(truth.linear_velocity[0], truth.linear_velocity[1], -yaw)
    x, y, z = truth.position.tolist()
    velocity = (forward, left, float(truth.angular_velocity[2]))
    joints = tuple(truth.joint_position.ravel().tolist())
    return msgspec.json.encode(SimTruth(stamp, (x, y, z), (roll, pitch, yaw), velocity, bool(world.fallen()), joints))


def push_world(world: World, data: bytes) -> None:
    """Do what a message on ``sim/push`` asks.

    Raises:
        MessageError: it asks nonsense.
    """
    push = decode_push(data)
    _, _, yaw = _rpy(world.truth.rotation_body_to_world)
    x, y = _turned(push.force[0], push.force[1], yaw)
    world.push((x, y, push.force[2]), push.duration)


def hold_world(world: World, data: bytes) -> None:
    """Do what a message on ``sim/hold`` asks.

    Raises:
        MessageError: it asks nonsense.
    """
    hold = decode_hold(data)
    if hold.down:
        world.set_down()
        return
    world.hold(hold.rpy, np.array(hold.joints).reshape(4, 3) if hold.joints else None)


def _rpy(rotation: Array) -> tuple[float, float, float]:
    """Roll, pitch, yaw of a rotation matrix (3, 3), rad."""
    r = rotation.tolist()
    return atan2(r[2][1], r[2][2]), -asin(max(-1.0, min(1.0, r[2][0]))), atan2(r[1][0], r[0][0])


def _turned(x: float, y: float, angle: float) -> tuple[float, float]:
    return float(x * cos(angle) - y * sin(angle)), float(x * sin(angle) + y * cos(angle))
