"""The arming list: everything that must be in order before any motor gets torque, each with ok or the reason.

The same on the simulator, the wire twin and the robot. What only the shell knows (operator, calibration) comes in as
checks that are already made.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from drivers.description import RobotDescription
from drivers.robot import Array
from runtime.control.kinematics import GRAVITY
from runtime.control.policy import Policy
from runtime.control.records import Records, VelocityCommand
from runtime.guard import Guard, joint_name, tilt
from runtime.messages.mode import ArmingCheck, Mode
from runtime.parameters import ArmingConfig, LimitsConfig
from runtime.reasons import Reason

REST = 1e-3
"""m/s and rad/s: a smaller command is none."""


def check(name: str, problems: Sequence[str], words: str) -> ArmingCheck:
    """One line of the list: ``words`` where there is no problem."""
    return ArmingCheck(name, not problems, "; ".join(problems) or words)


class Arming:
    """The list of one robot."""

    def __init__(
        self, description: RobotDescription, limits: LimitsConfig, config: ArmingConfig, poses: Sequence[Array]
    ) -> None:
        """``poses`` are the known ones, each (4, 3), rad."""
        self.limits, self.config = limits, config
        self.weight = description.mass * GRAVITY
        self._name = description.name
        self._range = np.array(description.joints.lower), np.array(description.joints.upper)
        self._poses = np.array(poses)

    def examine(
        self, ticks: Records, guard: Guard, verdict: Reason, policy: Policy, velocity: VelocityCommand, now: float
    ) -> list[ArmingCheck]:
        """Every check on this tick's record (1,); ``now`` and the stamp of the newest ``velocity`` in s monotonic."""
        t = ticks[0]
        return [
            check("guard", [] if verdict is Reason.OK else [guard.explain(verdict)], "nothing wrong in this tick"),
            check("motors", list(self._motors(t)), "12 answer without fault"),
            check("joints", list(self._joints(t)), "inside their ranges, near a known pose"),
            check("imu", list(self._imu(t, guard)), f"alive, tilted {tilt(t['orientation']):.2f} rad"),
            check("contacts", list(self._contacts(t)), "limp legs feel no more than they can"),
            check("supply", list(self._supply(t)), f"{t['voltage']:.1f} V"),
            check("temperature", list(self._heat(t)), f"hottest motor {float(t['joint_temperature'].max()):.0f} °C"),
            check("timing", list(self._timing(guard)), self._punctual(guard)),
            check("policy", list(self._policy(policy)), f"{policy.name}, for {policy.robot}"),
            check("sticks", list(self._sticks(velocity, now)), "no velocity is asked for"),
        ]

    def _motors(self, t: np.void) -> Iterator[str]:
        if t["mode"] != Mode.DAMP:
            yield "they have not been damped for a tick"
        age, fault = t["joint_age"].ravel(), t["joint_fault"].ravel()
        for index in np.flatnonzero(~(age <= self.limits.max_age)):
            yield f"{joint_name(int(index))} last answered {age[index] * 1e3:.0f} ms ago"
        for index in np.flatnonzero(fault):
            yield f"{joint_name(int(index))} reports fault {fault[index]}"

    def _joints(self, t: np.void) -> Iterator[str]:
        lower, upper = self._range
        position, margin = t["joint_position"], self.limits.joint_margin
        outside = ~((position >= lower - margin) & (position <= upper + margin))
        for leg, joint in np.argwhere(outside):
            yield (
                f"{joint_name(3 * leg + joint)} at {position[leg, joint]:.2f} rad,"
                f" range {lower[leg, joint]:g} to {upper[leg, joint]:g}"
            )
        away = np.abs(position - self._poses).min(axis=0)
        for leg, joint in np.argwhere((away > self.config.pose_tolerance) & ~outside):
            yield (
                f"{joint_name(3 * leg + joint)} at {position[leg, joint]:.2f} rad is {away[leg, joint]:.2f} from any"
                f" known pose, bound {self.config.pose_tolerance:g}: fold the legs, or commission anew"
            )

    def _imu(self, t: np.void, guard: Guard) -> Iterator[str]:
        age = float(t["measured_stamp"] - t["imu_stamp"])
        if not age <= self.limits.max_age:
            yield f"last sample {age * 1e3:.0f} ms ago, bound {self.limits.max_age * 1e3:.0f}"
        if not (angle := tilt(t["orientation"])) <= self.limits.arming_tilt:
            yield f"tilted {angle:.2f} rad, bound {self.limits.arming_tilt:g}"
        felt = float(np.linalg.norm(guard.memory[0]["felt"]))
        if not abs(felt - GRAVITY) <= self.config.gravity_tolerance:
            yield f"felt {felt:.1f} m/s² lately, bound {GRAVITY:g} ± {self.config.gravity_tolerance:g}"

    def _contacts(self, t: np.void) -> Iterator[str]:
        bound = self.config.contact_share * self.weight
        force = np.abs(t["contact_force"]).max()
        if not force <= bound:
            yield f"a limp leg feels {force:.0f} N, bound {bound:.0f}"

    def _supply(self, t: np.void) -> Iterator[str]:
        if t["voltage"] < self.limits.arming_voltage:
            yield f"supply {t['voltage']:.1f} V, bound {self.limits.arming_voltage:g}"

    def _heat(self, t: np.void) -> Iterator[str]:
        if not (hottest := float(t["joint_temperature"].max())) <= self.limits.arming_temperature:
            yield f"hottest motor {hottest:.0f} °C, bound {self.limits.arming_temperature:g}"

    def _timing(self, guard: Guard) -> Iterator[str]:
        m, config = guard.memory[0], self.config
        if m["ran"] < config.soak_time:
            yield f"runs for {m['ran']:.1f} s, wait for {config.soak_time:g}"
        if m["missed"] > config.max_missed:
            yield f"{m['missed']:.0%} of the ticks missed lately, bound {config.max_missed:.0%}"
        if m["late"] > config.max_lateness:
            yield f"a tick {m['late'] * 1e3:.0f} ms late lately, bound {config.max_lateness * 1e3:.0f}"

    def _punctual(self, guard: Guard) -> str:
        m = guard.memory[0]
        return f"{m['missed']:.1%} missed, latest {m['late'] * 1e3:.1f} ms"

    def _policy(self, policy: Policy) -> Iterator[str]:
        if policy.robot != self._name:
            yield f"{policy.name} is for {policy.robot}, this is {self._name}"

    @staticmethod
    def _sticks(velocity: VelocityCommand, now: float) -> Iterator[str]:
        fastest = max(abs(float(v)) for v in (*velocity.linear, velocity.yaw_rate))
        if fastest > REST:
            yield f"a velocity of {fastest:.2f} was asked for last, {now - velocity.stamp:.1f} s ago: centre the sticks"
