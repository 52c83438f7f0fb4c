"""The guard: judges every measurement, bounds every command, and says why with its evidence."""

from __future__ import annotations

import math

import numpy as np

from drivers.description import RobotDescription
from drivers.robot import JOINTS, LEGS, Array, ImuSample
from runtime.control.compilation import compiled
from runtime.control.parameters import BoundsConfig
from runtime.control.records import Clamp, Records
from runtime.derating import derate_joint, derate_speed, ramp_up
from runtime.encoders import look_at_encoder
from runtime.limits import bound_command, judge_body, judge_fall, judge_joint, judge_load, judge_policy
from runtime.messages.fault import Evidence
from runtime.messages.tick import TICK_DTYPE
from runtime.parameters import DegradeConfig, LimitsConfig
from runtime.plausibility import keep_time, look_at_imu, look_at_joint, look_at_motor
from runtime.reasons import Reaction, Reason, reaction
from runtime.verdict import BOUNDS_DTYPE, MEMORY_DTYPE

NOISE_TIME = 0.1
"""Time constant of the mean of unexplained joint motion, s."""
REST_TIME = 2.0
"""Time constant with which a motor that is asked for nothing is believed again, s."""
_EXTRAPOLATED, _SOFT_START = int(Clamp.EXTRAPOLATED), int(Clamp.SOFT_START)


@compiled
def judge(ticks, bounds, memories, raw):  # type: ignore[no-untyped-def]
    """Judge the measurement in ``ticks`` (1,): the worst thing found is left in ``memories`` (1,) with its evidence.

    ``raw`` (10,) is room to work. Returns the reason, a number of ``Reason``.
    """
    t, b, m = ticks[0], bounds[0], memories[0]
    m.severity, m.reason, m.where, m.value, m.bound, m.marks = 0, 0, -1, 0.0, 0.0, 0
    known = m.measured_stamp > 0.0
    look_at_imu(t, b, m, raw)
    judge_body(t, b, m)
    ramp_up(t, b, m)
    derate_speed(t, b, m)
    for leg in range(4):
        for joint in range(3):
            finite = judge_joint(t, b, m, leg, joint)
            if finite:
                if known:
                    look_at_joint(t, b, m, leg, joint)
                    look_at_encoder(t, b, m, leg, joint)
                    look_at_motor(t, b, m, leg, joint)
                judge_load(t, b, m, leg, joint)
                m.position[leg, joint], m.velocity[leg, joint] = (
                    t.joint_position[leg, joint],
                    t.joint_velocity[leg, joint],
                )
                m.age[leg, joint] = t.joint_age[leg, joint]
            derate_joint(t, b, m, leg, joint)
    if math.isfinite(t.measured_stamp):
        m.measured_stamp = t.measured_stamp
    keep_time(t, b, m)
    return m.reason


@compiled
def keep_command(ticks, memories):  # type: ignore[no-untyped-def]
    """Remember the command that leaves, for what the motors answer two ticks from now."""
    t, m = ticks[0], memories[0]
    m.commands[1] = m.commands[0]
    m.commands[0, 0], m.commands[0, 1], m.commands[0, 2] = t.command_position, t.command_velocity, t.command_kp
    m.commands[0, 3], m.commands[0, 4] = t.command_kd, t.command_torque


@compiled
def judge_plan(ticks, bounds, memories):  # type: ignore[no-untyped-def]
    """What the controller found and the policy asked for in ``ticks`` (1,): OK, or what is wrong with it."""
    reason = judge_policy(ticks, bounds, memories)
    return reason if reason != 0 else judge_fall(ticks, bounds, memories)


class Guard:
    """The bounds of one robot, and the memory of what was measured and borne."""

    def __init__(
        self,
        description: RobotDescription,
        limits: LimitsConfig,
        rate_hz: float,
        degrade: DegradeConfig | None = None,
        soft_start: float = 1.0,
        action: BoundsConfig | None = None,
    ) -> None:
        self.config = limits
        self.description = description
        self.bounds = np.zeros(1, BOUNDS_DTYPE)
        self.memory = np.zeros(1, MEMORY_DTYPE)
        """All that the next verdict depends on beside the next measurement. Shape (1,) of ``MEMORY_DTYPE``."""
        self._raw = np.zeros(10)
        self._row = self.memory[0]
        self._set_limits(description, limits, 1.0 / rate_hz)
        self._set_degrade(degrade or DegradeConfig(), limits, soft_start, 1.0 / rate_hz)
        self._set_action(action)
        self._reactions = {reason: reaction(reason, limits.sit_down) for reason in Reason}
        self.forget()

    def forget(self) -> None:
        """Remember nothing."""
        self.memory[:] = 0
        self._row["where"], self._row["speed_share"] = -1, 1.0
        for name in ("imu", "imu_good", "imu_raw"):
            self._row[name][0] = 1.0
        self._row["felt"][2] = 9.81
        self._row["torque_share"], self._row["still"] = 1.0, -1.0
        self._row["torque_bound"] = self.bounds[0]["peak_torque"]
        self._row["torque_cause"] = int(Clamp.TORQUE)

    def reset(self) -> None:
        """Forget everything, and compile all kernels on a blank tick."""
        blank = np.zeros(1, TICK_DTYPE)
        judge(blank, self.bounds, self.memory, self._raw)
        judge_plan(blank, self.bounds, self.memory)
        bound_command(blank, self.bounds, self.memory)
        keep_command(blank, self.memory)
        self.forget()

    def judge(self, ticks: Records) -> Reason:
        """OK, or the worst reason to give up in the measurement of this tick's record (1,)."""
        return _REASONS[judge(ticks, self.bounds, self.memory, self._raw)]

    def judge_plan(self, ticks: Records) -> Reason:
        """OK, BAD_POLICY or FALLING, from estimate and action in the tick's record (1,)."""
        return _REASONS[judge_plan(ticks, self.bounds, self.memory)]

    def bound(self, ticks: Records) -> Reason:
        """Cut the feed-forward torque in the tick's record (1,); OK, or BAD_COMMAND."""
        return _REASONS[bound_command(ticks, self.bounds, self.memory)]

    def keep_command(self, ticks: Records) -> None:
        """Remember the command in the tick's record (1,) as the one that leaves."""
        keep_command(ticks, self.memory)

    def skip(self) -> None:
        """A tick without a measurement: nothing is marked."""
        self._row["marks"] = 0

    def reaction(self, reason: Reason) -> Reaction:
        """What ``reason`` leads to on this robot."""
        return self._reactions[reason]

    @property
    def marks(self) -> int:
        """``Clamp`` bits that the guard set in this tick."""
        return int(self._row["marks"])

    @property
    def speed_share(self) -> float:
        """Share of the commanded velocity that heat and supply leave."""
        return float(self._row["speed_share"])

    @property
    def torque_share(self) -> float:
        """Share of the peak torque that the most limited motor is given, the soft start aside."""
        bound = np.where(
            self._row["torque_cause"] == _SOFT_START, self.bounds[0]["peak_torque"], self._row["torque_bound"]
        )
        return float((bound / self.bounds[0]["peak_torque"]).min())

    @property
    def mean_square(self) -> Array:
        """Squared torque of every motor through the thermal low-pass, N²·m². Shape (4, 3)."""
        square: Array = self._row["mean_square"]
        return square

    @property
    def imu_believed(self) -> bool:
        """Whether this tick has an attitude that can be computed with."""
        return bool(self._row["imu_missing"] <= self.config.imu_extrapolation)

    def carried_imu(self) -> ImuSample | None:
        """The sample to compute with where this tick's own is missing or old; None where it is good."""
        if not int(self._row["marks"]) & _EXTRAPOLATED:
            return None
        imu = self._row["imu"].copy()
        return ImuSample(float(self._row["imu_stamp"]), imu[:4], imu[4:7], imu[7:])

    def evidence(self, reason: Reason) -> Evidence:
        """What, where, how much and against which bound, of the last verdict."""
        row = self._row
        if reason is not _REASONS.get(int(row["reason"])):
            return Evidence(reason=reason.name.lower(), words=reason.words)
        where = joint_name(int(row["where"])) if row["where"] >= 0 else ""
        scale, digits, unit = _UNITS.get(reason, (1.0, 2, ""))
        value, bound = float(row["value"]) * scale, float(row["bound"]) * scale
        said = reason.words if not where else f"{where}: {reason.words}"
        if reason is Reason.MOTOR_FAULT:
            said += f" (code {value:.0f})"
        elif math.isfinite(value) and unit:
            said += f" ({value:.{digits}f} {unit}, bound {round(bound, 6):g})"
        return Evidence(
            reason=reason.name.lower(),
            words=said,
            where=where,
            value=value if math.isfinite(value) else None,
            bound=bound,
            unit=unit,
        )

    def explain(self, reason: Reason) -> str:
        """One line for people about the last verdict: what, where, value and bound."""
        return self.evidence(reason).words

    def _set_limits(self, description: RobotDescription, limits: LimitsConfig, period: float) -> None:
        b = self.bounds[0]
        for reason in Reason:
            b["reaction"][reason] = reaction(reason, limits.sit_down)
        b["period"], b["cos_tilt"], b["age"] = period, math.cos(limits.max_tilt), limits.max_age
        b["temperature"], b["voltage"] = limits.max_temperature, limits.min_voltage
        b["angular_velocity"], b["acceleration"] = limits.max_angular_velocity, limits.max_acceleration
        b["stall_stand"], b["stall_damp"] = limits.stall_stand, limits.stall_damp
        b["imu_ticks"], b["frozen_time"] = limits.imu_extrapolation, limits.frozen_time
        b["attitude_jump"], b["gravity_error"] = limits.max_attitude_jump, limits.max_gravity_error
        b["turn_error"] = limits.max_turn_error * limits.turn_error_time
        b["turn_keep"] = math.exp(-period / limits.turn_error_time)
        b["gravity_share"] = _share(period, limits.gravity_error_time)
        b["position_jump"], b["position_noise"] = limits.max_position_jump, limits.max_position_noise
        b["noise_share"], b["torque_share"] = _share(period, NOISE_TIME), limits.min_torque_share
        b["torque_follow"], b["rest_follow"] = _share(period, limits.torque_share_time), _share(period, REST_TIME)
        b["tracking_error"], b["tracking_time"] = limits.max_tracking_error, limits.tracking_time
        b["overspeed"], b["overspeed_time"] = limits.max_overspeed, limits.overspeed_time - 0.5 * period
        b["stuck_time"], b["stuck_motion"] = limits.stuck_time - 0.5 * period, limits.stuck_motion
        b["stuck_tilt"], b["stuck_told"] = limits.stuck_tilt, limits.stuck_told
        b["roughness"], b["overreach"] = limits.max_roughness, limits.max_overreach
        b["stuck_torque"], b["clamped_torque"] = limits.stuck_torque, limits.clamped_torque
        b["stop_lower"] = np.array(description.joints.lower) + limits.joint_margin
        b["stop_upper"] = np.array(description.joints.upper) - limits.joint_margin
        b["thermal_share"] = _share(period, limits.thermal_time)
        b["joint_velocity"] = description.joints.max_velocity
        b["peak_torque"], b["continuous_torque"] = description.joints.peak_torque, description.joints.continuous_torque

    def _set_degrade(self, degrade: DegradeConfig, limits: LimitsConfig, soft_start: float, period: float) -> None:
        b = self.bounds[0]
        b["thermal_start"], b["thermal_floor"] = degrade.thermal_start, degrade.thermal_floor
        b["current_start"], b["speed_floor"] = degrade.current_start, degrade.speed_floor
        b["voltage_start"], b["soft_start"] = degrade.voltage_start, period / soft_start
        b["soak_keep"] = math.exp(-period / SOAK_TIME)

    def _set_action(self, action: BoundsConfig | None) -> None:
        shift, force, moment = (0.15, (250.0,) * 3, (100.0,) * 3) if action is None else (
            action.shift, action.force, action.moment
        )  # fmt: skip
        self.bounds[0]["action"] = self.config.policy_bound * np.array([shift] * 12 + [*force, *moment])


SOAK_TIME = 1.0
"""Time constant of what is remembered of the loop's punctuality, s."""
_REASONS = {int(reason): reason for reason in Reason}
_UNITS: dict[Reason, tuple[float, int, str]] = {
    Reason.TILTED: (1.0, 2, "rad"),
    Reason.STALE_MOTOR: (1e3, 0, "ms"),
    Reason.STALE_IMU: (1e3, 0, "ms"),
    Reason.IMPLAUSIBLE_IMU: (1.0, 2, "rad/s, m/s² or norm"),
    Reason.FROZEN_IMU: (1e3, 0, "ms"),
    Reason.ATTITUDE_JUMP: (1.0, 2, "rad"),
    Reason.TURN_ERROR: (1.0, 3, "rad"),
    Reason.GRAVITY_ERROR: (1.0, 1, "m/s²"),
    Reason.HOT_MOTOR: (1.0, 0, "°C"),
    Reason.JOINT_SPEED: (1.0, 1, "rad/s"),
    Reason.LOW_VOLTAGE: (1.0, 1, "V"),
    Reason.OVERLOAD: (1.0, 1, "N·m"),
    Reason.JUMPING_ENCODER: (1.0, 2, "rad"),
    Reason.NOISY_ENCODER: (1.0, 3, "rad"),
    Reason.STUCK_ENCODER: (1e3, 0, "ms"),
    Reason.TORQUE_LOST: (1.0, 2, "of the commanded torque"),
    Reason.REVERSED_MOTOR: (1.0, 2, "of the commanded torque"),
    Reason.ASTRAY: (1.0, 2, "rad"),
    Reason.STALLED: (1e3, 0, "ms"),
    Reason.FALLING: (1.0, 2, "m"),
    Reason.LATE_LOOP: (1e3, 0, "ms"),
    Reason.BAD_POLICY: (1.0, 1, "m, N or N·m"),
    Reason.BAD_COMMAND: (1.0, 1, "N·m"),
}
"""Scale, digits and unit in which a verdict's evidence is told."""


def _share(period: float, time: float) -> float:
    """Of one tick in a first-order low-pass of time constant ``time``."""
    return 1.0 - math.exp(-period / time)


def joint_name(index: int) -> str:
    """``FL knee`` for 2."""
    return f"{LEGS[index // 3]} {JOINTS[index % 3]}"


def tilt(orientation: Array) -> float:
    """Angle between the body's z and the world's, rad, of a quaternion w x y z (4,)."""
    _, x, y, _ = orientation
    return math.acos(min(1.0, max(-1.0, 1.0 - 2.0 * (x * x + y * y))))
