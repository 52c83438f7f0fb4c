"""``tuning`` and ``command/tuning``: the numbers that an operator may change."""

from __future__ import annotations

import msgspec

from runtime.messages.decoding import decode


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


def decode_tuning(data: bytes) -> TuningRequest:
    """What a query on ``command/tuning`` carries.

    Raises:
        MessageError: not JSON or not these keys.
    """
    return decode(data, TuningRequest)
