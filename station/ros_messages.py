"""Ticks as ROS 2 messages: plain dictionaries under the standard's names, and the standard's definitions.

Frames after REP 105 and 103: ``odom`` → ``base_link``; x forward, y left, z up.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from drivers.robot import JOINTS, LEGS
from station.pose import body_position, orientation_xyzw

JOINT_NAMES = [f"{leg}_{joint}" for leg in LEGS for joint in JOINTS]
NANOSECONDS = 1_000_000_000

_DEFINITIONS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
    ),
    "geometry_msgs/TwistStamped": "std_msgs/Header header\ngeometry_msgs/Twist twist",
    "sensor_msgs/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort"
    ),
    "sensor_msgs/Imu": (
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
        "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
        "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance"
    ),
    "nav_msgs/Odometry": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
        "geometry_msgs/TwistWithCovariance twist"
    ),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
}


def definition(kind: str) -> str:
    """The message definition of ``package/msg/Name`` with everything it is made of, as ros2msg text."""
    short = kind.replace("/msg/", "/")
    text, needed = _DEFINITIONS[short], _needs(short)
    return "\n".join([text, *(f"{'=' * 80}\nMSG: {name}\n{_DEFINITIONS[name]}" for name in needed)])


def _needs(kind: str) -> list[str]:
    found: list[str] = []
    for line in _DEFINITIONS[kind].splitlines():
        part = line.split()[0].split("[")[0]
        if part in _DEFINITIONS and part not in found:
            found += [part, *(name for name in _needs(part) if name not in found)]
    return list(dict.fromkeys(found))


def stamp_of(time: int) -> dict[str, int]:
    """Nanoseconds as builtin_interfaces/Time."""
    return {"sec": time // NANOSECONDS, "nanosec": time % NANOSECONDS}


def _header(time: int, frame: str) -> dict[str, Any]:
    return {"stamp": stamp_of(time), "frame_id": frame}


def _xyz(values: np.ndarray) -> dict[str, float]:
    return dict(zip("xyz", values.tolist(), strict=True))


def _pose(tick: np.void) -> tuple[dict[str, float], dict[str, float]]:
    ticks = np.array([tick])
    return _xyz(body_position(ticks)[0]), dict(zip("xyzw", orientation_xyzw(ticks)[0].tolist(), strict=True))


def joint_state(tick: np.void, time: int) -> dict[str, Any]:
    """sensor_msgs/JointState: rad, rad/s, N·m."""
    return {
        "header": _header(time, ""),
        "name": JOINT_NAMES,
        "position": tick["joint_position"].ravel().tolist(),
        "velocity": tick["joint_velocity"].ravel().tolist(),
        "effort": tick["joint_torque"].ravel().tolist(),
    }


def imu(tick: np.void, time: int) -> dict[str, Any]:
    """sensor_msgs/Imu in the body frame."""
    return {
        "header": _header(time, "base_link"),
        "orientation": _pose(tick)[1],
        "orientation_covariance": [0.0] * 9,
        "angular_velocity": _xyz(tick["angular_velocity"]),
        "angular_velocity_covariance": [0.0] * 9,
        "linear_acceleration": _xyz(tick["linear_acceleration"]),
        "linear_acceleration_covariance": [0.0] * 9,
    }


def odometry(tick: np.void, time: int) -> dict[str, Any]:
    """nav_msgs/Odometry: dead reckoning, which drifts; the twist is in the body's heading frame."""
    position, orientation = _pose(tick)
    twist = tick["twist"]
    return {
        "header": _header(time, "odom"),
        "child_frame_id": "base_link",
        "pose": {"pose": {"position": position, "orientation": orientation}, "covariance": [0.0] * 36},
        "twist": {"twist": {"linear": _xyz(twist[:3]), "angular": _xyz(twist[3:])}, "covariance": [0.0] * 36},
    }


def transforms(tick: np.void, time: int) -> dict[str, Any]:
    """tf2_msgs/TFMessage: ``odom`` → ``base_link``."""
    position, orientation = _pose(tick)
    frame = {
        "header": _header(time, "odom"),
        "child_frame_id": "base_link",
        "transform": {"translation": position, "rotation": orientation},
    }
    return {"transforms": [frame]}


def twist(tick: np.void, time: int) -> dict[str, Any]:
    """geometry_msgs/TwistStamped: what the operator asked for."""
    forward, left, turn = tick["asked_velocity"].tolist()
    return {
        "header": _header(time, "base_link"),
        "twist": {
            "linear": {"x": forward, "y": left, "z": 0.0},
            "angular": {"x": 0.0, "y": 0.0, "z": turn},
        },
    }
