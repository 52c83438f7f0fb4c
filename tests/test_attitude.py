"""Orientation from gyroscope and gravity: against exact rotations, with bias, shaking, and from any start."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.attitude import AttitudeFilter, level_orientation
from drivers.device_clock import DRIFT, DeviceClock
from drivers.mounting import Mounting

RATE = 400.0
G = 9.81


def rotation(quaternion: np.ndarray) -> np.ndarray:
    return Mounting(tuple(quaternion)).rotation_sensor_to_body


def tilt_error(quaternion: np.ndarray, up_in_sensor: np.ndarray) -> float:
    up = rotation(quaternion).T @ np.array([0.0, 0.0, 1.0])
    return math.acos(min(1.0, float(up @ up_in_sensor)))


@given(st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_level_orientation_points_gravity_up(direction):
    up = np.array(direction) / np.linalg.norm(direction)
    assert rotation(level_orientation(up * G)) @ up == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_turn_about_each_axis_is_followed(axis):
    attitude, angle = AttitudeFilter(RATE), 0.0
    speed, quaternion = 1.0, np.zeros(4)
    for _ in range(200):
        up = rotation(turn(axis, angle)).T @ np.array([0.0, 0.0, G])
        quaternion = attitude.update(speed * np.eye(3)[axis], up, 1 / RATE)
        angle += speed / RATE
    expected = turn(axis, angle)
    assert abs(float(quaternion @ expected)) == pytest.approx(1.0, abs=1e-4)


def turn(axis: int, angle: float) -> np.ndarray:
    quaternion = np.zeros(4)
    quaternion[0], quaternion[1 + axis] = math.cos(angle / 2), math.sin(angle / 2)
    return quaternion


def test_shaking_and_bias_leave_the_tilt_within_two_degrees():
    rng, attitude = np.random.default_rng(3), AttitudeFilter(RATE)
    up = np.array([0.1, -0.05, 1.0])
    up /= np.linalg.norm(up)
    bias = np.array([0.01, -0.01, 0.0])
    quaternion = attitude.update(bias, up * G, 1 / RATE)
    worst = 0.0
    for step in range(4000):
        shake = np.array([3.0, 2.0, 4.0]) * math.sin(2 * math.pi * 4.0 * step / RATE) + rng.normal(0, 0.5, 3)
        quaternion = attitude.update(bias + rng.normal(0, 0.01, 3), up * G + shake, 1 / RATE)
        worst = max(worst, tilt_error(quaternion, up))
    assert worst < math.radians(2.0)


def test_a_gap_does_not_turn_the_world():
    attitude = AttitudeFilter(RATE)
    still = np.array([0.0, 0.0, G])
    attitude.update(np.zeros(3), still, 1 / RATE)
    quaternion = attitude.update(np.array([0.0, 0.0, 3.0]), still, 5.0)
    assert quaternion[0] == pytest.approx(1.0, abs=1e-4)


quaternions = st.tuples(*[st.floats(-1, 1)] * 4).map(np.array).filter(lambda q: np.linalg.norm(q) > 0.3)


@given(quaternions, quaternions)
def test_a_mounted_sensor_says_the_same_of_the_world(mount, orientation):
    mount, orientation = mount / np.linalg.norm(mount), orientation / np.linalg.norm(orientation)
    mounting = Mounting(tuple(mount))
    in_sensor = np.array([0.3, -0.2, 0.9])
    through_body = rotation(mounting.orientation(orientation)) @ mounting.vector(in_sensor)
    assert through_body == pytest.approx(rotation(orientation) @ in_sensor, abs=1e-9)


def test_a_mount_that_is_no_rotation_is_refused():
    with pytest.raises(ValueError, match="norm is 2"):
        Mounting((2.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("wrong", [math.inf, -math.inf, math.nan])
def test_what_is_not_finite_stays_so_without_a_word(wrong):
    """The guard damps by it; numpy's warning in the middle of a tick would be one more thing that can fail."""
    mounting = Mounting((0.5, 0.5, 0.5, 0.5))
    assert not np.isfinite(mounting.vector(np.array([0.0, wrong, 9.81]))).all()
    assert not np.isfinite(mounting.orientation(np.array([1.0, wrong, 0.0, 0.0]))).all()


@given(st.lists(st.floats(0, 0.01), min_size=50, max_size=200))
@settings(max_examples=50)
def test_device_time_is_never_in_the_future_and_slow_deliveries_move_nothing(delays):
    clock, start = DeviceClock(1e4, 32), (1 << 32) - 300  # wraps on the way
    errors = []
    for index, delay in enumerate([0.0, *delays]):
        taken = 5.0 + index * 0.0025
        stamp = clock.stamp((start + index * 25) & 0xFFFFFFFF, taken + delay)
        assert stamp <= taken + delay + 1e-9
        errors.append(stamp - taken)
    assert max(abs(error) for error in errors) <= len(errors) * 0.01 * DRIFT * 2 + 1e-9


def test_a_drifting_device_clock_is_followed():
    clock = DeviceClock(1e4, 32)
    worst = 0.0
    for index in range(4000):
        taken = index * 0.0025 * (1 + 30e-6)
        worst = max(worst, abs(clock.stamp(index * 25, taken + 0.0005) - taken - 0.0005))
    assert worst < 1e-4
