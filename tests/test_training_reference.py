from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from runtime import config as configuration
from runtime.config import Config
from training import reference as episodes
from training.mpc import HORIZON, MpcConfig
from training.reference import Reference, ReferenceMismatch, RigidBodyWalk, load_reference, make_reference, ramp
from training.rigid_body import GRAVITY


@pytest.fixture(scope="module")
def config() -> Config:
    return configuration.load(configuration.find_robot("stoch3"))


@pytest.fixture(scope="module")
def reference(config: Config) -> Reference:
    return make_reference(config)


def test_the_teacher_reaches_and_keeps_the_papers_speed(reference: Reference) -> None:
    velocity = reference.features[:, 3:6]
    assert velocity[600:, 0].mean() == pytest.approx(0.8, abs=0.02)
    assert np.abs(velocity[600:, 1]).mean() < 0.03
    times = np.arange(1000) / reference.rate_hz
    wanted = np.where(times < 0.8, times**2 / 2, 0.32 + 0.8 * (times - 0.8))
    np.testing.assert_allclose(reference.features[:, 0], wanted, atol=0.05)


def test_it_stays_level_at_walking_height(reference: Reference, config: Config) -> None:
    np.testing.assert_allclose(reference.features[:, 2], config.control.gait.walking_height, atol=0.01)
    np.testing.assert_allclose(reference.features[:, 6:15], np.tile(np.eye(3).ravel(), (1000, 1)), atol=0.05)


def test_forces_carry_the_weight_two_legs_at_a_time(reference: Reference) -> None:
    forces = reference.features[:, 18:].reshape(-1, 4, 3)
    assert forces[400:, :, 2].sum(axis=1).mean() == pytest.approx(1.0, rel=0.01)
    carrying = forces[:, :, 2] > 0
    assert (carrying.sum(axis=1) == 2).all()
    assert (carrying[:, 0] == carrying[:, 3]).all() and (carrying[:, 0] != carrying[:, 1]).all()
    assert (np.abs(forces[:, :, :2]) <= 0.6 * forces[:, :, 2:] + 1e-9).all()


def test_velocity_is_the_derivative_of_position(reference: Reference) -> None:
    moved = np.diff(reference.features[:, :3], axis=0) * reference.rate_hz
    middle = (reference.features[1:, 3:6] + reference.features[:-1, 3:6]) / 2
    np.testing.assert_allclose(moved, middle, atol=5e-3)


def test_it_follows_an_arc_too(config: Config) -> None:
    walk = RigidBodyWalk(config, MpcConfig(), lambda time: np.array([0.5, 0.0, 0.5]))
    features = np.empty(30)
    for tick in range(800):
        walk.step(tick, features)
    assert walk.state[8] == pytest.approx(0.5 * 800 * walk.dt, abs=0.1)
    assert features[2] == pytest.approx(config.control.gait.walking_height, abs=0.02)


def test_the_planned_horizon_looks_at_the_gaits_next_stance(config: Config) -> None:
    walk = RigidBodyWalk(config, MpcConfig(), ramp)
    features = np.empty(30)
    walk.step(0, features)
    horizon = walk._look_ahead(0)
    assert horizon.reference.shape == (HORIZON, 12)
    assert (horizon.stance.sum(axis=1) == 2).all()
    assert (horizon.stance[0] != horizon.stance[-1]).all()


def test_lookup_is_by_time(reference: Reference) -> None:
    assert reference.index_at(0.0) == 0
    assert reference.index_at(0.1) == round(0.1 * reference.rate_hz)
    assert reference.index_at(1e9) == len(reference.features) - 1
    half, commands = reference.resampled(reference.rate_hz / 2, 400)
    np.testing.assert_array_equal(half, reference.features[:800:2])
    np.testing.assert_array_equal(commands, reference.commands[:800:2])


def test_an_episode_longer_than_the_reference_is_refused(reference: Reference) -> None:
    with pytest.raises(ReferenceMismatch, match="at most 1000 ticks"):
        reference.resampled(reference.rate_hz, 1001)


def test_saved_and_loaded_it_is_the_same(reference: Reference, config: Config, tmp_path: Path) -> None:
    path = tmp_path / "made" / "d.npz"
    episodes.save_reference(reference, path)
    loaded = load_reference(path, config)
    np.testing.assert_array_equal(loaded.features, reference.features)
    np.testing.assert_array_equal(loaded.commands, reference.commands)
    assert (loaded.robot, loaded.source, loaded.rate_hz) == ("stoch3", "rigid-body", reference.rate_hz)
    assert [file.name for file in path.parent.iterdir()] == ["d.npz"]


def test_another_robots_or_configs_reference_is_refused(reference: Reference, config: Config, tmp_path: Path) -> None:
    path = tmp_path / "d.npz"
    episodes.save_reference(reference, path)
    other = msgspec.structs.replace(config, robot=msgspec.structs.replace(config.robot, name="other"))
    with pytest.raises(ReferenceMismatch, match="robot = 'stoch3', this run needs 'other'"):
        load_reference(path, other)
    gait = msgspec.structs.replace(config.control.gait, walking_height=0.5)
    lower = msgspec.structs.replace(config, control=msgspec.structs.replace(config.control, gait=gait))
    with pytest.raises(ReferenceMismatch, match="config"):
        load_reference(path, lower)
    policy = msgspec.structs.replace(config, control=msgspec.structs.replace(config.control, policy="other.json"))
    assert load_reference(path, policy).robot == "stoch3"


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04 torn"])
def test_a_broken_file_is_refused_by_name(content: bytes, config: Config, tmp_path: Path) -> None:
    path = tmp_path / "d.npz"
    path.write_bytes(content)
    with pytest.raises(ReferenceMismatch, match="not a reference"):
        load_reference(path, config)


def test_a_failed_write_leaves_the_older_file(
    reference: Reference, config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "d.npz"
    episodes.save_reference(reference, path)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="No space"):
        episodes.save_reference(reference, path)
    assert load_reference(path, config).robot == "stoch3"
    assert [file.name for file in tmp_path.iterdir()] == ["d.npz"]


def test_the_weight_that_scales_forces_is_the_robots(reference: Reference, config: Config) -> None:
    walk = RigidBodyWalk(config, MpcConfig(), ramp)
    features = np.empty(30)
    walk.step(0, features)
    np.testing.assert_allclose(features[18:].reshape(4, 3) * config.robot.mass * GRAVITY, walk._forces)
