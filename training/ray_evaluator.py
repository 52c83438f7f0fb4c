"""The same evaluation on a Ray cluster: an actor for every CPU, the run's common part in the object store once."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from typing import Any

from training.evaluators import ATTEMPTS, LOST, attempt
from training.rollout import Episode, Setup, Stage, Task

KNOCK = 5.0
"""s that a cluster has to answer."""


class ClusterError(ConnectionError):
    """No Ray cluster at the address, or no Ray."""


class _Actor:
    """A worker on any node; restarted by Ray where it dies."""

    def __init__(self, setup: Setup) -> None:
        self._stage = Stage(setup)

    def play(self, task: Task) -> Episode:
        """Play one task."""
        return attempt(self._stage, task)


class RayCluster:
    """Episodes on every CPU of a cluster that already runs (``ray start``)."""

    def __init__(self, setup: Setup, address: str) -> None:
        """Join the cluster at ``address`` (``host:port``, or ``auto``).

        Raises:
            ClusterError: nobody answers there, or Ray is not installed; the message says which.
        """
        try:
            import ray
            from ray.util import ActorPool
        except ImportError as error:
            raise ClusterError("Ray is not installed: pip install 'trotd[ray]'") from error
        _knock(address)
        try:
            ray.init(address=address, log_to_driver=False, ignore_reinit_error=True)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise ClusterError(f"no Ray cluster at {address!r}: {error}") from error
        self._ray: Any = ray
        environment = {"env_vars": {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}}
        remote = ray.remote(num_cpus=1, max_restarts=-1, max_task_retries=ATTEMPTS, runtime_env=environment)(_Actor)
        self._shared = ray.put(setup)  # held: an actor that is restarted asks for it again
        self.workers = max(1, int(ray.cluster_resources().get("CPU", 1)))
        self._actors = [remote.remote(self._shared) for _ in range(self.workers)]
        self._pool: Any = ActorPool(self._actors)

    def evaluate(self, tasks: Sequence[Task]) -> list[Episode]:
        """Play every task, each on the next free actor."""
        for task in tasks:
            self._pool.submit(lambda actor, task: actor.play.remote(task), task)
        episodes: list[Episode] = [LOST] * len(tasks)
        for index in range(len(tasks)):
            try:
                episodes[index] = self._pool.get_next()
            except self._ray.exceptions.RayActorError:
                episodes[index] = LOST
        return episodes

    def close(self) -> None:
        """Leave the cluster; it keeps running."""
        for actor in self._actors:
            self._ray.kill(actor)
        self._ray.shutdown()


def _knock(address: str) -> None:
    """Ray itself would try for minutes where nobody is."""
    host, _, port = address.rpartition(":")
    if not port.isdigit():
        return
    try:
        socket.create_connection((host, int(port)), KNOCK).close()
    except OSError as error:
        raise ClusterError(f"no Ray cluster at {address!r}: {error.strerror or error}") from error
