"""One tick between two exchanges: judge → mode → command → bound, all into one record.

Synchronous, without clock or wire: time, measurement and requests come in, one ``JointCommand`` goes out. The daemon
calls it on the robot, tests and replays call it on anything.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.robot import Array, JointCommand, Measurement, damp_command
from runtime import modes
from runtime.config import Config
from runtime.control.controller import Controller, alike
from runtime.control.policy import Policy
from runtime.control.posture import POSTURE_DTYPE, Posture, blend, minimum_jerk
from runtime.control.records import CONTROL_DTYPE, Clamp, Records, SolverStatus, VelocityCommand
from runtime.control.state import STATE_DTYPE
from runtime.limits import Guard
from runtime.messages import CONTROL_OFFSET, TICK_DTYPE, TUNED, Event, Mode, Request
from runtime.modes import Answer, ModeState, Reason

EVENTS = 256
"""Events that wait for the link at most; the oldest go first."""

_DAMP, _STAND_UP, _STAND, _WALK, _SIT_DOWN = Mode  # an enum's attribute costs a microsecond before Python 3.12
_OK, _NOT_FINITE, _SOLVER_FAILED = Reason.OK, Reason.NOT_FINITE, Reason.SOLVER_FAILED
_FAILED = int(SolverStatus.FAILED)
_EXPIRED = int(Clamp.EXPIRED)
_COMMAND_FIELDS = ("position", "velocity", "kp", "kd", "torque")
_PLAN_FIELDS = ("velocity_command", "observation", "asked", "action", "phase", "stance", "touchdown", "foot_targets")
_BLANK_FIELDS = (*_PLAN_FIELDS, "target_wrench", "grf", "solver_status", "clamps")


KEYFRAME_DTYPE = np.dtype(
    [
        ("index", "u8"),  # of the tick at whose end it was taken
        ("control", STATE_DTYPE),
        ("posture", POSTURE_DTYPE),
        ("mean_square", "f8", (4, 3)),
        ("command", "f8", (5, 4, 3)),
        ("blend_from", "f8", (5, 4, 3)),
        ("blend_left", "f8"),
        ("velocity", "f8", (3,)),
        ("velocity_stamp", "f8"),
        ("mode", "u1"),
        ("armed", "u1"),
        ("reason", "u2"),
        ("fault", "u2"),
        ("verdict", "u2"),
    ],
    align=True,
)
"""What a cycle remembers from tick to tick: with it a replay can begin in the middle."""


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


class Cycle:
    """One robot's mode, its sources of commands and the record of the tick."""

    def __init__(self, config: Config, policy: Policy) -> None:
        """Build and compile everything that a tick needs.

        Raises:
            ValueError: a pose or a solver that cannot be.
        """
        self.config = config
        self.tick = np.zeros(1, TICK_DTYPE)
        """The record of this tick. Shape (1,)."""
        self.state = ModeState()
        self.events: deque[Event] = deque(maxlen=EVENTS)
        """What happened and was not yet told."""
        self.generation = 1
        """Number of policies that were active so far."""
        self.outgoing = 0
        """Generation of the policy that is being handed over from; 0 for none."""
        self.clamps = [0] * len(Clamp)
        """How often each clamp acted."""
        self.solver = [0] * len(SolverStatus)
        """How often each solver status came, in ticks that stepped the controller."""
        control = self.tick.view(np.uint8)[CONTROL_OFFSET:].view(CONTROL_DTYPE)
        self.controller = Controller(config.robot, config.control, policy, control)
        self.guard = Guard(config.robot, config.limits, config.control.rate_hz)
        self.posture = Posture(config.robot, config.control, config.posture)
        self._damp = damp_command(config.damp.kd)
        self._command = self._damp
        self._blend_from = self._damp
        self._blend_left = 0.0
        self._velocity = VelocityCommand()
        self._rest = VelocityCommand()
        self._verdict = Reason.NOT_READY
        self._problems: Sequence[str] = ()
        self._row = self.tick[0]  # a view: what is written into it is in the record
        self._views = {name: self.tick[name][0] for name in TICK_DTYPE.names or () if self.tick[name].ndim > 1}
        self._tuned = self.tick.view(np.float64)[TUNED]
        self._command_views = tuple(self._views[f"command_{name}"] for name in _COMMAND_FIELDS)

    @property
    def policy(self) -> Policy:
        """The active policy."""
        return self.controller.policy

    @property
    def health(self) -> str:
        """What the guard says of the last measurement; empty when all is in order."""
        return "" if self._verdict is _OK else self.guard.explain(self._verdict, self.tick)

    def swap_policy(self, policy: Policy, share: float = 1.0) -> None:
        """Take another policy, between two ticks; below a ``share`` of one the policy before has the rest.

        Two that differ in kind have nothing between them: there the command is blended, as between two modes.
        """
        kin = alike(self.controller.policy, policy)
        if share < 1.0 and kin:
            self.outgoing = self.generation
            self.controller.hand_over(policy)
            self.controller.share = share
        else:
            self.outgoing = 0
            self.controller.policy = policy
        if not kin:
            self.controller.state["remembered"] = 0
            if self.state.mode is _STAND or self.state.mode is _WALK:
                self._blend_from, self._blend_left = self._command, self.config.posture.blend_time
        self.generation += 1
        self.note("policy", f"{policy.name} is active")

    def share_policy(self, share: float) -> None:
        """How much of the active policy acts from the next tick on; at one the outgoing policy is gone."""
        self.controller.share = share
        if share >= 1.0:
            self.outgoing = 0

    def tune(self, values: Array) -> None:
        """Put a recorded row of tuned numbers in force, shape (TUNING_SIZE,), between two ticks."""
        self.controller.tuning[1:] = values[1:]
        if values[0] != self.controller.tuning[0]:
            self.share_policy(float(values[0]))

    def warm_up(self, measurement: Measurement) -> None:
        """Run every path of a tick once, so that nothing compiles later; leaves the state as it was."""
        self.guard.reset()
        self.controller.warm_up(measurement)
        self.posture.stand_up(measurement)
        self.posture.step()
        self.posture.reset()
        self.tick[:] = 0

    def step(self, wake: Wake, measurement: Measurement) -> JointCommand:
        """From a measurement to the command that acts from the next exchange on."""
        self._begin(wake)
        self._note_measurement(measurement)
        self._verdict = self.guard.judge(self.tick)
        walk_lost = wake.stamp - self._velocity.stamp > self.config.command.stand_after
        before = self.state
        self.state = modes.advance(before, self._verdict, self.posture.finished, walk_lost)
        self._changed(before, measurement)
        command = self._bounded(self._source(wake, measurement), measurement)
        self._note_command(command)
        return command

    def silent(self, wake: Wake, words: str) -> JointCommand:
        """A tick whose exchange brought nothing back: damp, and say so."""
        self._begin(wake)
        self._verdict = Reason.BODY_SILENT
        self._fail(Reason.BODY_SILENT, words)
        self._note_command(self._damp)
        return self._damp

    def request(self, wish: Request, measurement: Measurement | None) -> tuple[Answer, str]:
        """Answer the operator between two ticks; the words name every obstacle."""
        before = self.state
        problems = self.guard.arming_problems(self.tick) if wish is Request.ARM and measurement is not None else []
        settled = bool(self._views["stance"].all())
        answer = modes.request(before, wish, self._verdict, not problems, settled)
        self.state = answer.state
        words = answer.reason.words
        if answer.reason is Reason.NOT_READY:
            words = "; ".join(problems) or words
        elif answer.reason.is_fault:
            words = self.guard.explain(answer.reason, self.tick)
        if not answer.accepted:
            self.note("refused", f"{wish.value}: {words}")
        if measurement is not None:
            self._changed(before, measurement)
        return answer, words

    def command_velocity(self, command: VelocityCommand) -> None:
        """Take the newest velocity command; it counts from its stamp."""
        self._velocity = command

    def damp(self, reason: Reason) -> None:
        """Damp and disarm for a reason of the daemon's own."""
        before = self.state
        self.state = ModeState(Mode.DAMP, False, reason, before.fault)
        self._enter(before)

    def remember(self) -> Records:
        """All that the next tick depends on beside this tick's record. Shape (1,) of ``KEYFRAME_DTYPE``."""
        keyframe = np.zeros(1, KEYFRAME_DTYPE)
        k, state = keyframe[0], self.state
        k["index"], k["control"], k["mean_square"] = (
            self._row["index"],
            self.controller.state[0],
            self.guard.mean_square,
        )
        for key, command in (("command", self._command), ("blend_from", self._blend_from)):
            for row, name in enumerate(_COMMAND_FIELDS):
                k[key][row] = getattr(command, name)
        k["blend_left"], k["velocity_stamp"] = self._blend_left, self._velocity.stamp
        k["velocity"][:2], k["velocity"][2] = self._velocity.linear, self._velocity.yaw_rate
        k["mode"], k["armed"], k["reason"] = int(state.mode), state.armed, int(state.reason)
        k["fault"], k["verdict"] = int(state.fault), int(self._verdict)
        self.posture.remember(k["posture"])
        return keyframe

    def recall(self, keyframe: Records, tick: Records) -> None:
        """Be as after the tick ``tick`` (1,), at whose end ``keyframe`` (1,) was remembered."""
        k = keyframe[0]
        self.tick[:] = tick
        self.controller.state[:] = keyframe["control"]
        self.guard.mean_square[:] = k["mean_square"]
        self._command = JointCommand(*k["command"].copy())
        self._blend_from = JointCommand(*k["blend_from"].copy())
        self._blend_left = float(k["blend_left"])
        velocity = k["velocity"].copy()
        self._velocity = VelocityCommand(float(k["velocity_stamp"]), velocity[:2], float(velocity[2]))
        self.state = ModeState(
            Mode(int(k["mode"])), bool(k["armed"]), Reason(int(k["reason"])), Reason(int(k["fault"]))
        )
        self._verdict = Reason(int(k["verdict"]))
        self.generation, self.outgoing = int(self._row["policy"]), int(self._row["outgoing"])
        self.tune(self._tuned)
        self.posture.recall(k["posture"])

    def note(self, kind: str, text: str) -> None:
        """Add an event."""
        tick = self.tick[0]
        self.events.append(Event(stamp=float(tick["stamp"]), tick=int(tick["index"]), kind=kind, text=text))

    def _begin(self, wake: Wake) -> None:
        row = self._row
        row["index"], row["stamp"], row["period"] = wake.index, wake.stamp, wake.elapsed
        row["lateness"], row["overruns"], row["policy"] = wake.lateness, wake.overruns, self.generation
        row["clamps"], row["outgoing"] = 0, self.outgoing
        self._tuned[:] = self.controller.tuning

    def _note_measurement(self, measurement: Measurement) -> None:
        row, views = self._row, self._views
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

    def _source(self, wake: Wake, measurement: Measurement) -> JointCommand:
        """This mode's command, before bounds."""
        mode = self.state.mode
        if mode is _DAMP:
            if self._verdict is not _NOT_FINITE:
                self.controller.estimate(measurement)
            return self._damp
        if mode is _STAND_UP or mode is _SIT_DOWN:
            self.controller.estimate(measurement)
            return self._blended(self.posture.step())
        if mode is _STAND:
            command = self.controller.step(measurement, self._rest, True)
        else:
            command = self._walk(wake.stamp, measurement)
        self.solver[int(self._row["solver_status"])] += 1
        return self._blended(command)

    def _walk(self, now: float, measurement: Measurement) -> JointCommand:
        """Follow the newest command, or rest once it is too old; the controller bounds how fast it follows."""
        expired = now - self._velocity.stamp > self.config.command.expiry
        command = self.controller.step(measurement, self._rest if expired else self._velocity, False)
        if expired:
            self._velocity = VelocityCommand(stamp=self._velocity.stamp)
            self._row["clamps"] = int(self._row["clamps"]) | _EXPIRED
        return command

    def _blended(self, command: JointCommand) -> JointCommand:
        if self._blend_left <= 0.0:
            return command
        self._blend_left -= 1.0 / self.config.control.rate_hz
        share = minimum_jerk(1.0 - self._blend_left / self.config.posture.blend_time)
        return blend(self._blend_from, command, share)

    def _bounded(self, command: JointCommand, measurement: Measurement) -> JointCommand:
        """The command with its torque cut, or damp when it cannot be trusted."""
        mode = self.state.mode
        if mode is _DAMP:
            return self._damp
        if (mode is _STAND or mode is _WALK) and int(self._row["solver_status"]) == _FAILED:
            self._fail(_SOLVER_FAILED, _SOLVER_FAILED.words)
            return self._damp
        self._write(command)
        reason = self.guard.bound(self.tick)
        if reason is not _OK:
            self._fail(reason, reason.words)
            return self._damp
        torque = self._command_views[4].copy()
        return JointCommand(command.position, command.velocity, command.kp, command.kd, torque)

    def _write(self, command: JointCommand) -> None:
        position, velocity, kp, kd, torque = self._command_views
        position[:], velocity[:], kp[:] = command.position, command.velocity, command.kp
        kd[:], torque[:] = command.kd, command.torque

    def _note_command(self, command: JointCommand) -> None:
        if command is self._damp:
            self._write(command)
        row, state = self._row, self.state
        row["mode"], row["armed"], row["reason"] = int(state.mode), state.armed, int(state.reason)
        asked = self._velocity if state.mode is _WALK else self._rest
        vector = self._views["asked_velocity"]
        vector[:2], vector[2] = asked.linear, asked.yaw_rate
        bits = int(row["clamps"])
        while bits:
            lowest = bits & -bits
            self.clamps[lowest.bit_length() - 1] += 1
            bits ^= lowest
        self._command = command

    def _fail(self, reason: Reason, words: str) -> None:
        """Damp for ``reason``; an armed robot keeps it as the fault that stands."""
        before = self.state
        self.state = modes.advance(before, reason, False, False)
        if self.state is not before:
            self.note("fault", words)
            self._enter(before)

    def _changed(self, before: ModeState, measurement: Measurement) -> None:
        """Tell of a change of state and make its new mode ready."""
        if self.state == before:
            return
        if self.state.reason.is_fault and self.state.fault is not before.fault:
            self.note("fault", self.guard.explain(self.state.reason, self.tick))
        self._enter(before)
        if self.state.mode is before.mode:
            return
        match self.state.mode:
            case Mode.STAND_UP:
                self.posture.stand_up(measurement)
            case Mode.SIT_DOWN:
                self.posture.sit_down(measurement, bearing=before.mode is Mode.STAND)
            case Mode.STAND if before.mode is Mode.STAND_UP:
                self.controller.reset(measurement)
            case Mode.WALK:
                self._velocity = VelocityCommand(stamp=float(self.tick["stamp"][0]))

    def _enter(self, before: ModeState) -> None:
        """What every change of mode or arming does."""
        state = self.state
        if state.mode is not before.mode:
            self.note("mode", f"{before.mode.name} -> {state.mode.name}: {state.reason.words}")
            self._blend_from, self._blend_left = self._command, self.config.posture.blend_time
            for name in _BLANK_FIELDS:
                self.tick[name] = 0
            if state.mode is Mode.DAMP or before.mode is Mode.DAMP:
                self._blend_left = 0.0
            if state.mode is Mode.DAMP:
                self.posture.reset()
        elif state.armed != before.armed or state.fault is not before.fault:
            self.note("mode", f"{state.mode.name}: {state.reason.words}")
