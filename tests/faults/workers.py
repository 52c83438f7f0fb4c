"""Work spread over processes of its own, its results as they come."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def spread(items: Iterable[Item], act: Callable[[Item, Callable[[Result], None]], None], jobs: int) -> Iterator[Result]:
    """``act(item, tell)`` for every item, in ``jobs`` processes; what they tell, in the order of its arrival."""
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
            done, result = results.get()
            if done:
                jobs -= 1
            else:
                yield result
    finally:
        for worker in workers:
            worker.terminate()
            worker.join()


def _work(act: Callable[..., None], waiting: Any, results: Any) -> None:
    for item in iter(waiting.get, None):
        act(item, lambda result: results.put((False, result)))
    results.put((True, None))
    results.close()
    results.join_thread()
    os._exit(0)  # the solvers' bindings have much to say about an interpreter that ends
