"""A sample of what ``make soak`` and ``make soak-sim`` do at length."""

from __future__ import annotations

import pytest
from faults.shift import work
from faults.wander import Wandering, wander

SITS_FIRST = 19
"""A seed whose first choice is to sit down and rise."""


def test_a_robot_that_is_sent_about_and_pushed_does_not_fall() -> None:
    results: list[Wandering] = []
    wander((SITS_FIRST, 20.0), results.append)
    (result,) = results
    assert (result.falls, result.faults) == ([], {})
    assert (result.not_finite, result.over_limit) == (0, 0)
    assert result.sits and result.pushes and result.commands
    assert result.distance > 0.5
    assert result.torque > 5.0


@pytest.mark.timeout(300)
def test_a_shift_of_a_daemon_with_its_lookers_on() -> None:
    shift = work(0.2, "stoch3", "sim", 200.0, True, lambda _: None)
    assert shift.falls == 0
    assert shift.distance > 0.05
    assert shift.ticks > 200
