"""Lateness by strange clocks: a burst after a gap is old, a slow network is not, a clock that is set is forgiven."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from runtime.delays import RECENT, SENDERS, Delays

CLOCKS = st.floats(-1e9, 1e9)


@given(CLOCKS, st.floats(0.0, 5.0), st.floats(0.0, 0.05))
def test_a_steady_network_makes_nothing_late_however_slow(offset: float, delay: float, jitter: float) -> None:
    delays = Delays()
    for n in range(300):
        sent = 0.02 * n
        late = delays.lateness("a", sent + offset, sent + delay + jitter * (n % 3))
        assert -1e-6 <= late <= 2 * jitter + 1e-6


@given(CLOCKS, st.floats(0.5, 100.0), st.integers(1, RECENT // 2))
def test_what_waited_through_a_gap_is_as_old_as_it_waited(offset: float, gap: float, waiting: int) -> None:
    delays = Delays()
    for n in range(100):
        delays.lateness("a", offset + 0.02 * n, 0.02 * n + 0.1)
    back = 2.0 + gap
    for n in range(waiting):
        sent = 2.0 + gap * n / waiting
        assert abs(delays.lateness("a", offset + sent, back + 0.1) - (back - sent)) < 1e-6
    assert delays.lateness("a", offset + back, back + 0.1) < 1e-6


@given(st.floats(-1e6, -1.0))
def test_a_sender_whose_clock_was_set_back_is_believed_again(step: float) -> None:
    delays = Delays()
    for n in range(RECENT):
        delays.lateness("a", 0.02 * n, 0.02 * n)
    late = [delays.lateness("a", 0.02 * n + step, 0.02 * n) for n in range(RECENT, 2 * RECENT + 1)]
    assert late[0] > 0.9 and late[-1] < 1e-6


def test_senders_do_not_touch_each_other_and_are_few() -> None:
    delays = Delays()
    assert delays.lateness("a", 0.0, 0.0) == 0.0
    assert delays.lateness("b", -50.0, 1.0) == 0.0
    assert delays.lateness("a", 0.0, 3.0) == 3.0
    for n in range(SENDERS):
        delays.lateness(n, 0.0, 4.0)
    assert delays.lateness("a", 0.0, 5.0) == 0.0, "forgotten, and new"
