"""The record of one tick and what writes into it: a view a field, because a field by its name costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.robot import Array, JointCommand, Measurement
from runtime.control.records import CONTROL_DTYPE
from runtime.messages.tick import CONTROL_OFFSET, TICK_DTYPE, TUNED
from runtime.sources import COMMAND_FIELDS

_PLAN_FIELDS = ("velocity_command", "observation", "asked", "action", "phase", "stance", "touchdown", "foot_targets")
_BLANK_FIELDS = (*_PLAN_FIELDS, "target_wrench", "grf", "solver_status", "clamps")


@dataclass(frozen=True, slots=True)
class Wake:
    """What the ticker says of the tick that begins."""

    index: int
    stamp: float
    """s monotonic."""
    elapsed: float
    """Since the tick before, s."""
    lateness: float
    """s."""
    overruns: int
    """Since the start."""


class TickRecord:
    """This tick, as telemetry and flight log will have it."""

    def __init__(self) -> None:
        self.tick = np.zeros(1, TICK_DTYPE)
        """The record. Shape (1,)."""
        self.control = self.tick.view(np.uint8)[CONTROL_OFFSET:].view(CONTROL_DTYPE)
        """The core's part of it. Shape (1,)."""
        self.row = self.tick[0]
        """The same as one row: what is written into it is in the record."""
        self.views = {name: self.tick[name][0] for name in TICK_DTYPE.names or () if self.tick[name].ndim > 1}
        """Its arrays, by name."""
        self._tuned = self.tick.view(np.float64)[TUNED]
        self._command = tuple(self.views[f"command_{name}"] for name in COMMAND_FIELDS)

    def begin(self, wake: Wake, policy: int, outgoing: int, tuning: Array) -> None:
        """Open the tick: when it woke, the generations of the policies that act, the tuned numbers in force."""
        row = self.row
        row["index"], row["stamp"], row["period"] = wake.index, wake.stamp, wake.elapsed
        row["lateness"], row["overruns"], row["policy"] = wake.lateness, wake.overruns, policy
        row["clamps"], row["outgoing"] = 0, outgoing
        self._tuned[:] = tuning

    def write_measurement(self, measurement: Measurement) -> None:
        """What the body told."""
        row, views = self.row, self.views
        imu, joints = measurement.imu, measurement.joints
        row["measured_stamp"], row["imu_stamp"], row["voltage"] = measurement.stamp, imu.stamp, measurement.voltage
        views["orientation"][:] = imu.orientation
        views["angular_velocity"][:] = imu.angular_velocity
        views["linear_acceleration"][:] = imu.linear_acceleration
        views["joint_position"][:] = joints.position
        views["joint_velocity"][:] = joints.velocity
        views["joint_torque"][:] = joints.torque
        views["joint_temperature"][:] = joints.temperature
        views["joint_fault"][:] = joints.fault
        views["joint_age"][:] = joints.age

    def write_command(self, command: JointCommand) -> None:
        """What is to leave, before or after its bounds."""
        position, velocity, kp, kd, torque = self._command
        position[:], velocity[:], kp[:] = command.position, command.velocity, command.kp
        kd[:], torque[:] = command.kd, command.torque

    def bounded(self, command: JointCommand) -> JointCommand:
        """``command`` with the torque that stands in the record, where the guard has cut it."""
        return JointCommand(command.position, command.velocity, command.kp, command.kd, self._command[4].copy())

    def blank_plan(self) -> None:
        """Forget what the core had planned: the mode has changed."""
        for name in _BLANK_FIELDS:
            self.tick[name] = 0
