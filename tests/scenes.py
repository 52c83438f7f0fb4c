"""What the core's tests share: robots, poses, measurements and records to work on."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from drivers.robot import ImuSample, JointState, Measurement
from runtime import config
from runtime.control.controller import Controller
from runtime.control.policy import Policy, policy_record
from runtime.control.records import CONTROL_DTYPE
from runtime.control.state import STATE_DTYPE, WORK_DTYPE, build_parameters, stand_angles
from runtime.policies import find_policy, load

ROBOTS = ("stoch3", "mini_cheetah", "a1")


@cache
def robot(name: str = "stoch3") -> config.Config:
    return config.load(config.find_robot(name))


@cache
def policy(name: str = "stoch3") -> Policy:
    return load(find_policy(robot(name).control.policy), robot(name).robot.name)


def control(name: str = "stoch3", **changes: Any) -> Any:
    """``[control]`` of a robot with fields replaced: ``control(gait={"name": "walk"})``."""
    import msgspec

    table = msgspec.to_builtins(robot(name).control)
    for key, value in changes.items():
        table[key] = {**table[key], **value} if isinstance(value, dict) else value
    return msgspec.convert(table, type(robot(name).control))


def variant(base: Policy, **changes: Any) -> Policy:
    """A policy with fields replaced."""
    import msgspec

    return msgspec.structs.replace(base, **changes)


def controller(name: str = "stoch3", chosen: Policy | None = None, **changes: Any) -> Controller:
    return Controller(robot(name).robot, control(name, **changes), chosen or policy(name))


def rotation(rpy: Any) -> np.ndarray:
    """Body to world of roll, pitch, yaw, independent of the core's own arithmetic."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def quaternion(rpy: Any) -> np.ndarray:
    """w x y z of roll, pitch, yaw."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(np.asarray(rpy) / 2), np.sin(np.asarray(rpy) / 2)
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def measurement(
    position: np.ndarray,
    velocity: np.ndarray | None = None,
    torque: np.ndarray | None = None,
    rpy: Any = (0.0, 0.0, 0.0),
    rate: Any = (0.0, 0.0, 0.0),
    acceleration: Any = None,
    stamp: float = 0.0,
) -> Measurement:
    """A measurement with everything that is not said at rest."""
    rest = rotation(rpy).T @ np.array([0.0, 0.0, 9.81]) if acceleration is None else acceleration
    imu = ImuSample(stamp, quaternion(rpy), np.array(rate, float), np.array(rest, float))
    zero = np.zeros((4, 3))
    joints = JointState(
        np.array(position, float),
        zero if velocity is None else velocity,
        zero if torque is None else torque,
        np.full((4, 3), 30.0),
        np.zeros((4, 3), np.int32),
        zero,
    )
    return Measurement(stamp, imu, joints, 48.0)


def standing(name: str = "stoch3", **changes: Any) -> Measurement:
    """On four feet at walking height, every leg bearing a quarter of the weight."""
    known = robot(name)
    position = stand_angles(known.robot, known.control.gait.walking_height)
    torque = bearing_torque(name, position, np.array([0.0, 0.0, known.robot.mass * 9.81 / 4]))
    return measurement(**{"position": position, "torque": torque, **changes})


def bearing_torque(name: str, position: np.ndarray, force: np.ndarray, up: Any = (0.0, 0.0, 1.0)) -> np.ndarray:
    """Joint torque (4, 3) with ``force`` on every foot (body frame), from energy: independent of ``contact``."""
    from sim.model import build_model

    model = build_model(robot(name).robot)
    torque = np.empty((4, 3))
    for leg in range(4):
        for joint in range(3):
            step = np.zeros((4, 3))
            step[leg, joint] = 1e-6
            ahead, behind = model.foot_positions(position + step)[leg], model.foot_positions(position - step)[leg]
            torque[leg, joint] = -(force @ (ahead - behind)) / 2e-6
    return torque + gravity_torque(name, position, up)


def gravity_torque(name: str, position: np.ndarray, up: Any) -> np.ndarray:
    """d (potential energy of the links) / d q by central differences. Shape (4, 3)."""
    torque = np.empty((4, 3))
    for leg in range(4):
        for joint in range(3):
            step = np.zeros((4, 3))
            step[leg, joint] = 1e-6
            rise = potential(name, position + step, up) - potential(name, position - step, up)
            torque[leg, joint] = rise / 2e-6
    return torque


def potential(name: str, position: np.ndarray, up: Any) -> float:
    """Energy of the legs' links in gravity, J, from the simulator's rigid bodies."""
    from sim.model import build_model
    from sim.rotation import about_axis

    model = build_model(robot(name).robot)
    energy = 0.0
    for leg in range(4):
        origin, turned = np.zeros(3), np.eye(3)
        for joint in range(3):
            hinge, body = model.hinges[3 * leg + joint], model.bodies[1 + 3 * leg + joint]
            origin = origin + turned @ hinge.origin
            turned = turned @ hinge.rotation @ about_axis(hinge.axis, position[leg, joint])
            energy += body.mass * 9.81 * float(np.asarray(up) @ (origin + turned @ body.com))
    return energy


class Workbench:
    """The records that one room of the core works on, set by hand."""

    def __init__(self, name: str = "stoch3", chosen: Policy | None = None, **changes: Any) -> None:
        self.config = control(name, **changes)
        self.parameters = build_parameters(robot(name).robot, self.config)
        self.state = np.zeros(1, STATE_DTYPE)
        self.record = np.zeros(1, CONTROL_DTYPE)
        self.policies = policy_record(chosen or policy(name))
        self.work = np.zeros(1, WORK_DTYPE)

    @property
    def p(self) -> Any:
        return self.parameters.view(np.recarray)[0]

    @property
    def s(self) -> Any:
        return self.state.view(np.recarray)[0]

    @property
    def t(self) -> Any:
        return self.record.view(np.recarray)[0]

    @property
    def m(self) -> Any:
        return self.work.view(np.recarray)[0]

    @property
    def chosen(self) -> Any:
        return self.policies.view(np.recarray)[0]
