"""What the robot may do next: a pure transition table, every change and every refusal with its reason.

DAMP → STAND_UP → STAND ⇄ WALK, STAND → SIT_DOWN → DAMP, and DAMP from anywhere. Only an armed robot leaves DAMP, and
every way into DAMP disarms. A fault that leaves the legs answering sits a standing robot down; one that leaves the
controller whole lets a walking one stop first. All others damp. Every fault stays until ``clear``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import assert_never

from runtime.messages.mode import Mode, Request
from runtime.reasons import HALTS, Reaction, Reason


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
