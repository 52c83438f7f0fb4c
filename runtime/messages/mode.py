"""``command/mode``: what the robot does, what the operator may ask for, and the answer."""

from __future__ import annotations

from enum import IntEnum, StrEnum

import msgspec

from runtime.messages.decoding import LARGEST_MESSAGE, MessageError


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
