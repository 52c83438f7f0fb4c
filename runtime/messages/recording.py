"""``recording``: what lies on the robot, and what became of a wish for one."""

from __future__ import annotations

import msgspec


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
