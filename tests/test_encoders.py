"""Encoders that stand still: told from joints at rest, from replies that are late, and named."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from test_plausibility import PERIOD, Change, Stream

from runtime.control.records import Records
from runtime.messages.mode import Mode
from runtime.reasons import Reason


def test_an_encoder_that_stands_still_while_its_leg_moves_is_found() -> None:
    stream = Stream()
    stream.live(50)

    def stick(tick: Records, _n: int) -> None:
        tick["joint_position"][0, 1, 1] = -0.5
        tick["joint_velocity"][0, 1, 1] = 0.0

    stream.guard.memory["position"][0, 1, 1] = -0.5
    found, reason = stream.live(600, stick)
    assert reason is Reason.STUCK_ENCODER and found > 1
    assert "FR hip" in stream.guard.explain(reason)


def hold(stream: Stream, leg: int, joint: int) -> Change:
    """One encoder stays where it is now."""
    kept = float(stream.reading()["joint_position"][0, leg, joint])

    def stick(tick: Records, _n: int) -> None:
        tick["joint_position"][0, leg, joint] = kept
        tick["joint_velocity"][0, leg, joint] = 0.0

    return stick


def at_rest(stream: Stream, change: Change) -> Change:
    """All joints are where they are now, but for the least bit; and then what ``change`` does."""
    kept = stream.reading()["joint_position"][0].copy()

    def stand(tick: Records, n: int) -> None:
        tick["joint_position"][0] = kept + 1e-5 * n
        tick["joint_velocity"] = 0.0
        change(tick, n)

    return stand


def told_to_swing(stuck: Callable[[int], bool], age: Callable[[int], float]) -> tuple[Stream, Change]:
    """A walk in which one knee is told to move at 8 rad/s, and when it does not; and how old its reading is then."""
    stream = Stream(Mode.WALK)
    stream.live(50)
    stick = hold(stream, 2, 2)

    def swing(tick: Records, n: int) -> None:
        tick["command_velocity"][0, 2, 2] = 8.0
        if stuck(n):
            stick(tick, n)
            tick["joint_age"][0, 2, 2] = age(n)

    return stream, swing


def test_an_encoder_that_stands_still_while_its_joint_is_told_to_move_is_found_at_once() -> None:
    stream, swing = told_to_swing(lambda _n: True, lambda _n: 0.0)
    found, reason = stream.live(20, swing)
    assert reason is Reason.STUCK_ENCODER and found <= 6, "two ticks until the command acts, and 0.08 rad at 8 rad/s"
    assert "BL knee" in stream.guard.explain(reason)


def test_replies_that_are_late_or_lost_are_no_stuck_encoder() -> None:
    stream, swing = told_to_swing(lambda n: n % 3 > 0, lambda n: PERIOD * (n % 3))
    assert stream.live(2, swing) == (0, Reason.OK)


@pytest.mark.parametrize(("joint", "trips"), [(0, True), (1, False)])
def test_an_encoder_that_stands_still_while_the_robot_tilts_is_found(joint: int, trips: bool) -> None:
    """It rolls: an abduction must turn; a hip need not."""
    stream = Stream(Mode.STAND)
    stream.live(50)
    stand = at_rest(stream, hold(stream, 0, joint))

    found, reason = stream.live(40, stand)
    assert reason is (Reason.STUCK_ENCODER if trips else Reason.OK)
    assert not trips or found >= 10, "not before stuck_time"


def test_an_encoder_that_stands_still_while_nothing_moves_is_a_joint_at_rest() -> None:
    stream = Stream(Mode.STAND, turning=1e-3)
    stream.live(50)
    stand = at_rest(stream, hold(stream, 0, 1))
    assert stream.live(1000, stand) == (0, Reason.OK)
