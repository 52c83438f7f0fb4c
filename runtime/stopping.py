"""The ways out of a running daemon: by a signal, and always through damping."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
from collections.abc import Iterator

from drivers.errors import DriverError
from drivers.robot import Robot, damp_command
from runtime.parameters import DampConfig

log = logging.getLogger("trotd")

DAMP_REPLIES = 3
"""Exchanges that must come back before a stopping daemon believes that the body damps."""


@contextlib.contextmanager
def stopped_by_signals(stop: asyncio.Event) -> Iterator[None]:
    """SIGTERM and SIGINT set ``stop``; a second one cancels the calling task, whatever the stop waits for."""
    loop = asyncio.get_running_loop()
    task = asyncio.current_task()
    assert task is not None

    def react(name: str) -> None:
        if stop.is_set():
            log.warning("%s again: not waiting any longer", name)
            task.cancel()
        else:
            log.info("%s: stopping", name)
            stop.set()

    caught = (signal.SIGTERM, signal.SIGINT)
    for number in caught:
        loop.add_signal_handler(number, react, number.name)
    try:
        yield
    finally:
        for number in caught:
            loop.remove_signal_handler(number)


async def damp(body: Robot, config: DampConfig, period: float) -> None:
    """Ask ``body`` every ``period`` s to damp, until it answered a few times or the deadline is up. Never raises."""
    command = damp_command(config.kd)
    replies = 0
    with contextlib.suppress(asyncio.CancelledError, TimeoutError):
        async with asyncio.timeout(config.deadline):
            while replies < DAMP_REPLIES:
                try:
                    await body.exchange(command)
                    replies += 1
                except DriverError as error:
                    log.error("while damping: %s", error)
                await asyncio.sleep(period)
    if replies == 0:
        log.error("the body did not confirm that it damps; its own watchdog has to")
