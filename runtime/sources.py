"""Where a tick's command comes from: the mode's posture or controller, the operator's velocity, and the hand-over."""

from __future__ import annotations

import numpy as np

from drivers.robot import JointCommand, Measurement, damp_command
from runtime.config import Config
from runtime.control.controller import Controller
from runtime.control.posture import Posture, blend, minimum_jerk
from runtime.control.records import Clamp, SolverStatus, VelocityCommand
from runtime.messages.mode import Mode

COMMAND_FIELDS = ("position", "velocity", "kp", "kd", "torque")
_DAMP, _STAND_UP, _STAND, _WALK, _SIT_DOWN = Mode  # an enum's attribute costs a microsecond before Python 3.12
_STOPPING = int(Clamp.STOPPING)
_EXPIRED, _SPEED, _BLEND, _FALLBACK = int(Clamp.EXPIRED), int(Clamp.SPEED), int(Clamp.BLEND), int(Clamp.FALLBACK)
_LEAST_SQUARES = int(SolverStatus.LEAST_SQUARES)


class Sources:
    """One robot's controller, postures and velocity command, and what was commanded last."""

    def __init__(self, config: Config, controller: Controller) -> None:
        """Plan the postures.

        Raises:
            ValueError: a pose that cannot be.
        """
        self.controller = controller
        self.posture = Posture(config.robot, config.control, config.posture)
        self.damp = damp_command(config.damp.kd)
        self.fall = damp_command(config.damp.fall_kd)
        self.command = self.damp
        """The last one that left."""
        self.blend_from = self.damp
        self.blend_left = 0.0
        """s of the hand-over that are left."""
        self.fall_left = 0.0
        """s of the soft fall that are left."""
        self.velocity = VelocityCommand()
        """The operator's newest."""
        self.rest = VelocityCommand()
        self.marks = 0
        """Clamp bits of this tick."""
        self._expiry, self._period = config.command.expiry, 1.0 / config.control.rate_hz
        self._blend_time, self._fall_time = config.posture.blend_time, config.damp.fall_time
        self._solver_status = controller.record[0]  # a view of one record

    def step(self, mode: Mode, now: float, measurement: Measurement, believed: bool, share: float) -> JointCommand:
        """This mode's command, before bounds.

        Args:
            mode: of this tick.
            now: s monotonic.
            measurement: as the guard believes it.
            believed: its attitude can be computed with.
            share: of the commanded velocity that may be followed; 0 where the robot is to stop.
        """
        self.marks = 0
        if mode is _STAND or mode is _WALK:
            command = self._controlled(mode is _STAND, now, measurement, share)
            return self._blended(command)
        if believed:
            self.controller.estimate(measurement)
        if mode is _DAMP:
            return self.limp()
        return self._blended(self.posture.step())

    def limp(self) -> JointCommand:
        """Damping only; more of it for a while after a fault took a robot that stood to damp.

        A walking one is better off with less: stiff legs trip it, and it falls over them.
        """
        if self.fall_left <= 0.0:
            return self.damp
        self.fall_left -= self._period
        return self.fall

    def change(
        self,
        before: Mode,
        after: Mode,
        measurement: Measurement | None,
        fault: bool,
        now: float,
        moving: bool = False,
        falls: bool = False,
    ) -> None:
        """Make ready for a mode that differs from the one before; without a measurement it is DAMP.

        ``moving``: it walks, or stands on less than four feet; ``falls``: and cannot be caught any more.
        """
        self.hand_over()
        if _DAMP in (before, after):
            self.blend_left = 0.0
        self.fall_left = self._fall_time if after is _DAMP and fault and before is not _WALK else 0.0
        if after is _DAMP or measurement is None:
            self.posture.reset()
        elif after is _STAND_UP:
            self.posture.stand_up(measurement)
        elif after is _SIT_DOWN and moving:
            self.posture.brace(measurement, falls)
            self.blend_left = 0.0
        elif after is _SIT_DOWN:
            self.posture.sit_down(measurement, bearing=before in (_STAND, _WALK))
        elif after is _STAND and before is _STAND_UP:
            self.controller.reset(measurement)
        elif after is _WALK:
            self.velocity = VelocityCommand(stamp=now)

    def hand_over(self) -> None:
        """Blend from the last command to whatever comes next."""
        self.blend_from, self.blend_left = self.command, self._blend_time

    def _controlled(self, standing: bool, now: float, measurement: Measurement, share: float) -> JointCommand:
        if standing:
            command = self.controller.step(measurement, self.rest, True)
        else:
            command = self.controller.step(measurement, self._wanted(now, share), False)
        if int(self._solver_status["solver_status"]) == _LEAST_SQUARES:
            self.marks |= _FALLBACK
        return command

    def _wanted(self, now: float, share: float) -> VelocityCommand:
        """The newest velocity, or rest once it is too old; the controller bounds how fast it is followed."""
        if now - self.velocity.stamp > self._expiry:
            self.marks |= _EXPIRED
            self.velocity = VelocityCommand(stamp=self.velocity.stamp)
            return self.rest
        if share == 0.0:
            self.marks |= _STOPPING
            self.velocity = VelocityCommand(stamp=self.velocity.stamp)
            return self.rest
        velocity = self.velocity
        if share < 1.0 and (velocity.yaw_rate or velocity.linear.any()):
            self.marks |= _SPEED
            return VelocityCommand(velocity.stamp, share * velocity.linear, share * velocity.yaw_rate)
        return velocity

    def _blended(self, command: JointCommand) -> JointCommand:
        if self.blend_left <= 0.0:
            return command
        self.blend_left -= self._period
        share = minimum_jerk(1.0 - self.blend_left / self._blend_time)
        mixed = blend(self.blend_from, command, share)
        if any(not np.array_equal(getattr(mixed, name), getattr(command, name)) for name in COMMAND_FIELDS):
            self.marks |= _BLEND
        return mixed
