"""The schedule is absolute, and the kernel counts what was missed."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest
import uvloop

from runtime.ticker import Ticker

LOOPS = [uvloop.new_event_loop, asyncio.new_event_loop]


def run(loop_factory: Callable[[], asyncio.AbstractEventLoop], main: Coroutine[Any, Any, None]) -> None:
    with asyncio.Runner(loop_factory=loop_factory) as runner:
        runner.run(main)


@pytest.mark.parametrize("loop_factory", LOOPS)
def test_every_wake_belongs_to_its_own_deadline(loop_factory: Callable[[], asyncio.AbstractEventLoop]) -> None:
    async def main() -> None:
        with Ticker(200.0) as ticker:
            seen = 0
            for _ in range(20):
                index = await ticker.wait()
                assert index > seen
                assert ticker.lateness >= 0.0
                seen = index
            assert seen == 20 + ticker.overruns

    run(loop_factory, main())


@pytest.mark.parametrize("loop_factory", LOOPS)
def test_missed_deadlines_are_counted_and_the_schedule_stays(
    loop_factory: Callable[[], asyncio.AbstractEventLoop],
) -> None:
    async def main() -> None:
        with Ticker(100.0) as ticker:
            first = await ticker.wait()
            start = ticker.stamp - ticker.lateness - first * ticker.period
            time.sleep(0.055)  # blocks the loop through five deadlines  # noqa: ASYNC251
            late = await ticker.wait()
            assert late >= first + 5
            assert ticker.overruns == late - 2
            await ticker.wait()
            assert ticker.stamp - ticker.lateness == pytest.approx(start + ticker.index * ticker.period, abs=1e-6)

    run(loop_factory, main())


def test_deadlines_that_pass_while_the_waiter_awaits_something_else_are_counted() -> None:
    async def main() -> None:
        with Ticker(200.0) as ticker:
            await ticker.wait()
            await asyncio.sleep(0.03)
            index = await ticker.wait()
            assert index >= 6
            assert ticker.overruns == index - 2

    run(uvloop.new_event_loop, main())


def test_a_tick_that_is_always_late_leaves_the_loop_its_turn() -> None:
    async def main() -> None:
        turns = 0

        def turn() -> None:
            nonlocal turns
            turns += 1
            loop.call_soon(turn)

        loop = asyncio.get_running_loop()
        loop.call_soon(turn)
        with Ticker(1000.0) as ticker:
            for _ in range(10):
                await ticker.wait()
                time.sleep(0.003)  # noqa: ASYNC251
        assert turns >= 10

    run(uvloop.new_event_loop, main())


def _open_files() -> set[Path]:
    return set(Path("/proc/self/fd").iterdir())


def test_the_timer_is_closed_with_the_context() -> None:
    async def main() -> None:
        before = _open_files()
        with Ticker(200.0) as ticker:
            await ticker.wait()
            assert len(_open_files()) > len(before)
        assert _open_files() <= before

    run(asyncio.new_event_loop, main())


def test_cancelling_the_waiter_ends_it() -> None:
    async def main() -> None:
        with Ticker(1.0) as ticker:
            task = asyncio.get_running_loop().create_task(ticker.wait())
            await asyncio.sleep(0)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task

    run(uvloop.new_event_loop, main())


@pytest.mark.parametrize("loop_factory", LOOPS)
def test_a_ticker_woken_early_is_awake_at_the_deadline_and_never_before_it(
    loop_factory: Callable[[], asyncio.AbstractEventLoop],
) -> None:
    async def main() -> None:
        with Ticker(100.0, early=0.005) as ticker:
            punctual = woken = 0
            while punctual < 10:  # a busy machine does not always wake it before a deadline that is 5 ms away
                await ticker.wait()
                assert ticker.lateness >= 0.0
                punctual += ticker.lateness < 2e-5
                woken += 1
            assert ticker.index == woken + ticker.overruns

    run(loop_factory, main())


@pytest.mark.parametrize("early", [-1e-6, 0.0051])
def test_more_than_half_a_period_of_waking_early_is_refused(early: float) -> None:
    with pytest.raises(ValueError, match=r"bound half of the period 0\.01 s"):
        Ticker(100.0, early)
