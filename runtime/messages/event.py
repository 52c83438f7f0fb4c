"""``event``: what happened once and must not be missed."""

from __future__ import annotations

import msgspec


class Event(msgspec.Struct, frozen=True, kw_only=True):
    """Something that happened once and must not be missed."""

    stamp: float
    tick: int
    kind: str
    """``mode``, ``refused``, ``fault``, ``policy``, ``recording``."""
    text: str
