"""What goes over the wire: key expressions, message types and the tick record.

One numpy record is a tick's telemetry on the wire and its row in the flight log. Names travel once, in the schema.
"""

from __future__ import annotations

from enum import IntEnum

import msgspec
import numpy as np

from runtime.control.records import CONTROL_DTYPE, Clamp, SolverStatus, VelocityCommand

__all__ = ["Clamp", "CONTROL_DTYPE", "Event", "Mode", "SolverStatus", "Status", "TICK_DTYPE", "VelocityCommand"]


class Mode(IntEnum):
    """What the robot is doing."""

    DAMP = 0
    STAND_UP = 1
    STAND = 2
    WALK = 3
    SIT_DOWN = 4


TICK_DTYPE = np.dtype(
    [
        ("index", "u8"),  # tick number since the daemon started
        ("stamp", "f8"),  # s, monotonic clock, when the tick woke
        ("period", "f8"),  # s since the tick before woke
        ("lateness", "f8"),  # s between the deadline and waking
        ("compute", "f8"),  # s from waking to the finished command
        ("overruns", "u4"),  # deadlines missed since the daemon started
        ("mode", "u1"),  # Mode
        ("armed", "u1"),
        ("reason", "u2"),  # why the mode is what it is (runtime.modes.Reason)
        ("policy", "u4"),  # generation of the active policy, counted from 1 at start
        ("asked_velocity", "f8", (3,)),  # newest operator command: vx, vy m/s, yaw rate rad/s
        ("measured_stamp", "f8"),  # s, the body's own clock (the simulator's is simulated time)
        ("imu_stamp", "f8"),
        ("orientation", "f8", (4,)),  # w x y z, body to world
        ("angular_velocity", "f8", (3,)),  # body frame, rad/s
        ("linear_acceleration", "f8", (3,)),  # body frame, m/s²
        ("joint_position", "f8", (4, 3)),
        ("joint_velocity", "f8", (4, 3)),
        ("joint_torque", "f8", (4, 3)),
        ("joint_temperature", "f8", (4, 3)),
        ("joint_fault", "i4", (4, 3)),
        ("joint_age", "f8", (4, 3)),
        ("voltage", "f8"),
        *[(name, *CONTROL_DTYPE.fields[name][:1]) for name in CONTROL_DTYPE.names or ()],  # type: ignore[index]
    ],
    align=True,
)
"""One tick, whole. The core's part (``CONTROL_DTYPE``) is its tail."""

CONTROL_OFFSET = TICK_DTYPE.itemsize - CONTROL_DTYPE.itemsize
"""Where the core's part starts inside a tick record, bytes."""


class Status(msgspec.Struct, frozen=True, kw_only=True):
    """The daemon's state for people: JSON, ten times a second and on every change."""

    robot: str
    mode: str
    armed: bool
    reason: str
    """Why the mode is what it is, in words."""
    policy: str
    rate_hz: float
    ticks: int
    overruns: int
    velocity_command: tuple[float, float, float]
    velocity: tuple[float, float, float]
    """Estimated vx, vy, yaw rate."""
    height: float
    rpy: tuple[float, float, float]
    voltage: float
    max_temperature: float
    tick_p50: float
    """Compute time of a tick over the last second, s."""
    tick_p99: float
    clamps: dict[str, int]
    """How often each clamp acted since the start."""
    solver: dict[str, int]
    """How often each solver status came since the start."""


class Event(msgspec.Struct, frozen=True, kw_only=True):
    """Something that happened once and must not be missed."""

    stamp: float
    tick: int
    kind: str
    """``mode``, ``refused``, ``fault``, ``policy``, ``recording``."""
    text: str


class VelocityMessage(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """JSON on ``command/velocity``: ``{"linear": [vx, vy], "yaw_rate": w}``."""

    linear: tuple[float, float]
    yaw_rate: float


class ModeReply(msgspec.Struct, frozen=True):
    """JSON reply to a query on ``command/mode``."""

    accepted: bool
    mode: str
    reason: str


class Keys:
    """The key expressions of one robot."""

    def __init__(self, robot: str) -> None:
        root = f"trotd/{robot}"
        self.status = f"{root}/status"
        self.tick = f"{root}/tick"
        self.tick_schema = f"{root}/tick/schema"
        self.event = f"{root}/event"
        self.velocity = f"{root}/command/velocity"
        self.mode = f"{root}/command/mode"
        self.policy = f"{root}/policy"
        self.recording = f"{root}/recording"
        self.alive = f"{root}/alive"


def tick_schema() -> bytes:
    """``TICK_DTYPE`` as JSON: name, numpy type, shape and offset of every field, so that any language can read it."""
    rows = [
        {
            "name": name,
            "type": dtype.base.str,
            "shape": list(dtype.shape),
            "offset": offset,
        }
        for name in TICK_DTYPE.names or ()
        for dtype, offset in [TICK_DTYPE.fields[name][:2]]  # type: ignore[index]
    ]
    return msgspec.json.encode({"itemsize": TICK_DTYPE.itemsize, "fields": rows})
