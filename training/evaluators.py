"""Population → episodes, on all cores of this machine or on a Ray cluster. The result is the same bits for any number.

Each worker keeps one ``Stage`` and computes with one BLAS thread; what a run has in common travels to it once.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Any, Protocol

import numpy as np

from training.rollout import Episode, Setup, Stage, Task

ATTEMPTS = 3
"""Workers that a task may lose before it counts as lost itself."""
LOST = Episode(fitness=float("nan"), steps=0, fell=True)
"""An episode that killed every worker it met, or whose numbers failed: it ranks lowest and is counted."""
BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


class Evaluator(Protocol):
    """Tasks in, their episodes out, in the same order."""

    def evaluate(self, tasks: Sequence[Task]) -> list[Episode]:
        """Play every task."""

    def close(self) -> None:
        """Let the workers go."""


class InProcess:
    """All episodes in this process: for one core, for tests and for debugging."""

    def __init__(self, setup: Setup) -> None:
        self._stage = Stage(setup)

    def evaluate(self, tasks: Sequence[Task]) -> list[Episode]:
        """Play every task."""
        return [attempt(self._stage, task) for task in tasks]

    def close(self) -> None:
        """Release the simulator."""
        self._stage.close()


class Processes:
    """A process for every core. One that dies is replaced, and what it held is played again."""

    def __init__(self, setup: Setup, workers: int | None = None) -> None:
        self.workers = workers or len(os.sched_getaffinity(0))
        self.restarts = 0
        """How often the workers had to be started anew."""
        self._setup = setup
        self._pool = self._start()

    def evaluate(self, tasks: Sequence[Task]) -> list[Episode]:
        """Play every task; one that kills its worker ``ATTEMPTS`` times is ``LOST``."""
        episodes: dict[int, Episode] = {}
        attempts = [0] * len(tasks)
        while len(episodes) < len(tasks):
            self._round(tasks, episodes, attempts)
        return [episodes[index] for index in range(len(tasks))]

    def close(self) -> None:
        """End the workers."""
        self._pool.shutdown(cancel_futures=True)

    def _round(self, tasks: Sequence[Task], episodes: dict[int, Episode], attempts: list[int]) -> None:
        """Play what is missing; after a death, first what may have caused it, one at a time."""
        missing = [index for index in range(len(tasks)) if index not in episodes]
        if any(attempts[index] for index in missing):
            missing = [next(index for index in missing if attempts[index])]
        waiting: dict[Future[Episode], int] = {}
        try:
            waiting = {self._pool.submit(_play, tasks[index]): index for index in missing}
            for future in as_completed(waiting):
                episodes[waiting[future]] = future.result()
                attempts[waiting[future]] = 0
        except BrokenProcessPool:
            self._collect(waiting, missing, episodes, attempts)
            self.restarts += 1
            self._pool.shutdown(wait=True)
            self._pool = self._start()

    def _collect(
        self, waiting: dict[Future[Episode], int], missing: list[int], episodes: dict[int, Episode], attempts: list[int]
    ) -> None:
        """Keep what was finished before the death, and suspect the earliest that were not."""
        for future, index in waiting.items():
            if future.done() and future.exception() is None:
                episodes[index] = future.result()
        unfinished = [index for index in missing if index not in episodes]
        for index in unfinished[: 2 * self.workers + 1]:
            attempts[index] += 1
            if len(missing) == 1 and attempts[index] >= ATTEMPTS:
                episodes[index] = LOST

    def _start(self) -> ProcessPoolExecutor:
        for name in BLAS_THREADS:
            os.environ[name] = "1"
        return ProcessPoolExecutor(self.workers, get_context("spawn"), _enter, (self._setup,))


_stage: Stage | None = None
PR_SET_PDEATHSIG = 1
"""Linux: which signal a process gets when its parent dies."""


def _enter(setup: Setup) -> None:
    """Prepare a worker, once."""
    import signal

    global _stage
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the trainer's: it finishes what is begun
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # a killed trainer leaves no worker behind
    _stage = Stage(setup)


def _play(task: Task) -> Episode:
    assert _stage is not None, "a worker starts with _enter"
    return attempt(_stage, task)


def attempt(stage: Stage, task: Task) -> Episode:
    """Play a task; numbers that fail on the way make it ``LOST`` instead of ending the run."""
    if not np.isfinite(task.parameters).all():
        return LOST
    try:
        episode = stage.rollout(task)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):
        return LOST
    return episode if np.isfinite(episode.fitness) else LOST


def make_evaluator(setup: Setup, workers: int | None = None, ray_address: str | None = None) -> Evaluator:
    """The evaluator that fits: this process for one worker, a Ray cluster where an address is given."""
    if ray_address is not None:
        from training.ray_evaluator import RayCluster

        cluster: Any = RayCluster(setup, ray_address)
        return cluster  # type: ignore[no-any-return]
    return InProcess(setup) if workers == 1 else Processes(setup, workers)
