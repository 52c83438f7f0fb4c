from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.robot import Array
from training import reward
from training.reward import FEATURES, TableReward, TaskReward, gaussian_kernel
from training.rigid_body import rotation_from_rpy

seeds = st.integers(0, 2**32 - 1)
WEIGHT = 25.0 * 9.81


def sample(rng: np.random.Generator) -> dict[str, Array]:
    return {
        "position": rng.normal(0, 0.3, 3),
        "velocity": rng.normal(0, 0.1, 3),
        "rpy": rng.normal(0, 0.1, 3),
        "angular_velocity": rng.normal(0, 0.1, 3),
        "grf": rng.normal(0, 20, (4, 3)),
    }


def features(state: dict[str, Array]) -> Array:
    out = np.empty(FEATURES)
    reward.fill_features(
        state["position"],
        state["velocity"],
        rotation(state["rpy"]),
        state["angular_velocity"],
        state["grf"],
        WEIGHT,
        out,
    )
    return out


def terms(reference: Array, current: Array, config: TableReward | None = None) -> Array:
    out = np.empty(5)
    reward.table_terms((config or TableReward()).table(), reference, current, out)
    return out


def rotation(rpy: Array) -> Array:
    out = np.empty((3, 3))
    rotation_from_rpy(rpy, out)
    return out


@settings(deadline=None)
@given(seeds)
def test_every_term_is_the_papers_kernel(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ref, now = sample(rng), sample(rng)
    expected = [
        gaussian_kernel(1, 10, ref["position"], now["position"]),
        gaussian_kernel(1, 50, ref["velocity"], now["velocity"]),
        gaussian_kernel(1, 50, rotation(ref["rpy"]), rotation(now["rpy"])),
        gaussian_kernel(1, 50, ref["angular_velocity"], now["angular_velocity"]),
        gaussian_kernel(30, 100, ref["grf"] / WEIGHT, now["grf"] / WEIGHT),
    ]
    np.testing.assert_allclose(terms(features(ref), features(now)), expected, rtol=1e-9, atol=1e-300)


def test_no_deviation_is_worth_34() -> None:
    same = features(sample(np.random.default_rng(0)))
    assert terms(same, same).sum() == TableReward().best == 34.0


@settings(deadline=None)
@given(seeds, st.integers(0, FEATURES - 1))
def test_any_deviation_costs_its_own_term_alone(seed: int, where: int) -> None:
    ref = features(sample(np.random.default_rng(seed)))
    now = ref.copy()
    now[where] += 0.05
    lost = TableReward().table()[:, 0] - terms(ref, now)
    owner = int(np.searchsorted([3, 6, 15, 18, 30], where, side="right"))
    assert lost[owner] > 0
    assert np.count_nonzero(lost) == 1


def test_grf_counts_as_a_share_of_the_weight() -> None:
    ref, now = sample(np.random.default_rng(0)), sample(np.random.default_rng(0))
    now["grf"] = now["grf"].copy()
    now["grf"][1, 2] += 0.1 * WEIGHT
    assert terms(features(ref), features(now))[4] == pytest.approx(30 * np.exp(-1.0))


def task(**change: object) -> Array:
    given_values: dict[str, object] = {
        "dt": 0.005, "smoothed": np.zeros(3), "command": np.zeros(3), "velocity": np.zeros(3), "rpy": np.zeros(3),
        "height_error": 0.0, "angular_velocity": np.zeros(3), "torque": np.zeros((4, 3)), "slip": 0.0,
    }  # fmt: skip
    given_values.update(change)
    out = np.empty(9)
    reward.task_terms(TaskReward().table(), *given_values.values(), out)
    return out


def test_perfect_walking_earns_the_sum_of_the_bounded_terms() -> None:
    assert task().sum() == pytest.approx(1 + 1 + 0.5 + 0.3 + 0.3 + 0.3)


@pytest.mark.parametrize(
    ("change", "term"),
    [
        ({"rpy": np.array([0.1, 0.0, 0.0])}, 3),
        ({"height_error": -0.02}, 4),
        ({"torque": np.full((4, 3), 10.0)}, 6),
        ({"slip": 0.4}, 7),
        ({"angular_velocity": np.array([0.0, 1.0, 0.0])}, 8),
    ],
)
def test_each_fault_costs_its_own_term(change: dict[str, object], term: int) -> None:
    lost = task() - task(**change)
    assert lost[term] > 0
    assert np.count_nonzero(lost) == 1


def test_task_terms_by_hand() -> None:
    assert task(torque=np.full((4, 3), 10.0))[6] == pytest.approx(-2e-5 * 1200)
    assert task(rpy=np.array([0.06, 0.08, 1.0]))[3] == pytest.approx(0.3 * np.exp(-1))
    assert task(velocity=np.array([0.09, 0.12, 0.0]))[5] == pytest.approx(0.3 * np.exp(-1))


def test_an_error_that_sways_within_a_step_costs_less_than_a_lasting_one() -> None:
    def total(errors: Array) -> float:
        smoothed = np.zeros(3)
        return float(sum(task(smoothed=smoothed, velocity=np.array([e, 0.0, 0.0]))[1] for e in errors))

    lasting = np.full(200, 0.1)
    swaying = lasting * np.where(np.arange(200) // 10 % 2, 1, -1)
    assert total(swaying) > 1.2 * total(lasting)
