"""One tick between two exchanges: judge → mode → command → bound, all into one record.

Synchronous, without clock or wire: time, measurement and requests come in, one ``JointCommand`` goes out. The daemon
calls it on the robot, tests and replays call it on anything.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from drivers.robot import LEGS, Array, JointCommand, Measurement
from runtime import keyframe, modes
from runtime.arming import Arming
from runtime.config import Config
from runtime.control.controller import Controller, alike
from runtime.control.policy import Policy
from runtime.control.records import Clamp, Records, SolverStatus, VelocityCommand
from runtime.guard import Guard
from runtime.messages.event import Event
from runtime.messages.fault import Evidence
from runtime.messages.mode import ArmingCheck, Mode, Request
from runtime.modes import Answer, ModeState
from runtime.reasons import Reaction, Reason
from runtime.sources import Sources
from runtime.tick_record import TickRecord, Wake

STILL = 0.15
"""m/s: a robot that stands and is no faster may sit down."""
EVENTS = 256
"""Events that wait for the link at most; the oldest go first."""

_DAMP, _STAND_UP, _STAND, _WALK, _SIT_DOWN = Mode  # an enum's attribute costs a microsecond before Python 3.12
_OK, _SOLVER_FAILED, _OPERATOR_LOST = Reason.OK, Reason.SOLVER_FAILED, Reason.OPERATOR_LOST
_UPRIGHT = (_STAND, _WALK)
_FAILED = int(SolverStatus.FAILED)
_DEADMAN, _CONTACT = int(Clamp.DEADMAN), int(Clamp.CONTACT)


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault that has just begun to stand."""

    tick: int
    mode: Mode
    """What the robot did when it came."""
    led_to: Mode
    evidence: Evidence


class Cycle:
    """One robot's mode, its sources of commands and the record of the tick."""

    def __init__(self, config: Config, policy: Policy) -> None:
        """Build and compile everything that a tick needs.

        Raises:
            ValueError: a pose or a solver that cannot be.
        """
        self.config = config
        self._record = TickRecord()
        self.tick = self._record.tick
        """The record of this tick. Shape (1,)."""
        self.state = ModeState()
        self.verdict = Reason.NOT_READY
        """Of the guard on the last measurement."""
        self.evidence: Evidence | None = None
        """Of the fault that stands."""
        self.events: deque[Event] = deque(maxlen=EVENTS)
        """What happened and was not yet told."""
        self.faults: deque[Fault] = deque(maxlen=EVENTS)
        """Faults that were not yet kept."""
        self.generation = 1
        """Number of policies that were active so far."""
        self.outgoing = 0
        """Generation of the policy that is being handed over from; 0 for none."""
        self.clamps = [0] * len(Clamp)
        """How often each clamp acted."""
        self.solver = [0] * len(SolverStatus)
        """How often each solver status came, in ticks that stepped the controller."""
        self.doubted: tuple[str, ...] = ()
        """Legs whose feet are not believed."""
        self.checks: tuple[ArmingCheck, ...] = ()
        """The arming list of the last request to arm."""
        self.outside: Callable[[], Sequence[ArmingCheck]] = tuple
        """Checks of the arming list that only the shell can make."""
        self.controller = Controller(config.robot, config.control, policy, self._record.control)
        self.sources = Sources(config, self.controller)
        self.guard = Guard(
            config.robot,
            config.limits,
            config.control.rate_hz,
            config.degrade,
            config.posture.soft_start,
            config.control.bounds,
        )
        posture = self.sources.posture
        self.arming = Arming(
            config.robot, config.limits, config.arming, (posture.folded_joints, posture.standing_joints)
        )
        self._row, self._views = self._record.row, self._record.views

    @property
    def policy(self) -> Policy:
        """The active policy."""
        return self.controller.policy

    @property
    def health(self) -> str:
        """What the guard says of the last measurement; empty when all is in order."""
        return "" if self.verdict is _OK else self.guard.explain(self.verdict)

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
                self.sources.hand_over()
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
        posture = self.sources.posture
        self.guard.reset()
        self.controller.warm_up(measurement)
        posture.stand_up(measurement)
        posture.step()
        posture.reset()
        self.tick[:] = 0

    def step(self, wake: Wake, measurement: Measurement) -> JointCommand:
        """From a measurement to the command that acts from the next exchange on."""
        self._begin(wake)
        self._record.write_measurement(measurement)
        self.verdict = verdict = self.guard.judge(self.tick)
        carried = self.guard.carried_imu()
        if carried is not None:
            measurement = Measurement(measurement.stamp, carried, measurement.joints, measurement.voltage)
        sources = self.sources
        walk_lost = wake.stamp - sources.velocity.stamp > self.config.command.stand_after
        before = self.state
        answer = self.guard.reaction(verdict) if verdict is not _OK else Reaction.NONE
        settled = before.mode not in _UPRIGHT or self._settled(before.mode)
        self.state = modes.advance(before, verdict, sources.posture.finished, walk_lost, answer, settled)
        self._changed(before, measurement)
        share = 0.0 if modes.stopping(self.state) else self.guard.speed_share
        command = sources.step(self.state.mode, wake.stamp, measurement, self.guard.imu_believed, share)
        command = self._bounded(command, measurement)
        if self._row["clamps"] & _CONTACT or self.doubted:
            self._look_at_contacts(measurement)
        self._note_command(command)
        return command

    def silent(self, wake: Wake, words: str) -> JointCommand:
        """A tick whose exchange brought nothing back: damp, and say so."""
        self._begin(wake)
        self.verdict = Reason.BODY_SILENT
        self._fail(Reason.BODY_SILENT, None, words)
        self.guard.skip()
        self.sources.marks = 0
        command = self.sources.limp()
        self._record.write_command(command)
        self._note_command(command)
        return command

    def request(self, wish: Request, measurement: Measurement | None) -> tuple[Answer, str]:
        """Answer the operator between two ticks; the words name every obstacle."""
        before = self.state
        ready = True
        if wish is Request.ARM and measurement is not None:
            self.checks = self.examine()
            ready = all(check.ok for check in self.checks)
        settled = bool(self._views["stance"].all())
        answer = modes.request(before, wish, self.verdict, ready, settled, self._settled(_WALK))
        self.state = answer.state
        words = answer.reason.words
        if answer.reason is Reason.NOT_READY and not ready:
            words = "; ".join(check.words for check in self.checks if not check.ok)
        elif answer.reason.is_fault:
            words = self.guard.explain(answer.reason)
        if not answer.accepted:
            self.note("refused", f"{wish.value}: {words}")
        if measurement is not None:
            self._changed(before, measurement)
        return answer, words

    def examine(self) -> tuple[ArmingCheck, ...]:
        """The arming list as it is now."""
        now = float(self._row["stamp"])
        velocity = self.sources.velocity
        if now - velocity.stamp > self.config.command.stand_after:
            velocity = self.sources.rest
        own = self.arming.examine(self.tick, self.guard, self.verdict, self.policy, velocity, now)
        return (*own, *self.outside())

    def lose_operator(self, measurement: Measurement | None) -> None:
        """The driver has gone: a walking robot stops and stands."""
        before = self.state
        self.state = modes.lose_operator(before)
        if measurement is not None:
            self._changed(before, measurement)

    def command_velocity(self, command: VelocityCommand) -> None:
        """Take the newest velocity command; it counts from its stamp."""
        self.sources.velocity = command

    def damp(self, reason: Reason) -> None:
        """Damp and disarm for a reason of the daemon's own."""
        before = self.state
        self.state = ModeState(Mode.DAMP, False, reason, before.fault)
        self._enter(before, None)

    def remember(self) -> Records:
        """All that the next tick depends on beside this tick's record. Shape (1,) of ``KEYFRAME_DTYPE``."""
        return keyframe.remember(self)

    def recall(self, memory: Records, tick: Records) -> None:
        """Be as after the tick ``tick`` (1,), at whose end ``memory`` (1,) was remembered."""
        keyframe.recall(self, memory, tick)

    def note(self, kind: str, text: str) -> None:
        """Add an event."""
        tick = self.tick[0]
        self.events.append(Event(stamp=float(tick["stamp"]), tick=int(tick["index"]), kind=kind, text=text))

    def _settled(self, mode: Mode) -> bool:
        """Whether it stood on all four and still a tick ago, or walked slowly enough to stand."""
        x, y = self._views["twist"][:2].tolist()
        speed = math.hypot(x, y)
        if mode is _WALK:
            return speed < self.config.command.stand_speed
        return speed < STILL and bool(self._views["stance"].all())

    def _begin(self, wake: Wake) -> None:
        self._record.begin(wake, self.generation, self.outgoing, self.controller.tuning)

    def _bounded(self, command: JointCommand, measurement: Measurement) -> JointCommand:
        """The command with its torque cut; or, when it cannot be trusted, one that gives up."""
        mode = self.state.mode
        if mode is _DAMP:
            self._record.write_command(command)
            return command
        reason = _OK
        if mode is _STAND or mode is _WALK:
            status = int(self._row["solver_status"])
            self.solver[status] += 1
            reason = self.guard.judge_plan(self.tick)
            if reason is _OK and status == _FAILED:
                reason = _SOLVER_FAILED
        if reason is _OK:
            self._record.write_command(command)
            reason = self.guard.bound(self.tick)
        if reason is not _OK:
            return self._give_up(reason, measurement)
        return self._record.bounded(command)

    def _give_up(self, reason: Reason, measurement: Measurement) -> JointCommand:
        """Sit down instead of the command that cannot be trusted, or damp."""
        self._fail(reason, measurement)
        sources = self.sources
        if self.state.mode is _SIT_DOWN:
            command = sources.step(_SIT_DOWN, 0.0, measurement, False, 1.0)
            self._record.write_command(command)
            reason = self.guard.bound(self.tick)
            if reason is _OK:
                return self._record.bounded(command)
            self._damp_for(reason)
        command = sources.limp()
        self._record.write_command(command)
        return command

    def _look_at_contacts(self, measurement: Measurement) -> None:
        """Tell which feet are no longer believed, or again; more than one of them ends the walk."""
        doubted = tuple(name for name, left in zip(LEGS, self.controller.state["doubt"][0], strict=True) if left > 0.0)
        if doubted == self.doubted:
            return
        for name in (*doubted, *self.doubted):
            if name not in self.doubted:
                self.note("contact", f"{name}: what the foot feels contradicts its leg; the gait's schedule instead")
            elif name not in doubted:
                self.note("contact", f"{name}: what the foot feels is believed again")
        self.doubted = doubted
        if len(doubted) > 1 and self.state.mode in _UPRIGHT:
            self._fail(Reason.LYING_CONTACTS, measurement, f"{' '.join(doubted)}: {Reason.LYING_CONTACTS.words}")

    def _note_command(self, command: JointCommand) -> None:
        row, state, sources = self._row, self.state, self.sources
        row["mode"], row["armed"], row["reason"] = int(state.mode), state.armed, int(state.reason)
        asked = sources.velocity if state.mode is _WALK else sources.rest
        vector = self._views["asked_velocity"]
        vector[:2], vector[2] = asked.linear, asked.yaw_rate
        bits = int(row["clamps"]) | self.guard.marks | sources.marks
        if state.reason is _OPERATOR_LOST and state.mode in _UPRIGHT:
            bits |= _DEADMAN
        row["clamps"] = bits
        while bits:
            lowest = bits & -bits
            self.clamps[lowest.bit_length() - 1] += 1
            bits ^= lowest
        self.guard.keep_command(self.tick)
        sources.command = command

    def _fail(self, reason: Reason, measurement: Measurement | None, words: str = "") -> None:
        """Give up for ``reason``; an armed robot keeps it as the fault that stands."""
        before = self.state
        answer = self.guard.reaction(reason)
        settled = before.mode is not _STAND or self._settled(_STAND)
        self.state = modes.advance(before, reason, False, False, answer, settled)
        if self.state is not before:
            self._stand_fault(before, words)
            self._enter(before, measurement)

    def _damp_for(self, reason: Reason) -> None:
        before = self.state
        self.state = modes.advance(before, reason, False, False, Reaction.DAMP)
        self._enter(before, None)

    def _changed(self, before: ModeState, measurement: Measurement) -> None:
        """Tell of a change of state and make its new mode ready."""
        if self.state == before:
            return
        if self.state.fault is not before.fault:
            self._stand_fault(before)
        self._enter(before, measurement)

    def _stand_fault(self, before: ModeState, words: str = "") -> None:
        """Keep the evidence of the fault that begins to stand, or forget that of the one that was cleared."""
        fault = self.state.fault
        if fault is _OK:
            self.evidence = None
            return
        evidence = self.guard.evidence(fault)
        if words:
            evidence = Evidence(reason=evidence.reason, words=words)
        self.evidence = evidence
        self.note("fault", evidence.words)
        self.faults.append(Fault(int(self._row["index"]), before.mode, self.state.mode, evidence))

    def _enter(self, before: ModeState, measurement: Measurement | None) -> None:
        """What every change of mode or arming does."""
        state = self.state
        if state.mode is not before.mode:
            self.note("mode", f"{before.mode.name} -> {state.mode.name}: {state.reason.words}")
            moving = before.mode is _WALK or (before.mode is _STAND and not self._settled(_STAND))
            self._record.blank_plan()
            now = float(self._row["stamp"])
            falls = state.reason is Reason.FALLING
            self.sources.change(before.mode, state.mode, measurement, state.reason.is_fault, now, moving, falls)
        elif state.armed != before.armed or state.fault is not before.fault:
            self.note("mode", f"{state.mode.name}: {state.reason.words}")
