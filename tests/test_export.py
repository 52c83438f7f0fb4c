"""Exports read back: by the csv module, by the mcap library, and by rosbags' own CDR and ROS 2 definitions."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scenes import rotation
from walks import Walk

from runtime.messages.mode import Request
from runtime.messages.tick import TICK_DTYPE
from runtime.recording import Recording, load
from station.export import column_names, export_csv, export_mcap, start_of, tick_definition
from station.ros_messages import JOINT_NAMES, definition
from station.session import StationError

STANDARD = get_typestore(Stores.ROS2_HUMBLE)
KINDS = ("sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    walk = Walk(tmp_path_factory.mktemp("recordings"), seconds=1.0)
    walk.stand()
    walk.ask(Request.WALK)
    walk.run(1.0, (0.4, 0.1, 0.3))
    return load(walk.write())


@pytest.fixture(scope="module")
def messages(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Any, Any, Any, Any]]:
    path = tmp_path_factory.mktemp("exports") / "walk.mcap"
    export_mcap(recording, path)
    with path.open("rb") as file:
        return list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())


def of(messages: list[tuple[Any, Any, Any, Any]], topic: str) -> list[tuple[Any, Any, Any, Any]]:
    return [row for row in messages if row[1].topic == topic]


def test_csv_holds_every_number_with_all_its_digits(recording: Recording, tmp_path: Path) -> None:
    export_csv(recording, tmp_path / "walk.csv")
    with (tmp_path / "walk.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(recording.ticks)
    for row, tick in zip(rows[::37], recording.ticks[::37], strict=True):
        assert float(row["joint_torque.BL.knee"]) == tick["joint_torque"][2, 2]
        assert float(row["grf.FR.z"]) == tick["grf"][1, 2]
        assert float(row["twist.5"]) == tick["twist"][5]
        assert int(row["index"]) == tick["index"]


def test_every_number_of_a_tick_has_one_column() -> None:
    names = column_names()
    assert len(set(names)) == len(names)
    assert len(names) == sum(int(np.prod(TICK_DTYPE[name].shape)) for name in TICK_DTYPE.names or ())


@pytest.mark.parametrize("kind", [*KINDS, "geometry_msgs/msg/TwistStamped"])
def test_definitions_are_those_of_ros_2(kind: str) -> None:
    for name, fields in get_types_from_msg(definition(kind), kind).items():
        assert fields[1] == STANDARD.fielddefs[name][1], name


@pytest.mark.parametrize("topic", ["/joint_states", "/imu/data", "/odom", "/tf", "/cmd_vel", "/trotd/tick"])
def test_every_tick_is_on_every_topic_at_its_own_time(
    recording: Recording, messages: list[tuple[Any, Any, Any, Any]], topic: str
) -> None:
    times = [message.log_time for _, _, message, _ in of(messages, topic)]
    wanted = start_of(recording) + np.round(recording.ticks["stamp"] * 1e9).astype(np.int64)
    assert times == wanted.tolist()


def test_joint_states_and_imu_carry_the_measurement(
    recording: Recording, messages: list[tuple[Any, Any, Any, Any]]
) -> None:
    tick, state = recording.ticks[-1], of(messages, "/joint_states")[-1][3]
    assert list(state.name) == JOINT_NAMES
    assert list(state.position) == tick["joint_position"].ravel().tolist()
    assert list(state.effort) == tick["joint_torque"].ravel().tolist()
    orientation = of(messages, "/imu/data")[-1][3].orientation
    assert [orientation.w, orientation.x, orientation.y, orientation.z] == tick["orientation"].tolist()


def test_the_tick_message_is_the_whole_tick(recording: Recording, messages: list[tuple[Any, Any, Any, Any]]) -> None:
    for tick, (_, _, _, message) in zip(recording.ticks, of(messages, "/trotd/tick"), strict=True):
        for name in TICK_DTYPE.names or ():
            value = getattr(message, name)
            value = list(value) if isinstance(value, bytes) else value
            assert np.array_equal(np.ravel(tick[name]), np.ravel(value)), name


def test_an_independent_cdr_reads_the_same(recording: Recording, messages: list[tuple[Any, Any, Any, Any]]) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(tick_definition(), "trotd_msgs/msg/Tick"))
    kinds = {"/joint_states": KINDS[0], "/imu/data": KINDS[1], "/odom": KINDS[2], "/tf": KINDS[3]}
    tick = recording.ticks[-1]
    read = {topic: store.deserialize_cdr(of(messages, topic)[-1][2].data, kind) for topic, kind in kinds.items()}
    assert np.array_equal(read["/joint_states"].velocity, tick["joint_velocity"].ravel())  # type: ignore[attr-defined]
    ours: Any = store.deserialize_cdr(of(messages, "/trotd/tick")[-1][2].data, "trotd_msgs/msg/Tick")
    assert np.array_equal(ours.command_torque, tick["command_torque"].ravel())
    frame: Any = read["/tf"]
    turned = frame.transforms[0].transform.rotation
    w, x, y, z = turned.w, turned.x, turned.y, turned.z
    about_z = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    assert np.allclose(about_z, rotation(tick["rpy"])[:, 2], atol=1e-6)
    odom: Any = read["/odom"]
    assert odom.pose.pose.position.z == tick["height"]


def test_a_file_that_cannot_be_written_is_one_line(recording: Recording, tmp_path: Path) -> None:
    with pytest.raises(StationError, match="No such file"):
        export_mcap(recording, tmp_path / "nowhere" / "x.mcap")
