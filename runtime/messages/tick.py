"""``tick`` and ``tick/schema``: one numpy record is a tick's telemetry on the wire and its row in the flight log."""

from __future__ import annotations

import msgspec
import numpy as np

from runtime.control.records import CONTROL_DTYPE, Fields
from runtime.control.state import TUNING_FIELDS, TUNING_SIZE

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
        ("reason", "u2"),  # why the mode is what it is (runtime.reasons.Reason)
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
