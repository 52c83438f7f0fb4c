"""What the robot may do next: a pure transition table, every change and every refusal with its reason.

DAMP → STAND_UP → STAND ⇄ WALK, STAND → SIT_DOWN → DAMP, and DAMP from anywhere. Only an armed robot leaves DAMP, and
every way into DAMP disarms. A fault that leaves the legs answering sits a standing robot down; one that leaves the
controller whole lets a walking one stop first. All others damp. Every fault stays until ``clear``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import assert_never

from runtime.messages.mode import Mode, Request


class Reason(IntEnum):
    """Why the mode is what it is, or why a request was refused. ``words`` says it to people."""

    OK = 0
    STARTED = 1
    REQUESTED = 2
    ARMED = 3
    CLEARED = 4
    STOOD_UP = 5
    SAT_DOWN = 6
    COMMAND_LOST = 7
    OPERATOR_LOST = 8
    STOPPING = 9
    LATE_LOOP = 10
    SLOWING = 11
    STOPPED = 12

    NOT_ARMED = 20
    NOT_STANDING = 21
    NOT_DAMPED = 22
    STILL_MOVING = 23
    WALKING = 24
    FAULT_STANDS = 25
    NOT_READY = 26
    ALREADY = 27

    NOT_FINITE = 40
    STALE_MOTOR = 41
    STALE_IMU = 42
    IMPLAUSIBLE_IMU = 43
    TILTED = 44
    MOTOR_FAULT = 45
    HOT_MOTOR = 46
    JOINT_SPEED = 47
    LOW_VOLTAGE = 48
    OVERLOAD = 49
    BAD_COMMAND = 50
    SOLVER_FAILED = 51
    UNREACHABLE = 52
    BODY_SILENT = 53
    FROZEN_IMU = 54
    ATTITUDE_JUMP = 55
    TURN_ERROR = 56
    GRAVITY_ERROR = 57
    JUMPING_ENCODER = 58
    NOISY_ENCODER = 59
    TORQUE_LOST = 60
    REVERSED_MOTOR = 61
    STALLED = 62
    BAD_POLICY = 63
    ASTRAY = 64
    STUCK_ENCODER = 65
    LYING_CONTACTS = 66
    FALLING = 67

    @property
    def words(self) -> str:
        """The reason as a person would say it."""
        return WORDS[self]

    @property
    def is_fault(self) -> bool:
        """Whether it ends what the robot does and stays until cleared."""
        return self >= Reason.NOT_FINITE


WORDS: dict[Reason, str] = {
    Reason.OK: "in order",
    Reason.STARTED: "just started",
    Reason.REQUESTED: "asked for",
    Reason.ARMED: "armed",
    Reason.CLEARED: "fault cleared",
    Reason.STOOD_UP: "stood up",
    Reason.SAT_DOWN: "sat down",
    Reason.COMMAND_LOST: "no velocity command any more",
    Reason.OPERATOR_LOST: "the operator is gone",
    Reason.STOPPING: "the daemon is stopping",
    Reason.LATE_LOOP: "the loop came too late to walk on",
    Reason.SLOWING: "asked to stand: slowing down first",
    Reason.STOPPED: "stopped",
    Reason.NOT_ARMED: "not armed: ask for arm first",
    Reason.NOT_STANDING: "not standing: ask for stand first",
    Reason.NOT_DAMPED: "only in damp",
    Reason.STILL_MOVING: "still moving: wait until it stands or sits",
    Reason.WALKING: "walking: ask for stand first",
    Reason.FAULT_STANDS: "a fault stands: look at it, then ask for clear",
    Reason.NOT_READY: "not ready",
    Reason.ALREADY: "already so",
    Reason.NOT_FINITE: "a reading is not a number",
    Reason.STALE_MOTOR: "a motor's reply is too old",
    Reason.STALE_IMU: "the IMU's sample is too old",
    Reason.IMPLAUSIBLE_IMU: "the IMU tells what cannot be",
    Reason.TILTED: "tilted too far",
    Reason.MOTOR_FAULT: "a motor reports a fault",
    Reason.HOT_MOTOR: "a motor is too hot",
    Reason.JOINT_SPEED: "a joint is too fast",
    Reason.LOW_VOLTAGE: "the supply is too low",
    Reason.OVERLOAD: "rms torque beyond the continuous rating",
    Reason.BAD_COMMAND: "the computed command is not finite",
    Reason.SOLVER_FAILED: "no ground reaction forces found",
    Reason.UNREACHABLE: "a foot target of the posture is out of reach",
    Reason.BODY_SILENT: "the body does not answer",
    Reason.FROZEN_IMU: "the IMU repeats itself while the legs move",
    Reason.ATTITUDE_JUMP: "the IMU's attitude jumped",
    Reason.TURN_ERROR: "the IMU's rate of turn does not fit its attitude",
    Reason.GRAVITY_ERROR: "the IMU does not feel gravity",
    Reason.JUMPING_ENCODER: "a joint's position jumped",
    Reason.NOISY_ENCODER: "a joint's position does not fit its speed",
    Reason.TORQUE_LOST: "a motor does not give its torque",
    Reason.REVERSED_MOTOR: "a motor turns against its command",
    Reason.STALLED: "the loop stood still",
    Reason.BAD_POLICY: "the policy asks for what cannot be",
    Reason.ASTRAY: "a joint does not follow its target",
    Reason.STUCK_ENCODER: "an encoder does not move any more",
    Reason.LYING_CONTACTS: "more than one foot feels what cannot be",
    Reason.FALLING: "falls, and no step would catch it",
}


class Reaction(IntEnum):
    """What a verdict of the guard leads to; the greater takes precedence."""

    NONE = 0
    STAND = 1
    """A walk ends in standing; no fault."""
    STOP_AND_SIT = 2
    """A walk ends in standing first; then down on the legs, then damp."""
    SIT_DOWN = 3
    """Down on the legs where it stands, then damp; in a walk the legs fold at once, joint by joint: without attitude
    or policy nothing keeps a walking robot up until it stands."""
    DAMP = 4


HALTS = frozenset({Reason.OPERATOR_LOST, Reason.LATE_LOOP, Reason.SLOWING})
"""Why a walking robot stops without a fault."""
WHOLE = frozenset({Reason.HOT_MOTOR, Reason.OVERLOAD, Reason.LOW_VOLTAGE, Reason.LYING_CONTACTS})
"""Faults that leave every leg answering and the controller whole."""
SEATED = frozenset(
    {
        Reason.STALE_IMU,
        Reason.IMPLAUSIBLE_IMU,
        Reason.FROZEN_IMU,
        Reason.ATTITUDE_JUMP,
        Reason.TURN_ERROR,
        Reason.GRAVITY_ERROR,
        Reason.BAD_COMMAND,
        Reason.BAD_POLICY,
        Reason.SOLVER_FAILED,
        Reason.FALLING,
    }
)
"""Faults that leave every leg answering."""


def reaction(reason: Reason, sit_down: bool) -> Reaction:
    """What ``reason`` leads to; ``sit_down``: gently where the legs still answer."""
    if reason is Reason.OK:
        return Reaction.NONE
    if reason is Reason.LATE_LOOP:
        return Reaction.STAND
    if sit_down and reason in WHOLE:
        return Reaction.STOP_AND_SIT
    return Reaction.SIT_DOWN if sit_down and reason in SEATED else Reaction.DAMP


@dataclass(frozen=True, slots=True)
class ModeState:
    """The daemon's state as its operator sees it."""

    mode: Mode = Mode.DAMP
    armed: bool = False
    reason: Reason = Reason.STARTED
    fault: Reason = Reason.OK
    """The fault that stands, or OK."""


@dataclass(frozen=True, slots=True)
class Answer:
    """To one request: the state after it, and whether it was accepted and why (not)."""

    state: ModeState
    accepted: bool
    reason: Reason


Entry = Mode | Reason
"""A row's outcome: the mode to go to, or why not."""

TABLE: dict[Request, dict[Mode, Entry]] = {
    Request.STAND: {
        Mode.DAMP: Mode.STAND_UP,
        Mode.STAND_UP: Reason.ALREADY,
        Mode.STAND: Reason.ALREADY,
        Mode.WALK: Mode.STAND,
        Mode.SIT_DOWN: Mode.STAND_UP,
    },
    Request.WALK: {
        Mode.DAMP: Reason.NOT_STANDING,
        Mode.STAND_UP: Reason.STILL_MOVING,
        Mode.STAND: Mode.WALK,
        Mode.WALK: Reason.ALREADY,
        Mode.SIT_DOWN: Reason.STILL_MOVING,
    },
    Request.SIT: {
        Mode.DAMP: Reason.NOT_STANDING,
        Mode.STAND_UP: Mode.SIT_DOWN,
        Mode.STAND: Mode.SIT_DOWN,
        Mode.WALK: Reason.WALKING,
        Mode.SIT_DOWN: Reason.ALREADY,
    },
}
"""Requests that move the robot. The other three do not need a table: arm and clear work in DAMP only, damp always."""


def request(
    state: ModeState, wish: Request, verdict: Reason, ready: bool, settled: bool = True, slow: bool = True
) -> Answer:
    """The answer to ``wish``.

    Args:
        state: before it.
        wish: what the operator asks for.
        verdict: of the guard, OK or a fault.
        ready: nothing speaks against arming.
        settled: all four legs carry; a robot that stands on two of them does not sit down.
        slow: a walking robot may stand at once, without slowing down first.
    """
    match wish:
        case Request.DAMP:
            return Answer(_damped(state, Reason.REQUESTED), True, Reason.REQUESTED)
        case Request.CLEAR:
            return _clear(state, verdict)
        case Request.ARM:
            return _arm(state, verdict, ready)
        case Request.SIT if state.mode is Mode.STAND and not settled:
            return _refused(state, Reason.STILL_MOVING)
        case Request.STAND if state.mode is Mode.WALK and not slow and state.fault is Reason.OK:
            return Answer(replace(state, reason=Reason.SLOWING), True, Reason.SLOWING)
        case Request.STAND | Request.WALK | Request.SIT:
            return _move(state, TABLE[wish][state.mode], verdict)
        case _:
            assert_never(wish)


def advance(
    state: ModeState,
    verdict: Reason,
    finished: bool,
    command_lost: bool,
    answer: Reaction = Reaction.DAMP,
    settled: bool = True,
) -> ModeState:
    """The state after one tick: a fault sits down or damps, a finished posture moves on, a lost command stops the walk.

    Args:
        state: before the tick.
        verdict: of the guard, OK or what is wrong.
        finished: the posture of STAND_UP or SIT_DOWN has reached its end.
        command_lost: no velocity command for longer than the configuration allows.
        answer: what a verdict that is not OK leads to.
        settled: a robot in STAND stands on all four and still; one in WALK is slow enough to stand.
    """
    if verdict is not Reason.OK and (state.armed or state.mode is not Mode.DAMP):
        given_up = _give_up(state, verdict, answer, settled)
        if given_up.mode is not state.mode or given_up.mode is Mode.DAMP:
            return given_up
        state = given_up
    if settled and stopping(state):
        return replace(
            state, mode=Mode.STAND, reason=Reason.STOPPED if state.reason is Reason.SLOWING else state.reason
        )
    if settled and state.mode is Mode.STAND and state.fault is not Reason.OK:
        return replace(state, mode=Mode.SIT_DOWN)
    if state.mode is Mode.STAND_UP and finished:
        return replace(state, mode=Mode.STAND, reason=Reason.STOOD_UP)
    if state.mode is Mode.SIT_DOWN and finished:
        return _damped(state, Reason.SAT_DOWN)
    if state.mode is Mode.WALK and command_lost and settled:
        return replace(state, mode=Mode.STAND, reason=Reason.COMMAND_LOST)
    return state


def stopping(state: ModeState) -> bool:
    """Whether a walking robot is on its way to standing and follows no velocity any more."""
    return state.mode is Mode.WALK and (state.fault is not Reason.OK or state.reason in HALTS)


def lose_operator(state: ModeState) -> ModeState:
    """The state after a driver has gone: a walking robot stops and stands."""
    walks = state.mode is Mode.WALK and state.fault is Reason.OK
    return replace(state, reason=Reason.OPERATOR_LOST) if walks else state


def _give_up(state: ModeState, verdict: Reason, answer: Reaction, settled: bool) -> ModeState:
    mode = state.mode
    if answer is Reaction.STAND:
        return replace(state, reason=verdict) if mode is Mode.WALK and not stopping(state) else state
    unsteady = mode is Mode.WALK or (mode is Mode.STAND and not settled)
    if answer is Reaction.DAMP or mode is Mode.DAMP:
        return replace(_damped(state, verdict), fault=verdict)
    fault = verdict if state.fault is Reason.OK else state.fault
    to = mode if unsteady and answer is not Reaction.SIT_DOWN else Mode.SIT_DOWN
    return state if state.fault is fault and mode is to else replace(state, mode=to, reason=verdict, fault=fault)


def _damped(state: ModeState, reason: Reason) -> ModeState:
    return replace(state, mode=Mode.DAMP, armed=False, reason=reason)


def _refused(state: ModeState, reason: Reason) -> Answer:
    return Answer(state, False, reason)


def _clear(state: ModeState, verdict: Reason) -> Answer:
    if state.mode is not Mode.DAMP:
        return _refused(state, Reason.NOT_DAMPED)
    if verdict is not Reason.OK:
        return _refused(state, verdict)
    if state.fault is Reason.OK:
        return Answer(state, True, Reason.ALREADY)
    return Answer(replace(state, fault=Reason.OK, reason=Reason.CLEARED), True, Reason.CLEARED)


def _arm(state: ModeState, verdict: Reason, ready: bool) -> Answer:
    if state.mode is not Mode.DAMP:
        return _refused(state, Reason.NOT_DAMPED)
    if state.fault is not Reason.OK:
        return _refused(state, Reason.FAULT_STANDS)
    if verdict is not Reason.OK:
        return _refused(state, verdict)
    if not ready:
        return _refused(state, Reason.NOT_READY)
    return Answer(replace(state, armed=True, reason=Reason.ARMED), True, Reason.ARMED)


def _move(state: ModeState, entry: Entry, verdict: Reason) -> Answer:
    if isinstance(entry, Reason):
        return Answer(state, entry is Reason.ALREADY, entry)
    if state.fault is not Reason.OK:
        return _refused(state, Reason.FAULT_STANDS)
    if not state.armed:
        return _refused(state, Reason.NOT_ARMED)
    if verdict is not Reason.OK:
        return _refused(state, verdict)
    return Answer(replace(state, mode=entry, reason=Reason.REQUESTED), True, Reason.REQUESTED)
