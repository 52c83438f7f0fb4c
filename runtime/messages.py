"""What goes over the wire: key expressions, message types and the tick record.

One numpy record is a tick's telemetry on the wire and its row in the flight log. Names travel once, in the schema.
"""

from __future__ import annotations

import math
from enum import IntEnum, StrEnum
from typing import TypeVar

import msgspec
import numpy as np

from runtime.control.records import CONTROL_DTYPE, Clamp, Fields, SolverStatus, VelocityCommand
from runtime.control.state import TUNING_FIELDS, TUNING_SIZE

__all__ = [
    "CONTROL_DTYPE",
    "TICK_DTYPE",
    "ArmingCheck",
    "Clamp",
    "Event",
    "Evidence",
    "FaultRecord",
    "Keys",
    "Mode",
    "PolicyEntry",
    "PoseMessage",
    "ModeReply",
    "MessageError",
    "PolicyReply",
    "RecordingEntry",
    "RecordingReply",
    "Request",
    "SimHold",
    "SimPush",
    "SimTruth",
    "SolverStatus",
    "Status",
    "TuningEntry",
    "TuningReply",
    "TuningRequest",
    "VelocityCommand",
    "VelocityMessage",
    "decode_hold",
    "decode_pose",
    "decode_push",
    "decode_request",
    "decode_tuning",
    "decode_velocity",
    "tick_schema",
]


class Mode(IntEnum):
    """What the robot is doing."""

    DAMP = 0
    STAND_UP = 1
    STAND = 2
    WALK = 3
    SIT_DOWN = 4


class Request(StrEnum):
    """What the operator may ask for: the words of ``command/mode``."""

    ARM = "arm"
    STAND = "stand"
    WALK = "walk"
    SIT = "sit"
    DAMP = "damp"
    CLEAR = "clear"


TUNED_FIELDS: Fields = [(name if name == "policy_share" else f"tuned_{name}", *kind) for name, *kind in TUNING_FIELDS]
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
        ("outgoing", "u4"),  # generation of the policy that it is blended in over, while its share is below one
        *TUNED_FIELDS,  # what the operator may change, as in force in this tick
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

TUNED = slice(TICK_DTYPE.fields["policy_share"][1] // 8, TICK_DTYPE.fields["policy_share"][1] // 8 + TUNING_SIZE)  # type: ignore[index]
"""Where the tuned numbers lie in a tick seen as float64: the same row as ``Controller.tuning``."""
CONTROL_OFFSET = TICK_DTYPE.itemsize - CONTROL_DTYPE.itemsize
"""Where the core's part starts inside a tick record, bytes."""


class Evidence(msgspec.Struct, frozen=True, kw_only=True):
    """What the guard holds against a measurement or a command."""

    reason: str
    """Name of the ``Reason``, in small letters."""
    words: str
    """All of it in one line for people."""
    where: str = ""
    """A joint, such as ``FL knee``; empty where it concerns the whole robot."""
    value: float | None = None
    """What was measured, in ``unit``; None where it was not a number."""
    bound: float = 0.0
    unit: str = ""


class FaultRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One fault that stood, as the history keeps it."""

    time: str
    """Local time, ISO 8601."""
    tick: int
    mode: str
    """What the robot did when it came."""
    led_to: str
    """The mode it led to."""
    evidence: Evidence


class Status(msgspec.Struct, frozen=True, kw_only=True):
    """The daemon's state for people: JSON, ten times a second and on every change."""

    robot: str
    mode: str
    armed: bool
    fault: str
    """The fault that stands until it is cleared; empty for none."""
    evidence: Evidence | None = None
    """Of that fault."""
    health: str = ""
    """What the guard says of the last measurement; empty when all is in order."""
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
    speed_share: float = 1.0
    """Share of the commanded velocity that heat and supply leave."""
    torque_share: float = 1.0
    """Share of the peak torque that the most limited motor is given."""
    tick_p50: float
    """Compute time of a tick over the last second, s."""
    tick_p99: float
    clamps: dict[str, int]
    """How often each clamp acted since the start."""
    solver: dict[str, int]
    """How often each solver status came since the start."""
    recordings_refused: dict[str, int] = {}
    """How often the flight recorder could not write, by the reason."""
    refused: dict[str, int] = {}
    """How many messages were refused or shed since the start, by key."""
    wires: dict[str, int] = {}
    """What went wrong on the body's wires since the start, by its name: late and missed replies, frames, samples."""


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
    sticks: bool = False
    """From a person's sticks: after a silence nothing moves until they were centred."""


class ArmingCheck(msgspec.Struct, frozen=True):
    """One line of the arming list."""

    name: str
    ok: bool
    words: str
    """How it is, or why not."""


class ModeReply(msgspec.Struct, frozen=True):
    """JSON reply to a query on ``command/mode``."""

    accepted: bool
    mode: str
    reason: str
    checks: tuple[ArmingCheck, ...] = ()
    """The arming list, in the reply to ``arm``."""


class PolicyReply(msgspec.Struct, frozen=True):
    """JSON reply to a candidate sent to ``policy``."""

    accepted: bool
    name: str
    """Of the active policy after the answer."""
    sha256: str
    """Of the active policy's file."""
    reason: str
    report: dict[str, float] = {}
    """What the shadow found: root mean squares of the differences, shares of ticks; empty without one."""


class PolicyEntry(msgspec.Struct, frozen=True):
    """One row of the list that ``policies`` answers with."""

    role: str
    """``active``, ``previous`` (what a rollback takes), ``good``, ``kept`` (for the next start) or ``shipped``."""
    name: str
    sha256: str
    """Of the file."""
    made: str
    """From what and how, as its provenance says."""


class TuningRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """JSON on ``command/tuning``."""

    name: str
    value: float | str | None
    """A number, a gait's name, or nothing for the robot's own."""
    save: bool = False
    """For the next start too."""


class TuningReply(msgspec.Struct, frozen=True):
    """JSON reply to it."""

    accepted: bool
    reason: str


class TuningEntry(msgspec.Struct, frozen=True):
    """One row of the list that ``tuning`` answers with."""

    name: str
    unit: str
    value: float | str
    """In force."""
    wanted: float | str
    """What the value moves to."""
    own: float | str
    """What the robot's TOML says."""
    low: float | None
    high: float | None
    saved: float | str | None


class PoseMessage(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """JSON on ``command/pose``: the body's pose while standing, as shares of its bounds, -1 to 1."""

    roll: float
    pitch: float
    yaw: float
    height: float


class RecordingEntry(msgspec.Struct, frozen=True):
    """One row of the list that ``recording`` answers with."""

    name: str
    path: str
    """On the robot."""
    size: int
    """Bytes."""


class RecordingReply(msgspec.Struct, frozen=True):
    """JSON reply to ``recording?write``."""

    accepted: bool
    path: str
    reason: str


class SimTruth(msgspec.Struct, frozen=True):
    """JSON on ``sim/truth``, from a simulated body only: what no robot can know."""

    stamp: float
    """s, the daemon's monotonic clock."""
    position: tuple[float, float, float]
    """Of the body origin in the world, m."""
    rpy: tuple[float, float, float]
    """rad."""
    velocity: tuple[float, float, float]
    """vx, vy in the heading frame, m/s; yaw rate, rad/s."""
    fallen: bool
    joints: tuple[float, ...] = ()
    """Joint angles, row by row, rad."""


class SimPush(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """JSON on ``sim/push``, heard by a simulated body only."""

    force: tuple[float, float, float]
    """N, heading frame, at the body origin."""
    duration: float
    """s."""


class SimHold(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """JSON on ``sim/hold``, heard by the wire twin only: somebody takes the body into the air and holds it."""

    rpy: tuple[float, float, float]
    """rad."""
    joints: tuple[float, ...] = ()
    """Where the joints are held, row by row, rad; none of them: they are let go."""
    down: bool = False
    """Put it back to where it started from, and let go."""


class MessageError(ValueError):
    """Bytes from the wire that are not what the key carries: the message names the field, the value and the bound."""


Message = TypeVar("Message")
LARGEST_MESSAGE = 4096
"""Bytes that a velocity, a mode or a push may take at most."""
LARGEST_PUSH = 5000.0
"""N; 10 s is the longest."""


def _decode(data: bytes, kind: type[Message]) -> Message:
    if len(data) > LARGEST_MESSAGE:
        raise MessageError(f"{len(data)} bytes; a message here has at most {LARGEST_MESSAGE}")
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise MessageError(str(error)) from error


def _within(name: str, value: float, bound: float) -> None:
    if not (math.isfinite(value) and abs(value) <= bound):
        raise MessageError(f"{name} = {value}: must be within ±{bound:g}")


def decode_velocity(data: bytes, linear: tuple[float, float], yaw_rate: float) -> VelocityMessage:
    """What ``command/velocity`` carries, within the robot's bounds ``linear`` (m/s) and ``yaw_rate`` (rad/s).

    Raises:
        MessageError: not JSON, not these two keys, not finite or out of bounds.
    """
    message = _decode(data, VelocityMessage)
    for name, value, bound in zip(("linear[0]", "linear[1]"), message.linear, linear, strict=True):
        _within(name, value, bound)
    _within("yaw_rate", message.yaw_rate, yaw_rate)
    return message


def decode_request(data: bytes) -> Request:
    """What a query on ``command/mode`` carries: one of the words of ``Request``, bare.

    Raises:
        MessageError: anything else; the message lists the words.
    """
    try:
        return Request(data[:LARGEST_MESSAGE].decode().strip())
    except ValueError as error:
        words = ", ".join(request.value for request in Request)
        raise MessageError(f"mode = {data[:40]!r}: must be one of {words}") from error


def decode_push(data: bytes) -> SimPush:
    """What ``sim/push`` carries.

    Raises:
        MessageError: not JSON, not these keys, not finite or beyond what makes sense.
    """
    message = _decode(data, SimPush)
    for axis, value in zip("xyz", message.force, strict=True):
        _within(f"force {axis}", value, LARGEST_PUSH)
    if not 0.0 < message.duration <= 10.0:
        raise MessageError(f"duration = {message.duration}: must be in (0, 10]")
    return message


def decode_hold(data: bytes) -> SimHold:
    """What ``sim/hold`` carries.

    Raises:
        MessageError: not JSON, not these keys, not finite, not twelve joints, or more than half a turn.
    """
    message = _decode(data, SimHold)
    if len(message.joints) not in (0, 12):
        raise MessageError(f"joints: {len(message.joints)} numbers; 12 or none are wanted")
    for name, values in (("rpy", message.rpy), ("joints", message.joints)):
        for index, value in enumerate(values):
            _within(f"{name}[{index}]", value, math.pi)
    return message


def decode_tuning(data: bytes) -> TuningRequest:
    """What a query on ``command/tuning`` carries.

    Raises:
        MessageError: not JSON or not these keys.
    """
    return _decode(data, TuningRequest)


def decode_pose(data: bytes) -> PoseMessage:
    """What ``command/pose`` carries.

    Raises:
        MessageError: not JSON, not these keys, or beyond ±1.
    """
    message = _decode(data, PoseMessage)
    for name in PoseMessage.__struct_fields__:
        _within(name, getattr(message, name), 1.0)
    return message


class Keys:
    """The key expressions of one robot."""

    def __init__(self, robot: str) -> None:
        root = f"trotd/{robot}"
        self.root = root
        self.status = f"{root}/status"
        self.tick = f"{root}/tick"
        self.tick_schema = f"{root}/tick/schema"
        self.event = f"{root}/event"
        self.velocity = f"{root}/command/velocity"
        self.mode = f"{root}/command/mode"
        self.policy = f"{root}/policy"
        self.policies = f"{root}/policies"
        self.tuning = f"{root}/tuning"
        self.change_tuning = f"{root}/command/tuning"
        self.pose = f"{root}/command/pose"
        self.recording = f"{root}/recording"
        self.faults = f"{root}/faults"
        self.alive = f"{root}/alive"
        self.operator = f"{root}/operator"
        self.sim_truth = f"{root}/sim/truth"
        self.sim_push = f"{root}/sim/push"
        self.sim_hold = f"{root}/sim/hold"


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
