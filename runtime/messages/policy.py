"""``policy`` and ``policies``: what became of a candidate, and what is known."""

from __future__ import annotations

import msgspec


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
