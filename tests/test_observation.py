"""The observation's layout by index, its two readings, its scales and its memory."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import Workbench, policy, variant

from runtime.control.observation import OBSERVATION_NAMES, observe
from runtime.control.policy import Terms
from runtime.control.records import Clamp

INDEX = {name: index for index, name in enumerate(OBSERVATION_NAMES)}
PLACES = [("height", 0), ("roll", 1), ("pitch", 2), ("yaw", 3), ("velocity_x", 4), ("velocity_y", 5), ("velocity_z", 6),
          ("rate_x", 7), ("rate_y", 8), ("rate_z", 9), ("contact_FL", 10), ("contact_FR", 11), ("contact_BL", 12),
          ("contact_BR", 13)]  # fmt: skip


def bench(reading: str, **changes: object) -> Workbench:
    ones = variant(
        policy(), reading=reading, observation_scale=(1.0,) * 28, observation_offset=(), terms=Terms(**changes)
    )
    known = Workbench(chosen=ones)
    known.t.height, known.t.rpy = 0.6, (0.01, 0.02, 0.03)
    known.t.twist = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
    known.t.contacts = (1, 0, 0, 1)
    known.t.velocity_command = (0.35, 0.1, 0.2)
    known.s.followed, known.s.heading = (0.3, 0.1, 0.2), 0.01
    return known


def look(known: Workbench) -> np.ndarray:
    observe(known.p, known.chosen, known.s, known.t)
    return np.array(known.t.observation)


def test_there_are_28_names_the_second_half_those_of_the_first_one_tick_ago() -> None:
    assert len(OBSERVATION_NAMES) == 28
    assert [name + "_before" for name in OBSERVATION_NAMES[:14]] == list(OBSERVATION_NAMES[14:])


@pytest.mark.parametrize(("name", "index"), PLACES)
def test_layout_by_index(name: str, index: int) -> None:
    """The plain reading: each number of the estimate is found at its place and nowhere else."""
    assert INDEX[name] == index
    expected = [0.6, 0.01, 0.02, 0.03, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1, 0, 0, 1]
    found = look(bench("plain"))
    assert found[index] == expected[index]
    assert found[14 + index] == expected[index]


def test_relative_reading_subtracts_what_is_wanted() -> None:
    known = bench("relative")
    found = look(known)
    assert found[INDEX["height"]] == pytest.approx(0.6 - known.config.gait.walking_height)
    assert found[INDEX["yaw"]] == pytest.approx(0.03 - 0.01)
    np.testing.assert_allclose(found[4:6], [0.4 - 0.35, 0.5 - 0.1])
    assert found[INDEX["rate_z"]] == pytest.approx(0.9 - 0.2)
    untouched = [1, 2, 6, 7, 8, 10, 11, 12, 13]
    np.testing.assert_array_equal(found[untouched], look(bench("plain"))[untouched])


def test_yaw_error_takes_the_short_way_round() -> None:
    known = bench("relative")
    known.t.rpy[2], known.s.heading = -3.1, 3.1
    assert look(known)[INDEX["yaw"]] == pytest.approx(2 * np.pi - 6.2)


def test_velocity_error_is_bounded_and_says_so() -> None:
    known = bench("relative", velocity_error_bound=0.2)
    found = look(known)
    np.testing.assert_allclose(found[4:6], [0.05, 0.2])
    assert known.t.clamps & Clamp.OBSERVATION
    free = bench("relative")
    look(free)
    assert not free.t.clamps & Clamp.OBSERVATION


def test_level_is_the_grounds_slope_where_the_policy_follows_it() -> None:
    known = bench("relative", slope_body=0.5)
    known.t.slope = (0.2, -0.1)
    found = look(known)
    assert found[INDEX["roll"]] == pytest.approx(0.01 - 0.5 * np.arctan(-0.1))
    assert found[INDEX["pitch"]] == pytest.approx(0.02 + 0.5 * np.arctan(0.2))


def test_second_half_is_the_tick_before_at_its_own_scale() -> None:
    scale = tuple(np.arange(1.0, 29.0))
    known = bench("plain")
    known.chosen.observation_scale = scale
    first = look(known)
    known.t.height, known.t.twist = 0.5, np.zeros(6)
    second = look(known)
    np.testing.assert_allclose(second[14:] / scale[14:], first[:14] / scale[:14])
    assert second[0] == 0.5 and second[14] == pytest.approx(0.6 * 15.0)


def test_the_offset_is_taken_before_the_scale() -> None:
    scale, offset = np.arange(1.0, 29.0), np.linspace(-1.0, 1.0, 28)
    plain = look(bench("plain"))
    known = bench("plain")
    known.chosen.observation_scale, known.chosen.observation_offset = scale, offset
    np.testing.assert_allclose(look(known), (plain - offset) * scale)


def test_the_first_tick_has_itself_as_its_past() -> None:
    found = look(bench("plain"))
    np.testing.assert_array_equal(found[:14], found[14:])
