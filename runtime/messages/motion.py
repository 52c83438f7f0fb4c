"""``command/velocity`` and ``command/pose``: what the sticks say."""

from __future__ import annotations

import msgspec

from runtime.messages.decoding import check_within, decode


class VelocityMessage(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """JSON on ``command/velocity``: ``{"linear": [vx, vy], "yaw_rate": w}``."""

    linear: tuple[float, float]
    yaw_rate: float
    sticks: bool = False
    """From a person's sticks: after a silence nothing moves until they were centred."""


def decode_velocity(data: bytes, linear: tuple[float, float], yaw_rate: float) -> VelocityMessage:
    """What ``command/velocity`` carries, within the robot's bounds ``linear`` (m/s) and ``yaw_rate`` (rad/s).

    Raises:
        MessageError: not JSON, not these two keys, not finite or out of bounds.
    """
    message = decode(data, VelocityMessage)
    for name, value, bound in zip(("linear[0]", "linear[1]"), message.linear, linear, strict=True):
        check_within(name, value, bound)
    check_within("yaw_rate", message.yaw_rate, yaw_rate)
    return message


class PoseMessage(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """JSON on ``command/pose``: the body's pose while standing, as shares of its bounds, -1 to 1."""

    roll: float
    pitch: float
    yaw: float
    height: float


def decode_pose(data: bytes) -> PoseMessage:
    """What ``command/pose`` carries.

    Raises:
        MessageError: not JSON, not these keys, or beyond ±1.
    """
    message = decode(data, PoseMessage)
    for name in PoseMessage.__struct_fields__:
        check_within(name, getattr(message, name), 1.0)
    return message
