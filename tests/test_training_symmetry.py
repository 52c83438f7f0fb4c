from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from training.symmetry import (
    FRONT_BACK,
    LEFT_RIGHT,
    Mirror,
    fold_under,
    mirror_action,
    mirror_grf_action,
    mirror_matrix,
    mirror_observation,
    no_folding,
    symmetry_error,
)

REFLECTIONS = [LEFT_RIGHT, FRONT_BACK]
MATRIX = [mirror_matrix(mirror_action(reflection), mirror_observation(reflection)) for reflection in REFLECTIONS]
seeds = st.integers(0, 2**32 - 1)


@pytest.mark.parametrize(
    "mirror", [m(r) for m in (mirror_observation, mirror_action, mirror_grf_action) for r in REFLECTIONS]
)
def test_a_mirror_of_a_mirror_is_the_original(mirror: Mirror) -> None:
    vector = np.random.default_rng(0).standard_normal(len(mirror.source))
    np.testing.assert_array_equal(mirror.apply(mirror.apply(vector)), vector)


def test_left_right_turns_lateral_things_around() -> None:
    observation = np.zeros(28)
    observation[[1, 2, 5, 9, 10]] = [0.1, 0.2, 0.3, 0.4, 1.0]  # roll, pitch, vy, yaw rate, FL contact
    mirrored = mirror_observation(LEFT_RIGHT).apply(observation)
    np.testing.assert_allclose(mirrored[[1, 2, 5, 9, 10, 11]], [-0.1, 0.2, -0.3, -0.4, 0.0, 1.0])
    action = np.zeros(18)
    action[[0, 1, 13, 15, 16]] = [1.0, 2.0, 3.0, 4.0, 5.0]  # FL shift x y, force y, moment x y
    mirrored = mirror_action(LEFT_RIGHT).apply(action)
    np.testing.assert_allclose(mirrored[[0, 1, 3, 4, 13, 15, 16]], [0, 0, 1.0, -2.0, -3.0, -4.0, 5.0])


def test_moment_mirrors_as_the_cross_product_of_mirrored_arm_and_force() -> None:
    rng = np.random.default_rng(2)
    for polar, _ in REFLECTIONS:
        arm, force = rng.standard_normal((2, 3))
        np.testing.assert_allclose(np.cross(polar * arm, polar * force), -polar * np.cross(arm, force))


@given(seeds)
def test_unfolded_vectors_are_symmetric_under_every_mirror(seed: int) -> None:
    for mirrors in (MATRIX[:1], MATRIX[1:], MATRIX):
        folding = fold_under(mirrors, 504)
        vector = folding.unfold(np.random.default_rng(seed).standard_normal(folding.size))
        for mirror in mirrors:
            np.testing.assert_array_equal(mirror.apply(vector), vector)


@given(seeds)
def test_a_symmetric_policy_answers_the_mirrored_observation_with_the_mirrored_action(seed: int) -> None:
    rng = np.random.default_rng(seed)
    folding = fold_under(MATRIX, 504)
    matrix = folding.unfold(rng.standard_normal(folding.size)).reshape(18, 28)
    observation = rng.standard_normal(28)
    for reflection in REFLECTIONS:
        answer = matrix @ mirror_observation(reflection).apply(observation)
        np.testing.assert_allclose(answer, mirror_action(reflection).apply(matrix @ observation), atol=1e-12)


def test_fold_is_the_nearest_symmetric_vector() -> None:
    folding = fold_under(MATRIX[:1], 504)
    vector = np.random.default_rng(5).standard_normal(504)
    np.testing.assert_allclose(folding.unfold(folding.fold(vector)), (vector + MATRIX[0].apply(vector)) / 2, atol=1e-12)


def test_sizes_halve() -> None:
    assert fold_under(MATRIX[:1], 504).size == 252
    assert fold_under([], 504).size == no_folding(504).size == 504


def test_an_entry_that_mirrors_to_its_own_negative_is_zero() -> None:
    folding = fold_under([Mirror(np.array([0, 1]), np.array([-1.0, 1.0]))], 2)
    assert folding.size == 1
    np.testing.assert_array_equal(folding.unfold(np.array([7.0])), [0.0, 7.0])


def test_symmetry_error_runs_from_nought_to_two() -> None:
    mirror = Mirror(np.array([1, 0]), np.ones(2))
    assert symmetry_error(np.array([1.0, 1.0]), mirror) == 0.0
    assert symmetry_error(np.array([1.0, -1.0]), mirror) == pytest.approx(2.0)
    assert symmetry_error(np.zeros(2), mirror) == 0.0
