"""Work spread over processes of its own, its results as they come."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import queue
import signal
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
LOOK = 5.0
"""s between two looks at whether the workers still live."""
_PR_SET_PDEATHSIG = 1


def spread(items: Iterable[Item], act: Callable[[Item, Callable[[Result], None]], None], jobs: int) -> Iterator[Result]:
    """``act(item, tell)`` for every item, in ``jobs`` processes; what they tell, in the order of its arrival.

    Raises:
        RuntimeError: a process was killed; what it was at is lost.
    """
    context = multiprocessing.get_context("spawn")
    waiting, results = context.Queue(), context.Queue()
    for item in items:
        waiting.put(item)
    workers = [context.Process(target=_work, args=(act, waiting, results), daemon=True) for _ in range(jobs)]
    for worker in workers:
        waiting.put(None)
        worker.start()
    try:
        while jobs:
            try:
                done, result = results.get(timeout=LOOK)
            except queue.Empty:
                if killed := [worker.exitcode for worker in workers if worker.exitcode]:
                    raise RuntimeError(f"a worker ended with code {killed[0]}") from None
                continue
            if done:
                jobs -= 1
            else:
                yield result
    finally:
        for worker in workers:
            worker.terminate()
            worker.join()


def _work(act: Callable[..., None], waiting: Any, results: Any) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)  # with whoever wants the results, or it runs for hours
    for item in iter(waiting.get, None):
        act(item, lambda result: results.put((False, result)))
    results.put((True, None))
    results.close()
    results.join_thread()
    os._exit(0)  # the solvers' bindings have much to say about an interpreter that ends
