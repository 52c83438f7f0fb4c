"""Sensors read the exact state, off by what the noise says and no more."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.robot import Measurement
from runtime.config import ROBOTS, load
from sim import sensing
from sim.rotation import from_rpy, from_xyzw, to_quaternion
from sim.scenario import Noise, Push, Scenario
from sim.sensing import BODY, GRAVITY, POSITION, RATE, RAW, READINGS, VELOCITY, read_body
from sim.sensors import AMBIENT, RISE, WARMING_TIME, Sensors
from sim.terrain import HeightField

LIMITS = load(ROBOTS / "stoch3.toml").robot.joints
ROTATION = from_rpy((0.3, -0.2, 1.0))
EXACT = (to_quaternion(ROTATION), np.array([0.1, 0.2, 0.3]), np.array([0.0, 1.0, 9.0]))
JOINTS = (np.full((4, 3), 0.5), np.full((4, 3), -1.0), np.full((4, 3), 7.0))
WHITE = {
    "joint_position": 0.01,
    "joint_velocity": 0.2,
    "joint_torque": 0.5,
    "orientation": 0.02,
    "angular_velocity": 0.05,
    "linear_acceleration": 0.3,
}


def read(sensors: Sensors) -> Measurement:
    return sensors.read(0.25, np.concatenate([np.ravel(JOINTS), *EXACT]))


def errors(measurement: Measurement) -> dict[str, np.ndarray]:
    w, x, y, z = measurement.imu.orientation
    tilt = ROTATION.T @ from_xyzw((x, y, z, w))
    return {
        "joint_position": (measurement.joints.position - JOINTS[0]).ravel(),
        "joint_velocity": (measurement.joints.velocity - JOINTS[1]).ravel(),
        "joint_torque": (measurement.joints.torque - JOINTS[2]).ravel(),
        "orientation": np.array([tilt[2, 1], tilt[0, 2], tilt[1, 0]]),
        "angular_velocity": measurement.imu.angular_velocity - EXACT[1],
        "linear_acceleration": measurement.imu.linear_acceleration - EXACT[2],
    }


def test_without_noise_the_reading_is_exact() -> None:
    measurement = read(Sensors(LIMITS))
    assert measurement.stamp == measurement.imu.stamp == 0.25
    for error in errors(measurement).values():
        np.testing.assert_allclose(error, 0.0, atol=1e-15)
    assert not measurement.joints.fault.any()
    assert not measurement.joints.age.any()


@pytest.mark.parametrize("name", WHITE)
def test_white_noise_has_its_deviation_and_touches_nothing_else(name: str) -> None:
    sensors = Sensors(LIMITS)
    sensors.reset(Noise(**{name: WHITE[name]}), seed=3)
    samples = [errors(read(sensors)) for _ in range(600)]
    for other in WHITE:
        values = np.array([sample[other] for sample in samples])
        if other == name:
            assert values.std() == pytest.approx(WHITE[name], rel=0.08)
            assert abs(values.mean()) < 5 * WHITE[name] / np.sqrt(values.size)
            assert abs(np.corrcoef(values[:-1, 0], values[1:, 0])[0, 1]) < 0.2
        else:
            np.testing.assert_allclose(values, 0.0, atol=1e-15)


@pytest.mark.parametrize("name", [name for name in WHITE if name != "joint_velocity"])
def test_a_bias_stays_for_the_episode_and_changes_with_the_seed(name: str) -> None:
    sensors = Sensors(LIMITS)
    drawn = []
    for seed in range(300):
        sensors.reset(Noise(**{f"{name}_bias": WHITE[name]}), seed)
        first, second = errors(read(sensors)), errors(read(sensors))
        np.testing.assert_array_equal(first[name], second[name])
        drawn.append(first[name])
    assert np.std(drawn) == pytest.approx(WHITE[name], rel=0.12)


def test_the_same_seed_reads_the_same_bits() -> None:
    sensors = Sensors(LIMITS)
    runs = []
    for _ in range(2):
        sensors.reset(Noise(**WHITE), seed=9)
        runs.append(np.concatenate([np.concatenate(list(errors(read(sensors)).values())) for _ in range(5)]))
    np.testing.assert_array_equal(runs[0], runs[1])


def test_motors_warm_to_their_rated_rise_and_cool_again() -> None:
    sensors = Sensors(LIMITS)
    rated = np.tile(np.array(LIMITS.continuous_torque), (2, 4))
    seen = []
    for torque in [rated] * 2000 + [0 * rated] * 2000:
        sensors.warm(torque, WARMING_TIME / 200)
        seen.append(read(sensors).joints.temperature)
    temperature = np.array(seen)
    assert (np.diff(temperature[:1000], axis=0) > 0).all()
    np.testing.assert_allclose(temperature[1999], AMBIENT + RISE, atol=0.1)
    np.testing.assert_allclose(temperature[-1], AMBIENT, atol=0.1)


def test_negative_noise_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"noise orientation = -0\.1"):
        Noise(orientation=-0.1)


@pytest.mark.parametrize("name", ["friction", "payload", "motor_strength", "extra_delay"])
@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
def test_an_impossible_scenario_is_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"scenario {name} = {value}"):
        Scenario(**{name: value})


def test_a_pose_of_another_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"shape \(12,\)"):
        Scenario(joint_position=np.zeros(12))


@pytest.mark.parametrize("change", [{"rpy": (0.0, np.nan, 0.0)}, {"height": np.inf}, {"velocity": (np.inf, 0.0, 0.0)}])
def test_a_scenario_that_is_not_finite_is_refused_by_name(change: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=f"scenario {next(iter(change))} = .*: must be finite"):
        Scenario(**change)  # type: ignore[arg-type]


def test_a_scenario_travels_to_a_worker_process() -> None:
    scenario = Scenario(terrain=HeightField(0.05, extent=4.0), pushes=(Push(0.1, 0.2, (1.0, 0.0, 0.0)),), seed=3)
    assert pickle.loads(pickle.dumps(scenario)) == scenario


@given(st.integers(0, 2**32 - 1))
def test_the_compiled_readings_are_those_of_the_rotations_written_plainly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn, principal = from_rpy(rng.uniform(-3.1, 3.1, 3)), from_rpy(rng.uniform(-3.1, 3.1, 3))
    w, x, y, z = to_quaternion(turn)
    raw, com, before = rng.normal(0.0, 2.0, RAW), rng.normal(0.0, 0.1, 3), rng.normal(0.0, 1.0, 3)
    raw[39:43] = x, y, z, w
    body, exact = np.zeros(BODY), np.zeros(READINGS)
    read_body(raw, com, principal, before, 0.005, body, exact)
    rotation = turn @ principal.T
    velocity = raw[43:46] - np.cross(raw[46:49], rotation @ com)
    np.testing.assert_allclose(body[sensing.ROTATION].reshape(3, 3), rotation, atol=1e-12)
    np.testing.assert_allclose(body[POSITION], raw[36:39] - rotation @ com, atol=1e-12)
    np.testing.assert_allclose(body[VELOCITY], velocity, atol=1e-12)
    np.testing.assert_array_equal(body[RATE], raw[46:49])
    quaternion = to_quaternion(rotation)
    np.testing.assert_allclose(exact[36:40] * np.sign(exact[36:40] @ quaternion), quaternion, atol=1e-9)
    np.testing.assert_allclose(exact[40:43], rotation.T @ raw[46:49], atol=1e-12)
    felt = rotation.T @ ((velocity - before) / 0.005 + [0.0, 0.0, GRAVITY])
    np.testing.assert_allclose(exact[43:46], felt, atol=1e-9)
