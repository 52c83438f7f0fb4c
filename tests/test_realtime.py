"""Wishes to the kernel: each tried, each reported, fatal only when required."""

from __future__ import annotations

import errno
import gc
import os
from collections.abc import Iterator

import pytest

from runtime import realtime
from runtime.parameters import RealtimeConfig
from runtime.realtime import RealtimeError


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(errno.EPERM, "no")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)


@pytest.fixture
def same_processors() -> Iterator[None]:
    before = os.sched_getaffinity(0)
    yield
    os.sched_setaffinity(0, before)


def test_nothing_is_asked_for_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_setscheduler", lambda *_: pytest.fail("asked"))
    monkeypatch.setattr(os, "sched_setaffinity", lambda *_: pytest.fail("asked"))
    assert realtime.apply(RealtimeConfig()) == []


def test_what_is_refused_is_reported_and_the_rest_still_tried(refused: None, same_processors: None) -> None:
    processor = min(os.sched_getaffinity(0))
    fifo, processors = realtime.apply(RealtimeConfig(priority=50, cpus=(processor,)))
    assert not fifo.granted and str(fifo) == "SCHED_FIFO 50: refused (Operation not permitted)"
    assert processors.granted and os.sched_getaffinity(0) == {processor}


def test_a_processor_that_is_not_there_is_refused(same_processors: None) -> None:
    (processors,) = realtime.apply(RealtimeConfig(cpus=(1023,)))
    assert not processors.granted


def test_required_makes_a_refusal_fatal(refused: None) -> None:
    with pytest.raises(RealtimeError, match=r"realtime\.required = true, but SCHED_FIFO 50: refused"):
        realtime.apply(RealtimeConfig(priority=50, required=True))


def test_threads_started_later_stay_normal(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(os, "sched_setscheduler", lambda _pid, policy, _param: asked.append(policy))
    assert realtime.apply(RealtimeConfig(priority=50))[0].granted
    assert asked == [os.SCHED_FIFO | os.SCHED_RESET_ON_FORK]


def test_the_collector_rests_while_it_is_held() -> None:
    try:
        realtime.settle_garbage()
        assert gc.get_freeze_count() > 0
        realtime.hold_garbage(True)
        assert not gc.isenabled()
    finally:
        realtime.hold_garbage(False)
        gc.unfreeze()
    assert gc.isenabled()
