"""Recordings as files: written whole or not at all, read back or refused, the oldest removed.

A file is one line ``trotd recording 1``, the length of the header as a little-endian u64, the header as JSON, then raw
tick records to the end. The header holds all that a replay needs: the robot's TOML, the policy, the versions, the
record's layout and what happened.
"""

from __future__ import annotations

import contextlib
import re
import struct
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from drivers.description import UNDECODABLE
from drivers.durable import replacing
from runtime.control.records import Records
from runtime.messages.event import Event
from runtime.messages.tick import TICK_DTYPE

VERSION = 1
_MARK = b"trotd recording "
MAGIC = _MARK + b"%d\n" % VERSION
SUFFIX = ".trotd"
_PLAIN = re.compile(r"[<>|][iuf][1248]")
"""Numbers alone: an object in a file is somebody else's program."""
_length = struct.Struct("<Q")


class RecordingError(ValueError):
    """A file that is not a whole recording: the message names it and what is wrong."""


class Header(msgspec.Struct, frozen=True, kw_only=True):
    """What a recording says about itself."""

    robot: str
    robot_toml: str
    """The robot's file, whole."""
    config: dict[str, Any] = {}
    """What it ran with: the file, changed by the command line and the calibration; empty from older versions."""
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
    """Records of ``runtime.keyframe.KEYFRAME_DTYPE``, raw: what a replay begins from."""
    policies: dict[int, str] = {}
    """Files of all policies that these ticks may have used, by generation; without the active one."""


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording read back."""

    path: Path
    header: Header
    ticks: Records
    """Oldest first. Shape (n,), read-only."""


def save(path: Path, header: Header, ticks: Iterable[bytes | memoryview]) -> None:
    """Write a recording: whole or not at all. Blocks.

    Raises:
        OSError: the disk refused; what was at ``path`` is as it was.
    """
    encoded = msgspec.json.encode(header)
    with replacing(path) as file:
        file.write(MAGIC + _length.pack(len(encoded)) + encoded)
        for part in ticks:
            file.write(part)


def stem(at: float, reason: str) -> str:
    """A recording's name: local time of ``at`` (s, wall clock) to the millisecond, and why it was written."""
    return (
        f"{time.strftime('%Y%m%dT%H%M%S', time.localtime(at))}-{int(at * 1000) % 1000:03d}-{reason.replace(' ', '-')}"
    )


def prune(folder: Path, newest: Path, max_files: int, max_bytes: int) -> None:
    """Remove the oldest recordings beyond what is allowed; never ``newest``."""
    files = sorted(list_recordings(folder), key=lambda path: path.stat().st_mtime_ns)
    total = sum(path.stat().st_size for path in files)
    for path in files:
        if path == newest or (len(files) <= max_files and total <= max_bytes):
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
            _check_mark(file.readline(len(_MARK) + 8), path)
            size = file.read(_length.size)
            length = _length.unpack(size)[0] if len(size) == _length.size else -1
            encoded = file.read(length) if 0 <= length <= path.stat().st_size else b""
            header = msgspec.json.decode(encoded, type=Header)
            body = file.read()
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error
    except UNDECODABLE as error:
        raise RecordingError(f"{path}: header: {error}") from error
    return Recording(path, header, _records(path, header, body))


def _check_mark(line: bytes, path: Path) -> None:
    """What a file begins with tells its version; another one's layout is not guessed."""
    if line == MAGIC:
        return
    number = line.removeprefix(_MARK).removesuffix(b"\n")
    if not line.startswith(_MARK) or not number.isdigit():
        raise RecordingError(f"{path}: not a trotd recording")
    advice = "update trotd" if int(number) > VERSION else "read it with the trotd that wrote it"
    raise RecordingError(f"{path}: version {int(number)}, this program reads {VERSION}; {advice}")


def _records(path: Path, header: Header, body: bytes) -> Records:
    dtype = dtype_of(header, str(path))
    if not header.itemsize or len(body) % header.itemsize:
        raise RecordingError(f"{path}: {len(body)} bytes of ticks, not a multiple of {header.itemsize}")
    return np.frombuffer(body, dtype)


def dtype_of(header: Header, place: str) -> np.dtype[Any]:
    """The layout of a recording's records.

    Raises:
        RecordingError: it is none; ``place`` is how the message names where it came from.
    """
    names, types, shapes, offsets = zip(*header.layout, strict=True) if header.layout else ((), (), (), ())
    if not all(_PLAIN.fullmatch(kind) for kind in types):
        raise RecordingError(f"{place}: layout: fields of type {', '.join(sorted(set(types)))[:80]}")
    try:
        return np.dtype(
            {
                "names": list(names),
                "formats": [(kind, tuple(shape)) for kind, shape in zip(types, shapes, strict=True)],
                "offsets": list(offsets),
                "itemsize": header.itemsize,
            }
        )
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{place}: layout: {error}") from error
