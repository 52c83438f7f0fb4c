"""``sim/…``: what only a simulated body tells and hears."""

from __future__ import annotations

import math

import msgspec

from runtime.messages.decoding import MessageError, check_within, decode


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


LARGEST_PUSH = 5000.0
"""N; 10 s is the longest."""


class SimHold(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """JSON on ``sim/hold``, heard by the wire twin only: somebody takes the body into the air and holds it."""

    rpy: tuple[float, float, float]
    """rad."""
    joints: tuple[float, ...] = ()
    """Where the joints are held, row by row, rad; none of them: they are let go."""
    down: bool = False
    """Put it back to where it started from, and let go."""


def decode_push(data: bytes) -> SimPush:
    """What ``sim/push`` carries.

    Raises:
        MessageError: not JSON, not these keys, not finite or beyond what makes sense.
    """
    message = decode(data, SimPush)
    for axis, value in zip("xyz", message.force, strict=True):
        check_within(f"force {axis}", value, LARGEST_PUSH)
    if not 0.0 < message.duration <= 10.0:
        raise MessageError(f"duration = {message.duration}: must be in (0, 10]")
    return message


def decode_hold(data: bytes) -> SimHold:
    """What ``sim/hold`` carries.

    Raises:
        MessageError: not JSON, not these keys, not finite, not twelve joints, or more than half a turn.
    """
    message = decode(data, SimHold)
    if len(message.joints) not in (0, 12):
        raise MessageError(f"joints: {len(message.joints)} numbers; 12 or none are wanted")
    for name, values in (("rpy", message.rpy), ("joints", message.joints)):
        for index, value in enumerate(values):
            check_within(f"{name}[{index}]", value, math.pi)
    return message
