"""The mode table, exhaustively: every mode, every request, every verdict."""

from __future__ import annotations

from itertools import product

import pytest

from runtime.messages.mode import Mode, Request
from runtime.modes import TABLE, ModeState, advance, request
from runtime.reasons import WORDS, Reason

FAULTS = [reason for reason in Reason if reason.is_fault]
STATES = [
    ModeState(mode, armed, Reason.REQUESTED, fault)
    for mode, armed, fault in product(Mode, (False, True), (Reason.OK, Reason.TILTED))
    if armed or mode is Mode.DAMP  # nothing but DAMP exists unarmed
    if fault is Reason.OK or not armed  # a fault disarms
]
ALLOWED = {
    (Mode.DAMP, Request.STAND): Mode.STAND_UP,
    (Mode.STAND_UP, Request.SIT): Mode.SIT_DOWN,
    (Mode.STAND, Request.WALK): Mode.WALK,
    (Mode.STAND, Request.SIT): Mode.SIT_DOWN,
    (Mode.WALK, Request.STAND): Mode.STAND,
    (Mode.SIT_DOWN, Request.STAND): Mode.STAND_UP,
}


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("wish", Request)
@pytest.mark.parametrize("verdict", [Reason.OK, *FAULTS])
def test_every_request_in_every_state_under_every_verdict(state: ModeState, wish: Request, verdict: Reason) -> None:
    for ready, settled in product((True, False), (True, False)):
        answer = request(state, wish, verdict, ready, settled)
        after = answer.state
        if not answer.accepted:
            assert after == state, "a refused request moves nothing"
            assert answer.reason is not Reason.OK
        if after.mode is not state.mode:
            if wish is Request.DAMP:
                assert after.mode is Mode.DAMP
            else:
                assert ALLOWED[state.mode, wish] is after.mode
                assert state.armed and verdict is Reason.OK
        if after.armed and not state.armed:
            assert wish is Request.ARM
            assert state.mode is Mode.DAMP and state.fault is Reason.OK and verdict is Reason.OK and ready
        if wish is Request.DAMP:
            assert answer.accepted and after.mode is Mode.DAMP and not after.armed
        if after.fault is not state.fault:
            assert wish is Request.CLEAR and state.mode is Mode.DAMP and verdict is Reason.OK
        if wish is Request.SIT and state.mode is Mode.STAND and not settled:
            assert not answer.accepted


def test_what_is_allowed_is_reached() -> None:
    for (mode, wish), target in ALLOWED.items():
        answer = request(ModeState(mode, True), wish, Reason.OK, True)
        assert answer.accepted
        assert answer.state.mode is target


def test_asking_for_what_is_so_is_accepted_and_changes_nothing() -> None:
    for mode, wish in ((Mode.STAND, Request.STAND), (Mode.WALK, Request.WALK), (Mode.SIT_DOWN, Request.SIT)):
        state = ModeState(mode, True)
        answer = request(state, wish, Reason.OK, True)
        assert answer.accepted and answer.state == state and answer.reason is Reason.ALREADY


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("verdict", [Reason.OK, *FAULTS])
def test_every_tick_in_every_state_under_every_verdict(state: ModeState, verdict: Reason) -> None:
    for finished, lost in product((False, True), (False, True)):
        after = advance(state, verdict, finished, lost)
        if verdict is not Reason.OK and state.armed:
            assert after.mode is Mode.DAMP and not after.armed
            assert after.reason is verdict and after.fault is verdict
        elif verdict is not Reason.OK:
            assert after == state, "an unarmed robot in damp has nothing to lose"
        elif state.mode is Mode.STAND_UP and finished:
            assert after.mode is Mode.STAND and after.armed
        elif state.mode is Mode.SIT_DOWN and finished:
            assert after.mode is Mode.DAMP and not after.armed and after.fault is Reason.OK
        elif state.mode is Mode.WALK and lost:
            assert after.mode is Mode.STAND and after.reason is Reason.COMMAND_LOST
        else:
            assert after == state


def test_damp_always_disarms() -> None:
    for state, verdict, wish in product(STATES, [Reason.OK, *FAULTS], Request):
        answered = request(state, wish, verdict, True).state
        ticked = advance(state, verdict, True, True)
        for after in (answered, ticked):
            if after.mode is Mode.DAMP and state.mode is not Mode.DAMP:
                assert not after.armed


def test_every_reason_has_words_and_every_row_is_whole() -> None:
    assert set(WORDS) == set(Reason)
    for rows in TABLE.values():
        assert set(rows) == set(Mode)
