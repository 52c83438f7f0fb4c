"""The calibration file: what is refused, and that what is kept is what was found."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import pytest
from bench_robot import motors_config

from drivers.calibration import VERSION, Calibration, CalibrationError, apply, fingerprint, load, save
from drivers.description import RobotDescription
from drivers.wiring import ImuConfig
from runtime import config

NOW = datetime(2026, 11, 22, tzinfo=UTC)


@pytest.fixture
def description() -> RobotDescription:
    return config.load(config.find_robot("stoch3")).robot


def make(description: RobotDescription, **changes: object) -> Calibration:
    motors = motors_config()
    fields = {
        "version": VERSION,
        "robot": description.name,
        "body": fingerprint(description, motors),
        "date": NOW,
        "id": ((1, 2, 3), (4, 5, 6), (7, 8, 9), (10, 11, 12)),
        "bus": motors.bus,
        "direction": ((1, 1, 1),) * 4,
        "offset": ((0.1, 0.2, 0.3),) * 4,
        "mount": (0.0, 1.0, 0.0, 0.0),
    }
    return Calibration(**(fields | changes))  # type: ignore[arg-type]


def test_what_was_found_is_what_is_used(description, tmp_path):
    path = tmp_path / "new folder" / "stoch3.json"
    save(make(description), path)
    loaded = load(path, description, motors_config(), NOW)
    motors, imu = apply(loaded, motors_config(), ImuConfig())
    assert motors.offset == ((0.1, 0.2, 0.3),) * 4
    assert motors.id[3] == (10, 11, 12)
    assert imu.mount == (0.0, 1.0, 0.0, 0.0)
    assert motors.max_torque == motors_config().max_torque
    assert [file.name for file in path.parent.iterdir()] == ["stoch3.json"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robot": "spot"}, "is of robot 'spot'"),
        ({"body": "0" * 16}, "stale"),
        ({"version": VERSION + 1}, "newer.*update trotd"),
        ({"version": VERSION - 1}, "stale"),
        ({"date": NOW + timedelta(days=30)}, "future"),
    ],
)
def test_a_file_that_is_not_for_this_robot_now_is_refused(description, tmp_path, changes, message):
    path = tmp_path / "c.json"
    save(make(description, **changes), path)
    with pytest.raises(CalibrationError, match=message):
        load(path, description, motors_config(), NOW)


def test_a_changed_robot_makes_it_stale(description, tmp_path):
    path = tmp_path / "c.json"
    save(make(description), path)
    with pytest.raises(CalibrationError, match="stale"):
        load(path, msgspec.structs.replace(description, thigh_length=0.3), motors_config(), NOW)
    with pytest.raises(CalibrationError, match="stale"):
        load(path, description, motors_config(gear=(1.0, 1.0, 1.36)), NOW)


def test_a_file_changed_by_hand_is_refused(description, tmp_path):
    path = tmp_path / "c.json"
    save(make(description), path)
    path.write_text(path.read_text().replace("0.3", "0.4", 1))
    with pytest.raises(CalibrationError, match="changed"):
        load(path, description, motors_config(), NOW)


def test_a_date_without_its_zone_is_refused(description, tmp_path):
    path = tmp_path / "c.json"
    save(make(description), path)
    path.write_text(path.read_text().replace("2026-11-22T00:00:00Z", "2026-11-22T00:00:00"))
    with pytest.raises(CalibrationError, match=r"date.*run trotd commission"):
        load(path, description, motors_config(), NOW)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff\xfe", b'{"version": 1}', b'{"version": "1"}'])
def test_what_is_no_calibration_is_refused_with_what_to_do(description, tmp_path, content):
    path: Path = tmp_path / "c.json"
    path.write_bytes(content)
    with pytest.raises(CalibrationError, match="trotd commission"):
        load(path, description, motors_config(), NOW)


def test_a_missing_file_says_what_to_do(description, tmp_path):
    with pytest.raises(CalibrationError, match=r"No such file.*trotd commission"):
        load(tmp_path / "none.json", description, motors_config(), NOW)
