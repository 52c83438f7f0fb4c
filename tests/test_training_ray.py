"""Two Ray nodes on loopback give the very bits of one process. Needs the extra ``[ray]``: ``make test-extras``."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from runtime import config as configuration
from runtime.control.policy import balance_policy
from training.evaluators import InProcess
from training.randomize import TASK, draw
from training.ray_evaluator import ClusterError, RayCluster
from training.reward import TaskReward
from training.rollout import Setup, Task

ray = pytest.importorskip("ray", reason="the extra [ray] is not installed: make test-extras")
pytestmark = [
    pytest.mark.filterwarnings("ignore"),  # Ray's own
    pytest.mark.timeout(300),
]
CONFIG = configuration.load(configuration.find_robot("stoch3"))
POLICY = balance_policy(CONFIG.robot, CONFIG.control.gait.walking_height)
SETUP = Setup(CONFIG, POLICY, TaskReward(), 60, physics_rate_hz=600.0)


def tasks(count: int) -> list[Task]:
    rng = np.random.default_rng(3)
    parameters = POLICY.parameters
    return [Task(parameters + 0.02 * rng.standard_normal(parameters.size), draw(TASK, rng)) for _ in range(count)]


@pytest.fixture
def cluster() -> Iterator[Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from ray.cluster_utils import Cluster

        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
        cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        yield cluster
        ray.shutdown()
        cluster.shutdown()


def test_two_nodes_give_the_bits_of_one_process_and_a_dead_worker_is_replaced(cluster: Any) -> None:
    alone = InProcess(SETUP)
    expected = alone.evaluate(tasks(6))
    alone.close()
    evaluator = RayCluster(SETUP, cluster.address)
    try:
        assert len([node for node in ray.nodes() if node["Alive"]]) == 2
        assert evaluator.workers == 2, "one CPU on each node, so an actor on each"
        assert evaluator.evaluate(tasks(6)) == expected
        ray.kill(evaluator._actors[0], no_restart=False)
        assert evaluator.evaluate(tasks(6)) == expected
    finally:
        evaluator.close()


def test_nobody_at_the_address_is_one_clear_error() -> None:
    with pytest.raises(ClusterError, match=r"no Ray cluster at '127\.0\.0\.1:1'"):
        RayCluster(SETUP, "127.0.0.1:1")
