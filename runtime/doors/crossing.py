"""From zenoh's threads to the loop's, and back with an answer: the one place where threads are crossed.

What cannot be taken is refused with a reason, and counted by its key.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

import zenoh

from runtime.doors.answers import Doors
from runtime.messages.decoding import LARGEST_MESSAGE, MessageError

ANSWER_TIMEOUT = 30.0
"""How long one of zenoh's threads waits for the loop, s."""
REPEAT_TIME = 1.0
"""The same refusal becomes an event at most once in this time, s; all are counted."""
Result = TypeVar("Result")


class Crossing:
    """Used by every door of one robot, on zenoh's threads."""

    def __init__(self, root: str, doors: Doors) -> None:
        self.refused: Counter[str] = Counter()
        """How much was refused or shed since the start, by key below ``root``."""
        self._root, self._doors = root, doors
        self._told: dict[str, float] = {}

    def begin(self) -> None:
        """The running loop is the one to cross to."""
        self._loop = asyncio.get_running_loop()

    def cross(self, act: Callable[[], Result]) -> Future[Result]:
        """Run ``act`` on the loop's thread, between two callbacks of the loop."""
        done: Future[Result] = Future()

        def run() -> None:
            try:
                done.set_result(act())
            except Exception as error:
                done.set_exception(error)

        try:
            self._loop.call_soon_threadsafe(run)
        except RuntimeError as error:
            done.set_exception(error)  # the loop is closed: the daemon is gone
        return done

    def ask(self, act: Callable[[], Result]) -> Result:
        """Run ``act`` on the loop's thread and wait for what it returns or raises."""
        return self.cross(act).result(ANSWER_TIMEOUT)

    def refuse(self, key: str, why: str) -> None:
        """Count a refusal, and tell of it unless the same key was told of just now."""
        self.refused[key.removeprefix(f"{self._root}/")] += 1
        now = time.monotonic()
        if now - self._told.get(key, -REPEAT_TIME) >= REPEAT_TIME:
            self._told[key] = now
            self.cross(lambda: self._doors.refuse(key, why))

    def guarded(self, key: str, answer: Callable[[zenoh.Query], bytes]) -> Callable[[zenoh.Query], None]:
        """A queryable's callback: always one reply, an error where there is no answer."""

        def handle(query: zenoh.Query) -> None:
            with query:
                try:
                    query.reply(key, answer(query))
                except Exception as error:
                    self.refuse(key, str(error))
                    query.reply_err(str(error).encode())

        return handle


def read(payload: Any, bound: int = LARGEST_MESSAGE) -> bytes:
    """A payload, unless it is larger than what its key carries: then it is not even copied.

    Raises:
        MessageError: it is larger.
    """
    if len(payload) > bound:
        raise MessageError(f"{len(payload)} bytes; a message here has at most {bound}")
    return bytes(payload)


def read_query(query: zenoh.Query, bound: int = LARGEST_MESSAGE) -> bytes:
    """What a query carries, as ``read``; nothing where it carries nothing."""
    return b"" if query.payload is None else read(query.payload, bound)
