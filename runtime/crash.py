"""What a run that was killed left in memory becomes a recording at the next start.

A run keeps, in a folder of its own, the ring of its ticks and a header beside it; one that ends in order removes both.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np

from drivers.description import UNDECODABLE
from drivers.durable import write_whole
from runtime.messages.event import Event
from runtime.recorder import CHUNK, KEYFRAMES
from runtime.recording import SUFFIX, Header, dtype_of, prune, save, stem
from runtime.ring import Rows, open_left

RING, HEADER = "ring", "header.json"
LEFT = 3
"""Runs that may wait for being written; those that end after them are not kept."""


UNARMED = "crash unarmed"
"""Of these only the newest is kept: a daemon that cannot stay up must not push out what is worth something."""


class Run(msgspec.Struct, frozen=True, kw_only=True):
    """What the next process must know to write the recording of this one."""

    header: Header
    """Without events and keyframes, which are in the ring."""
    epoch: float
    """What to add to a tick's stamp for the wall clock, s."""


class CrashError(ValueError):
    """A run left what cannot be read: the message names it."""


def keep_header(folder: Path, header: Header) -> None:
    """Put the header beside the ring in ``folder``.

    Raises:
        OSError: no room for it.
    """
    run = Run(header=header, epoch=time.time() - time.monotonic())
    write_whole(folder / HEADER, msgspec.json.encode(run))


def claim(folder: Path) -> list[Path]:
    """Set aside what earlier runs left where the next one will keep its own; oldest first.

    Raises:
        OSError: it cannot be set aside.
    """
    waiting = sorted(folder.parent.glob(f"{folder.name}.left-*"))
    if folder.exists():
        if (folder / HEADER).exists() and len(waiting) < LEFT:
            waiting.append(folder.rename(folder.with_name(f"{folder.name}.left-{time.time_ns()}")))
        else:
            shutil.rmtree(folder)
    return waiting


def salvage(left: Path, recordings: Path, max_files: int, max_bytes: int) -> tuple[Path | None, str]:
    """Write the recording of a run that left ``left``, and remove it from memory; say what became of it.

    Returns: the recording, None for a run without a tick; and when and how far the run came, in words.

    Raises:
        CrashError: it cannot be read; it is gone.
        OSError: the disk refused; it is still there.
    """
    try:
        header, ended, ticks = _read(left)
    except (ValueError, OverflowError, *UNDECODABLE) as error:
        shutil.rmtree(left)
        raise CrashError(f"{left}: {error}") from error
    places = ticks.whole()
    if not len(places):
        shutil.rmtree(left)
        return None, "it had not begun to tick"
    path = recordings / f"{stem(ended, header.reason)}{SUFFIX}"
    idle = list(recordings.glob(f"*-{UNARMED.replace(' ', '-')}{SUFFIX}")) if header.reason == UNARMED else []
    save(path, header, (ticks.rows[part].tobytes() for part in np.array_split(places, 1 + len(places) // CHUNK)))
    for before in idle:
        before.unlink(missing_ok=True)
    prune(recordings, path, max_files, max_bytes)
    shutil.rmtree(left)
    return path, f"it ended without a word at {header.written}, {len(places)} ticks are kept"


def _read(left: Path) -> tuple[Header, float, Rows]:
    """Header, wall clock of the last tick, ticks as raw bytes."""
    run = msgspec.json.decode((left / HEADER).read_bytes(), type=Run)
    ticks, keyframes, events = open_left(left / RING, 3)
    rows = ticks.rows.view(dtype_of(run.header, str(left)))
    places = ticks.whole()
    if rows.shape != ticks.rows.shape:
        raise CrashError("its ticks are not what its header says")
    for name in ("index", "stamp", "armed"):
        if name not in (rows.dtype.names or ()) or rows.dtype[name].shape:
            raise CrashError(f"its header tells no number {name!r} of a tick")
    if not len(places):
        return run.header, run.epoch, ticks
    ended = run.epoch + float(rows["stamp"][places[-1]])
    known = [data for data in _rows(keyframes) if np.frombuffer(data, "<u8", 1)[0] >= rows["index"][places[0]]]
    header = msgspec.structs.replace(
        run.header,
        reason="crash" if rows["armed"][places].any() else UNARMED,
        written=time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(ended)),
        events=list(_events(events)),
        keyframes=known[:KEYFRAMES],
    )
    return header, ended, ticks


def _rows(rows: Rows) -> Iterator[bytes]:
    for place in rows.whole():
        yield rows.rows[place].tobytes()


def _events(rows: Rows) -> Iterator[Event]:
    for data in _rows(rows):
        yield msgspec.json.decode(data.rstrip(b"\0"), type=Event)


__all__ = ["CrashError", "Run", "claim", "keep_header", "salvage"]
