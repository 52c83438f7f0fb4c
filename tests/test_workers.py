"""Work over processes: everything comes back, and a process that is killed is not waited for."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable

import pytest
from faults.workers import spread


def double(item: int, tell: Callable[[int], None]) -> None:
    if item < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    tell(2 * item)


def test_every_item_is_worked_on_once() -> None:
    assert sorted(spread(range(7), double, 2)) == [0, 2, 4, 6, 8, 10, 12]


def test_a_worker_that_is_killed_is_an_error_and_no_endless_wait() -> None:
    with pytest.raises(RuntimeError, match="a worker ended with code -9"):
        list(spread([-1], double, 1))
