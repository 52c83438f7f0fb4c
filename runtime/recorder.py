"""The flight recorder: a ring of every tick, written out on fault, on request and at stop; and its files.

A file is one line ``trotd recording 1``, the length of the header as a little-endian u64, the header as JSON, then raw
tick records to the end. The header holds all that a replay needs: the robot's TOML, the policy, the versions, the
record's layout and what happened.
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from runtime.control.records import Records
from runtime.messages import TICK_DTYPE, Event

MAGIC = b"trotd recording 1\n"
SUFFIX = ".trotd"
CHUNK = 256
"""Records written at a time."""
MARGIN_SECONDS = 2.0
"""Extra ring beyond what is kept, so that a writer is never overtaken by the ticks."""
KEYFRAME_SECONDS = 1.0
EVENTS = 1000
_length = struct.Struct("<Q")


class RecordingError(ValueError):
    """A file that is not a whole recording: the message names it and what is wrong."""


class Header(msgspec.Struct, frozen=True, kw_only=True):
    """What a recording says about itself."""

    robot: str
    robot_toml: str
    policy: str
    """The active policy's file, whole."""
    rate_hz: float
    reason: str
    """Why it was written."""
    written: str
    """Local time, ISO 8601."""
    versions: dict[str, str]
    layout: list[tuple[str, str, list[int], int]]
    """Name, numpy type, shape and offset of every field of a record."""
    itemsize: int
    events: list[Event]
    keyframes: list[bytes] = []
    """Records of ``runtime.cycle.KEYFRAME_DTYPE``, raw: what a replay begins from."""
    policies: dict[int, str] = {}
    """Files of all policies that these ticks may have used, by generation; without the active one."""


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording read back."""

    path: Path
    header: Header
    ticks: Records
    """Oldest first. Shape (n,), read-only."""


class Recorder:
    """The ring. ``keep`` belongs to the tick; ``write`` may run on any other thread at the same time."""

    def __init__(self, folder: Path, rate_hz: float, seconds: float, max_files: int, max_bytes: int) -> None:
        self.folder = folder
        self.events: deque[Event] = deque(maxlen=EVENTS)
        """What happened lately."""
        self.count = 0
        """Ticks kept since the start."""
        self.keyframe_every = max(1, round(rate_hz * KEYFRAME_SECONDS))
        """Ticks between two keyframes; the first tick has one."""
        self._wanted = max(1, round(rate_hz * seconds))
        self._keyframes: deque[tuple[int, Records]] = deque(maxlen=2 + self._wanted // self.keyframe_every)
        self._ring = np.zeros(self._wanted + round(rate_hz * MARGIN_SECONDS) + CHUNK, TICK_DTYPE)
        self._ring.view(np.uint8)[:] = 0  # touch every page now, not in the loop
        self._max_files, self._max_bytes = max_files, max_bytes

    def keep(self, tick: Records) -> None:
        """Copy the record of one tick (1,) into the ring."""
        self._ring[self.count % len(self._ring)] = tick[0]
        self.count += 1

    def keep_keyframe(self, keyframe: Records) -> None:
        """Take what was remembered after the tick that was kept last."""
        self._keyframes.append((self.count - 1, keyframe))

    def keyframes(self) -> list[bytes]:
        """The oldest few that belong to ticks which a file written now would hold."""
        first = self.count - self._wanted
        return [keyframe.tobytes() for count, keyframe in tuple(self._keyframes) if count >= first][:3]

    def write(self, header: Header, stem: str) -> Path:
        """Write what the ring holds to ``<folder>/<stem>.trotd``: whole or not at all. Blocks; not for the loop.

        Raises:
            OSError: the disk refused.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f"{stem}{SUFFIX}"
        unfinished = path.with_suffix(".part")
        end = self.count
        try:
            with unfinished.open("wb") as file:
                encoded = msgspec.json.encode(header)
                file.write(MAGIC + _length.pack(len(encoded)) + encoded)
                for first in range(max(0, end - self._wanted), end, CHUNK):
                    self._write_chunk(file, first, min(first + CHUNK, end))
                file.flush()
                os.fsync(file.fileno())
            unfinished.replace(path)
        except BaseException:
            unfinished.unlink(missing_ok=True)
            raise
        _sync_folder(self.folder)
        self._prune(path)
        return path

    def _write_chunk(self, file: Any, first: int, last: int) -> None:
        size = len(self._ring)
        if self.count - first >= size:
            return  # overtaken by the ticks on a very slow disk: the oldest are the ones to lose
        begin, end = first % size, (last - 1) % size + 1
        parts = [self._ring[begin:end]] if begin < end else [self._ring[begin:], self._ring[:end]]
        for part in parts:
            file.write(part.view(np.uint8).data)

    def _prune(self, newest: Path) -> None:
        files = sorted(list_recordings(self.folder), key=lambda path: path.stat().st_mtime_ns)
        total = sum(path.stat().st_size for path in files)
        for path in files:
            if path == newest or (len(files) <= self._max_files and total <= self._max_bytes):
                break
            total -= path.stat().st_size
            files = files[1:]
            with contextlib.suppress(FileNotFoundError):
                path.unlink()


def layout() -> list[tuple[str, str, list[int], int]]:
    """``TICK_DTYPE`` field by field."""
    assert TICK_DTYPE.fields is not None
    return [
        (name, dtype.base.str, list(dtype.shape), offset) for name, (dtype, offset, *_) in TICK_DTYPE.fields.items()
    ]


def list_recordings(folder: Path) -> list[Path]:
    """Finished recordings in ``folder``, by name."""
    return sorted(folder.glob(f"*{SUFFIX}")) if folder.is_dir() else []


def load(path: Path) -> Recording:
    """Read a recording; its records have the layout of the version that wrote it.

    Raises:
        RecordingError: not a recording, cut short, or unreadable.
    """
    try:
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise RecordingError(f"{path}: not a trotd recording")
            size = file.read(_length.size)
            length = _length.unpack(size)[0] if len(size) == _length.size else -1
            encoded = file.read(length) if 0 <= length <= path.stat().st_size else b""
            header = msgspec.json.decode(encoded, type=Header)
            body = file.read()
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error
    except msgspec.MsgspecError as error:
        raise RecordingError(f"{path}: header: {error}") from error
    return Recording(path, header, _records(path, header, body))


def _records(path: Path, header: Header, body: bytes) -> Records:
    names, types, shapes, offsets = zip(*header.layout, strict=True) if header.layout else ((), (), (), ())
    try:
        dtype = np.dtype(
            {
                "names": list(names),
                "formats": [(kind, tuple(shape)) for kind, shape in zip(types, shapes, strict=True)],
                "offsets": list(offsets),
                "itemsize": header.itemsize,
            }
        )
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{path}: layout: {error}") from error
    if not header.itemsize or len(body) % header.itemsize:
        raise RecordingError(f"{path}: {len(body)} bytes of ticks, not a multiple of {header.itemsize}")
    return np.frombuffer(body, dtype)


def _sync_folder(folder: Path) -> None:
    fd = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
