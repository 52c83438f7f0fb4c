"""``faults``: what the guard found, and the history of it."""

from __future__ import annotations

import msgspec


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
