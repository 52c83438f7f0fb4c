from __future__ import annotations

import msgspec
import numpy as np
import pytest

from runtime import config as configuration
from runtime.config import Config
from runtime.control.policy import Policy
from training.inspection import BOX, NotLinear, compare, describe, inspect, worst_case
from training.variants import VARIANTS, make_policy, reading_contacts, with_parameters


@pytest.fixture(scope="module")
def config() -> Config:
    return configuration.load(configuration.find_robot("stoch3"))


def policy(config: Config, seed: int = 0) -> Policy:
    made = make_policy(config.robot, config.control.gait.walking_height, VARIANTS["linear"], terms=False, name="tried")
    return with_parameters(made, np.random.default_rng(seed).standard_normal(504))


def test_physical_units_undo_the_scales(config: Config) -> None:
    tried = policy(config)
    observation = np.random.default_rng(1).standard_normal(28)
    scaled = np.array(tried.matrix) @ (observation * np.array(tried.observation_scale)) * np.array(tried.action_scale)
    np.testing.assert_allclose(inspect(tried).physical @ observation, scaled)


def test_the_worst_case_is_reached_and_never_passed(config: Config) -> None:
    tried = reading_contacts(policy(config), True)
    physical = inspect(tried).physical
    offset = np.array(tried.observation_offset)
    assert set(offset) == {0.0, 1.0}
    worst = worst_case(physical, offset)
    rng = np.random.default_rng(2)
    low = np.concatenate([-BOX[:10], np.zeros(4)] * 2)
    high = np.concatenate([BOX, BOX])
    samples = rng.uniform(low, high, (2000, 28))
    assert (np.abs((samples - offset) @ physical.T).max(axis=0) <= worst + 1e-9).all()
    corners = np.concatenate([np.where(physical > 0, high, low), np.where(physical > 0, low, high)])
    reached = np.abs((corners - offset) @ physical.T)
    np.testing.assert_allclose(reached.max(axis=0), worst)


def test_a_dead_contact_changes_actions_by_its_two_columns(config: Config) -> None:
    tried = policy(config)
    found = inspect(tried)
    felt = np.zeros(28)
    felt[[11, 25]] = 1.0
    np.testing.assert_allclose(found.dead_contact[:, 1], np.abs(found.physical @ felt))


def test_the_text_names_every_action_and_the_symmetry(config: Config) -> None:
    text = describe(policy(config))
    assert all(name in text for name in policy(config).action_names)
    assert "left-right symmetry error" in text and "504 numbers" in text


def test_the_difference_names_the_entry_that_changed(config: Config) -> None:
    first = policy(config)
    numbers = first.parameters.copy()
    numbers[13 * 28 + 5] += 10.0
    text = compare(first, with_parameters(first, numbers))
    assert "force_y        by velocity_y" in text
    assert text.count(" by ") == 1


def test_what_has_no_matrix_is_refused(config: Config) -> None:
    height = config.control.gait.walking_height
    with pytest.raises(NotLinear, match="16 neurons"):
        inspect(make_policy(config.robot, height, VARIANTS["mlp"], terms=False))
    direct = make_policy(config.robot, height, VARIANTS["linear-grf"], terms=False)
    with pytest.raises(ValueError, match="other actions"):
        compare(policy(config), direct)
    assert inspect(direct).left_right == 0.0


def test_other_terms_show_in_the_difference(config: Config) -> None:
    first = policy(config)
    second = msgspec.structs.replace(first, terms=msgspec.structs.replace(first.terms, capture_point=0.1))
    assert "capture_point=0.1" in compare(first, second)
