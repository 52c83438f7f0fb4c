"""A recording as files that other programs read: CSV, MCAP with ROS 2 messages (Foxglove), rerun's RRD."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from drivers.robot import JOINTS, LEGS
from runtime.messages.tick import TICK_DTYPE
from runtime.recording import Recording
from station.ros_messages import definition, imu, joint_state, odometry, transforms, twist
from station.session import StationError
from station.ticks import check_fields

NANOSECONDS = 1_000_000_000
ROS_TYPES = {"f8": "float64", "u1": "uint8", "u2": "uint16", "u4": "uint32", "u8": "uint64", "i4": "int32"}
LEG_FRAMES = ("feet", "foot_targets", "grf", "contact_force", "touchdown")
"""Fields whose columns are x y z, not joints."""


def column_names() -> list[str]:
    """One name for every number of a tick: ``joint_torque.FL.knee``, ``grf.BR.z``, ``twist.5``."""
    return [".".join((name, *place)) for name in TICK_DTYPE.names or () for place in _places(name)]


def _places(name: str) -> Iterator[tuple[str, ...]]:
    shape = TICK_DTYPE[name].shape
    if not shape:
        yield ()
    elif shape[0] == len(LEGS) and name != "orientation":
        columns = ("x", "y", "z") if name in LEG_FRAMES else JOINTS
        for leg in LEGS:
            yield from [(leg,)] if len(shape) == 1 else [(leg, column) for column in columns[: shape[1]]]
    else:
        yield from (tuple(map(str, place)) for place in np.ndindex(shape))


def export_csv(recording: Recording, path: Path) -> None:
    """One line a tick, every number of it, floats with all their digits.

    Raises:
        StationError: another version's recording, or the file cannot be written.
    """
    check_fields(recording.ticks.dtype, str(recording.path))
    try:
        with path.open("w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(column_names())
            for tick in recording.ticks:
                rows.writerow([value for name in TICK_DTYPE.names or () for value in np.ravel(tick[name]).tolist()])
    except OSError as error:
        raise StationError(f"{path}: {error.strerror}") from error


def tick_definition() -> str:
    """Our tick as a ROS 2 message definition: arrays row by row."""
    lines = ["# A tick of trotd. SI units; legs FL FR BL BR, joints abduction hip knee, arrays row by row."]
    for name in TICK_DTYPE.names or ():
        base, shape = TICK_DTYPE[name].base, TICK_DTYPE[name].shape
        length = f"[{int(np.prod(shape))}]" if shape else ""
        lines.append(f"{ROS_TYPES[base.str[1:]]}{length} {name}")
    return "\n".join(lines)


def export_mcap(recording: Recording, path: Path) -> None:
    """``/joint_states``, ``/imu/data``, ``/odom``, ``/tf``, ``/cmd_vel`` and ``/trotd/tick``, on wall-clock time.

    Raises:
        StationError: another version's recording, or the file cannot be written.
    """
    from mcap_ros2.writer import Writer

    check_fields(recording.ticks.dtype, str(recording.path))
    start = start_of(recording)
    topics: list[tuple[str, str, Callable[[np.void, int], Any]]] = [
        ("/joint_states", "sensor_msgs/msg/JointState", joint_state),
        ("/imu/data", "sensor_msgs/msg/Imu", imu),
        ("/odom", "nav_msgs/msg/Odometry", odometry),
        ("/tf", "tf2_msgs/msg/TFMessage", transforms),
        ("/cmd_vel", "geometry_msgs/msg/TwistStamped", twist),
        ("/trotd/tick", "trotd_msgs/msg/Tick", lambda tick, _time: tick_message(tick)),
    ]
    try:
        with path.open("wb") as file:
            writer: Any = Writer(file)
            schemas = {
                kind: writer.register_msgdef(kind, tick_definition() if kind.startswith("trotd") else definition(kind))
                for _, kind, _ in topics
            }
            for sequence, tick in enumerate(recording.ticks):
                time = start + round(float(tick["stamp"]) * NANOSECONDS)
                for topic, kind, build in topics:
                    writer.write_message(topic, schemas[kind], build(tick, time), time, time, sequence)
            writer.finish()
    except OSError as error:
        raise StationError(f"{path}: {error.strerror}") from error


def start_of(recording: Recording) -> int:
    """What to add to a tick's stamp for the wall clock, ns: the last tick is when the file was written."""
    ticks = recording.ticks
    written = datetime.fromisoformat(recording.header.written).timestamp()
    return round(written * NANOSECONDS) - (round(float(ticks["stamp"][-1]) * NANOSECONDS) if len(ticks) else 0)


def tick_message(tick: np.void) -> dict[str, Any]:
    """A tick under the names of ``tick_definition``."""
    return {
        name: np.ravel(tick[name]).tolist() if TICK_DTYPE[name].shape else tick[name].item()
        for name in TICK_DTYPE.names or ()
    }


def export_rrd(recording: Recording, path: Path) -> None:
    """What ``trotd view`` would draw, as a file."""
    from station.viewer import Screen, view_recording

    view_recording(recording.path, Screen(save=path))


EXPORTS: dict[str, Callable[[Recording, Path], None]] = {"csv": export_csv, "mcap": export_mcap, "rrd": export_rrd}
