"""The ground knows its own height, and a foot set down on it just touches."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.terrain import HeightField, Plane, Slope, Steps, Terrain, resting_height

FIELD = HeightField(amplitude=0.05, spacing=0.1, seed=4, extent=6.0)
places = st.floats(-2.9, 2.9)


@given(places, places, st.floats(-0.5, 0.5), st.floats(-3.2, 3.2))
def test_a_slope_is_the_plane_of_its_normal(x: float, y: float, angle: float, direction: float) -> None:
    slope = Slope(angle, direction)
    normal = np.array(slope.normal)
    assert np.linalg.norm(normal) == pytest.approx(1.0)
    assert normal[2] == pytest.approx(math.cos(angle))
    assert normal @ [x, y, slope.height_at(x, y)] == pytest.approx(0.0, abs=1e-12)


def test_a_slope_rises_along_its_direction() -> None:
    assert Slope(0.1, math.pi / 2).height_at(0.0, 1.0) == pytest.approx(math.tan(0.1))
    assert Slope(-0.1).height_at(1.0, 5.0) == pytest.approx(-math.tan(0.1))


def test_steps_rise_one_by_one_to_a_platform() -> None:
    steps = Steps(height=0.1, depth=0.3, count=3, start=1.0)
    treads = [steps.height_at(x, 0.0) for x in (0.0, 0.99, 1.01, 1.29, 1.31, 1.61, 5.0)]
    np.testing.assert_allclose(treads, [0.0, 0.0, 0.1, 0.1, 0.2, 0.3, 0.3])
    assert steps.height_at(5.0, steps.width) == 0.0
    assert steps.height_at(steps.end + 0.1, 0.0) == 0.0


@given(places, places)
def test_a_height_field_stays_within_its_amplitude_and_is_continuous(x: float, y: float) -> None:
    here = FIELD.height_at(x, y)
    assert abs(here) <= FIELD.amplitude + 1e-9
    steepest = 2 * FIELD.amplitude / FIELD.spacing * math.sqrt(2)
    assert abs(FIELD.height_at(x + 1e-4, y) - here) <= steepest * 1e-4 + 1e-12
    assert abs(FIELD.height_at(x, y + 1e-4) - here) <= steepest * 1e-4 + 1e-12


def test_a_height_field_passes_through_its_lattice() -> None:
    half = FIELD.extent / 2
    for j, i in ((0, 0), (10, 31), (60, 60), (59, 0)):
        x, y = i * FIELD.spacing - half, j * FIELD.spacing - half
        assert FIELD.height_at(x, y) == pytest.approx(FIELD.heights[j, i], abs=1e-9)
    assert FIELD.height_at(half + 0.2, 0.0) == -FIELD.amplitude


def test_height_fields_differ_by_seed_alone() -> None:
    np.testing.assert_array_equal(HeightField(0.05, 0.1, 4, 6.0).heights, FIELD.heights)
    assert (HeightField(0.05, 0.1, 5, 6.0).heights != FIELD.heights).any()
    assert HeightField(0.05, 0.1, 4, 6.0) == FIELD


@pytest.mark.parametrize("terrain", [Plane(), Slope(0.3, 1.0), Steps(0.1, start=0.2), FIELD])
def test_a_foot_at_its_resting_height_just_touches(terrain: Terrain) -> None:
    radius = 0.03
    feet = np.array([[0.27, 0.2, -0.5], [0.27, -0.2, -0.5], [-0.27, 0.2, -0.5], [-0.27, -0.2, -0.48]])
    centres = feet + np.array([0.0, 0.0, resting_height(terrain, feet, radius)])
    grid = np.linspace(-radius, radius, 61)
    gaps = [
        math.dist((x + dx, y + dy, terrain.height_at(x + dx, y + dy)), (x, y, z)) - radius
        for x, y, z in centres
        for dx in grid
        for dy in grid
        if math.hypot(dx, dy) <= radius
    ]
    assert -1e-3 < min(gaps) < 1e-3


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Slope(1.2), r"slope angle = 1\.2"),
        (lambda: Steps(0.0), r"steps height = 0\.0"),
        (lambda: Steps(0.1, count=-1), r"steps count = -1"),
        (lambda: HeightField(-0.1), r"height field amplitude = -0\.1"),
        (lambda: HeightField(0.1, spacing=0.0), r"height field spacing = 0\.0"),
        (lambda: HeightField(0.1, spacing=5.0, extent=6.0), r"height field spacing = 5\.0"),
    ],
)
def test_impossible_ground_is_refused_by_name(build: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build()  # type: ignore[operator]
