"""What a robot's numbers ask of its motors' protocol, held against the most that a frame can carry.

A codec clips what is more, in silence: a robot whose stiffness is cut to a fifth falls, and nothing says why. So such a
robot is refused where its configuration is read.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from drivers.description import RobotDescription
from drivers.motor_codec import build_codec
from drivers.robot import Array
from drivers.wiring import MotorsConfig
from runtime.control.parameters import GainsConfig
from runtime.parameters import DampConfig, TuningConfig

_POSITION, _VELOCITY, _TORQUE, _KP, _KD = range(5)
_UNITS = ("rad", "rad/s", "N·m", "N·m/rad", "N·m·s/rad")
_REMEDY = {
    "compact": 'take motors.format = "float"',
    "mit": "lower it, or take a motor with a wider range (motors.model)",
}
Demand = tuple[str, int, Array]
"""Key, which of the five quantities, and its values at the joints: any shape that ends in (3,)."""


def uncarried(
    motors: MotorsConfig, robot: RobotDescription, gains: GainsConfig, damp: DampConfig, tuning: TuningConfig
) -> Iterator[str]:
    """Every number that the motors' frames cannot carry: key, value, bound, why, and what to do about it."""
    try:
        capacity = build_codec(motors).capacity
    except ValueError as error:
        yield f"motors: {error}"
        return
    protocol = motors.format if motors.protocol == "moteus" else motors.protocol
    gear = np.array(motors.gear)
    at_motor = (gear, gear, 1.0 / gear, 1.0 / gear**2, 1.0 / gear**2)
    for key, quantity, values in _demands(motors, robot, gains, damp, tuning):
        bound = capacity[quantity] / at_motor[quantity]
        for place in np.argwhere(np.abs(values) > bound):
            where = "".join(f"[{index}]" for index in place)
            yield (
                f"{key}{where} = {float(values[tuple(place)]):g} {_UNITS[quantity]}: frames of {protocol!r} carry"
                f" {bound[place[-1]]:.4g} at this joint and would clip the rest in silence: {_REMEDY[protocol]}"
            )


def _demands(
    motors: MotorsConfig, robot: RobotDescription, gains: GainsConfig, damp: DampConfig, tuning: TuningConfig
) -> Iterator[Demand]:
    joints, offset = robot.joints, np.array(motors.offset)
    yield "control.gains.kp", _KP, np.array(gains.kp)
    yield "control.gains.kd", _KD, np.array(gains.kd)
    yield "tuning.kp, with control.gains.kp", _KP, tuning.kp[1] * np.array(gains.kp)
    yield "tuning.kd, with control.gains.kd", _KD, tuning.kd[1] * np.array(gains.kd)
    yield "damp.kd", _KD, np.full(3, damp.kd)
    yield "damp.fall_kd", _KD, np.full(3, damp.fall_kd)
    yield "robot.joints.peak_torque", _TORQUE, np.array(joints.peak_torque)
    yield "motors.max_torque", _TORQUE, np.array(motors.max_torque)
    yield "robot.joints.max_velocity", _VELOCITY, np.array(joints.max_velocity)
    yield "robot.joints.lower, with motors.offset", _POSITION, np.array(joints.lower) + offset
    yield "robot.joints.upper, with motors.offset", _POSITION, np.array(joints.upper) + offset
