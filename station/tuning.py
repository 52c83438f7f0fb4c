"""``trotd set`` and ``trotd get``: the robot's tunable numbers from the desk."""

from __future__ import annotations

import contextlib

import msgspec

from runtime.messages.tuning import TuningEntry, TuningReply, TuningRequest
from station.session import Station

OWN = "own"
"""The word for the robot's own value."""


def change(station: Station, name: str, value: str, save: bool = False) -> TuningReply:
    """Ask for another value: a number, a gait's name, or ``own``.

    Raises:
        StationError: nobody answers, or nobody may ask.
    """
    wanted: float | str | None = None if value == OWN else value
    with contextlib.suppress(ValueError):
        wanted = float(value)
    payload = msgspec.json.encode(TuningRequest(name, wanted, save))
    return station.ask_for(TuningReply, station.keys.change_tuning, payload)


def known(station: Station) -> list[TuningEntry]:
    """Everything that can be set."""
    return station.ask_for(list[TuningEntry], station.keys.tuning)


def describe(entry: TuningEntry) -> str:
    """One line."""
    number = isinstance(entry.value, float)
    value = f"{entry.value:.4g}" if number else str(entry.value)
    parts = [f"{entry.name:16} {value:>8} {entry.unit:9}"]
    if (
        entry.wanted != entry.value
        and isinstance(entry.wanted, float)
        and abs(entry.wanted - float(entry.value)) > 1e-9
    ):
        parts.append(f"moving to {entry.wanted:.4g}")
    if entry.low is not None and entry.high is not None:
        parts.append(f"{entry.low:.4g} to {entry.high:.4g}")
    if entry.wanted != entry.own:
        parts.append(f"own {entry.own}")
    if entry.saved is not None:
        parts.append(f"saved {entry.saved}")
    return "  ".join(parts)
