"""The guard: judges every measurement, bounds every command, and says why.

Both kernels work on the tick's own record: what they judge is what the flight log keeps.
"""

from __future__ import annotations

import math

import numpy as np

from drivers.description import RobotDescription
from drivers.robot import JOINTS, LEGS
from runtime.control.compilation import compiled
from runtime.control.records import Clamp, Records
from runtime.messages import TICK_DTYPE
from runtime.modes import Reason
from runtime.parameters import LimitsConfig

BOUNDS_DTYPE = np.dtype(
    [
        ("cos_tilt", "f8"),
        ("age", "f8"),
        ("temperature", "f8"),
        ("voltage", "f8"),
        ("angular_velocity", "f8"),
        ("acceleration", "f8"),
        ("thermal_share", "f8"),  # of one tick in the filter of the squared torque
        ("joint_velocity", "f8", (3,)),
        ("peak_torque", "f8", (3,)),
        ("continuous_torque", "f8", (3,)),
    ],
    align=True,
)

_OK, _NOT_FINITE, _STALE_MOTOR, _STALE_IMU = (
    int(reason) for reason in (Reason.OK, Reason.NOT_FINITE, Reason.STALE_MOTOR, Reason.STALE_IMU)
)
_IMPLAUSIBLE, _TILTED, _MOTOR_FAULT, _HOT = (
    int(reason) for reason in (Reason.IMPLAUSIBLE_IMU, Reason.TILTED, Reason.MOTOR_FAULT, Reason.HOT_MOTOR)
)
_JOINT_SPEED, _LOW_VOLTAGE, _OVERLOAD, _BAD_COMMAND = (
    int(reason) for reason in (Reason.JOINT_SPEED, Reason.LOW_VOLTAGE, Reason.OVERLOAD, Reason.BAD_COMMAND)
)
_TORQUE = int(Clamp.TORQUE)


@compiled
def _judge_imu(t, b):  # type: ignore[no-untyped-def]
    w, x, y, z = t.orientation[0], t.orientation[1], t.orientation[2], t.orientation[3]
    norm = w * w + x * x + y * y + z * z
    rate = acceleration = 0.0
    for i in range(3):
        rate = max(rate, abs(t.angular_velocity[i]))
        acceleration = max(acceleration, abs(t.linear_acceleration[i]))
        if not math.isfinite(t.angular_velocity[i] + t.linear_acceleration[i]):
            return _NOT_FINITE
    if not math.isfinite(norm + t.imu_stamp):
        return _NOT_FINITE
    if t.measured_stamp - t.imu_stamp > b.age:
        return _STALE_IMU
    if abs(norm - 1.0) > 0.05 or rate > b.angular_velocity or acceleration > b.acceleration:
        return _IMPLAUSIBLE
    if 1.0 - 2.0 * (x * x + y * y) / norm < b.cos_tilt:
        return _TILTED
    return _OK


@compiled
def _judge_joint(t, b, leg, joint):  # type: ignore[no-untyped-def]
    position, velocity = t.joint_position[leg, joint], t.joint_velocity[leg, joint]
    torque, temperature = t.joint_torque[leg, joint], t.joint_temperature[leg, joint]
    if not math.isfinite(position + velocity + torque + temperature + t.joint_age[leg, joint]):
        return _NOT_FINITE
    if t.joint_fault[leg, joint] != 0:
        return _MOTOR_FAULT
    if t.joint_age[leg, joint] > b.age:
        return _STALE_MOTOR
    if abs(velocity) > b.joint_velocity[joint]:
        return _JOINT_SPEED
    if temperature > b.temperature:
        return _HOT
    return _OK


@compiled
def judge(ticks, bounds, mean_square):  # type: ignore[no-untyped-def]
    """The first thing wrong with the measurement in ``ticks`` (1,): its reason, and 3·leg + joint or -1.

    ``mean_square`` (4, 3) is the filtered squared torque, N²·m², updated in place.
    """
    t, b = ticks[0], bounds[0]
    reason = _judge_imu(t, b)
    if reason != _OK:
        return reason, -1
    for leg in range(4):
        for joint in range(3):
            reason = _judge_joint(t, b, leg, joint)
            if reason != _OK:
                return reason, 3 * leg + joint
    if not math.isfinite(t.voltage):
        return _NOT_FINITE, -1
    if t.voltage < b.voltage:
        return _LOW_VOLTAGE, -1
    for leg in range(4):
        for joint in range(3):
            square = t.joint_torque[leg, joint] ** 2
            mean_square[leg, joint] += (square - mean_square[leg, joint]) * b.thermal_share
            if mean_square[leg, joint] > b.continuous_torque[joint] ** 2:
                return _OVERLOAD, 3 * leg + joint
    return _OK, -1


@compiled
def bound_command(ticks, bounds):  # type: ignore[no-untyped-def]
    """Cut the feed-forward of ``ticks`` (1,) so that the law's foreseen torque stays within the peak.

    Returns OK, or BAD_COMMAND where a number is not finite or a gain negative.
    """
    t, b = ticks[0], bounds[0]
    for leg in range(4):
        for joint in range(3):
            kp, kd = t.command_kp[leg, joint], t.command_kd[leg, joint]
            torque = t.command_torque[leg, joint]
            foreseen = (
                torque
                + kp * (t.command_position[leg, joint] - t.joint_position[leg, joint])
                + kd * (t.command_velocity[leg, joint] - t.joint_velocity[leg, joint])
            )
            if not math.isfinite(foreseen) or kp < 0.0 or kd < 0.0:
                return _BAD_COMMAND
            peak = b.peak_torque[joint]
            if abs(foreseen) > peak:
                t.command_torque[leg, joint] = torque + (peak if foreseen > 0.0 else -peak) - foreseen
                t.clamps |= _TORQUE
    return _OK


def joint_name(index: int) -> str:
    """``FL knee`` for 2."""
    return f"{LEGS[index // 3]} {JOINTS[index % 3]}"


class Guard:
    """The bounds of one robot, and the memory of what its motors have borne."""

    def __init__(self, description: RobotDescription, config: LimitsConfig, rate_hz: float) -> None:
        self.config = config
        self.bounds = np.zeros(1, BOUNDS_DTYPE)
        self.mean_square = np.zeros((4, 3))
        """Squared torque of every motor through the thermal low-pass, N²·m². Shape (4, 3)."""
        self._range = np.array(description.joints.lower), np.array(description.joints.upper)
        self._where = -1
        b = self.bounds[0]
        b["cos_tilt"], b["age"] = math.cos(config.max_tilt), config.max_age
        b["temperature"], b["voltage"] = config.max_temperature, config.min_voltage
        b["angular_velocity"], b["acceleration"] = config.max_angular_velocity, config.max_acceleration
        b["thermal_share"] = 1.0 - math.exp(-1.0 / (rate_hz * config.thermal_time))
        b["joint_velocity"] = description.joints.max_velocity
        b["peak_torque"], b["continuous_torque"] = description.joints.peak_torque, description.joints.continuous_torque

    def reset(self) -> None:
        """Forget what the motors have borne, and compile both kernels on a blank tick."""
        blank = np.zeros(1, TICK_DTYPE)
        judge(blank, self.bounds, self.mean_square)
        bound_command(blank, self.bounds)
        self.mean_square[:] = 0.0
        self._where = -1

    def judge(self, ticks: Records) -> Reason:
        """OK, or the first reason to damp in the measurement of this tick's record (1,)."""
        code, self._where = judge(ticks, self.bounds, self.mean_square)
        return _REASONS[code]

    def bound(self, ticks: Records) -> Reason:
        """Cut the feed-forward torque in the tick's record (1,); OK, or BAD_COMMAND."""
        return _REASONS[bound_command(ticks, self.bounds)]

    def explain(self, reason: Reason, ticks: Records) -> str:
        """One line for people about the last verdict: what, where, value and bound."""
        t, config = ticks[0], self.config
        where = f"{joint_name(self._where)}: " if self._where >= 0 else ""
        leg, joint = divmod(max(self._where, 0), 3)
        match reason:
            case Reason.TILTED:
                detail = f"{tilt(t['orientation']):.2f} rad, bound {config.max_tilt:g}"
            case Reason.STALE_MOTOR:
                detail = f"{t['joint_age'][leg, joint] * 1e3:.0f} ms, bound {config.max_age * 1e3:.0f}"
            case Reason.STALE_IMU:
                detail = f"{(t['measured_stamp'] - t['imu_stamp']) * 1e3:.0f} ms, bound {config.max_age * 1e3:.0f}"
            case Reason.MOTOR_FAULT:
                detail = f"code {t['joint_fault'][leg, joint]}"
            case Reason.HOT_MOTOR:
                detail = f"{t['joint_temperature'][leg, joint]:.0f} °C, bound {config.max_temperature:g}"
            case Reason.JOINT_SPEED:
                bound = self.bounds[0]["joint_velocity"][joint]
                detail = f"{t['joint_velocity'][leg, joint]:.1f} rad/s, bound {bound:g}"
            case Reason.LOW_VOLTAGE:
                detail = f"{t['voltage']:.1f} V, bound {config.min_voltage:g}"
            case Reason.OVERLOAD:
                bound = self.bounds[0]["continuous_torque"][joint]
                detail = f"{math.sqrt(self.mean_square[leg, joint]):.1f} N·m, bound {bound:g}"
            case _:
                return f"{where}{reason.words}"
        return f"{where}{reason.words} ({detail})"

    def arming_problems(self, ticks: Records) -> list[str]:
        """What speaks against arming in this tick's record (1,), beside the verdict; empty when nothing does."""
        t, config = ticks[0], self.config
        problems = []
        if (angle := tilt(t["orientation"])) > config.arming_tilt:
            problems.append(f"tilted {angle:.2f} rad, bound {config.arming_tilt:g}")
        if (hottest := float(t["joint_temperature"].max())) > config.arming_temperature:
            problems.append(f"hottest motor {hottest:.0f} °C, bound {config.arming_temperature:g}")
        if t["voltage"] < config.arming_voltage:
            problems.append(f"supply {t['voltage']:.1f} V, bound {config.arming_voltage:g}")
        lower, upper = self._range
        position = t["joint_position"]
        outside = (position < lower - config.joint_margin) | (position > upper + config.joint_margin)
        for leg, joint in np.argwhere(outside):
            problems.append(
                f"{joint_name(3 * leg + joint)} at {position[leg, joint]:.2f} rad,"
                f" range {lower[leg, joint]:g} to {upper[leg, joint]:g}"
            )
        return problems


_REASONS = {int(reason): reason for reason in Reason}


def tilt(orientation: np.ndarray) -> float:
    """Angle between the body's z and the world's, rad, of a quaternion w x y z (4,)."""
    _, x, y, _ = orientation
    return math.acos(min(1.0, max(-1.0, 1.0 - 2.0 * (x * x + y * y))))
