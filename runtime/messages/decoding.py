"""Bytes from the wire to a message, or a refusal that names what is wrong."""

from __future__ import annotations

import math
from typing import TypeVar

import msgspec


class MessageError(ValueError):
    """Bytes from the wire that are not what the key carries: the message names the field, the value and the bound."""


Message = TypeVar("Message")
LARGEST_MESSAGE = 4096
"""Bytes that a velocity, a mode or a push may take at most."""


def decode(data: bytes, kind: type[Message]) -> Message:
    """A message of ``kind`` from JSON.

    Raises:
        MessageError: too long, not JSON, or not of that kind.
    """
    if len(data) > LARGEST_MESSAGE:
        raise MessageError(f"{len(data)} bytes; a message here has at most {LARGEST_MESSAGE}")
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise MessageError(str(error)) from error


def check_within(name: str, value: float, bound: float) -> None:
    """Refuse a number that is not finite or beyond ±``bound``.

    Raises:
        MessageError: names it, its value and the bound.
    """
    if not (math.isfinite(value) and abs(value) <= bound):
        raise MessageError(f"{name} = {value}: must be within ±{bound:g}")
