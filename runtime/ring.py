"""The newest rows of a run, in a file that is mapped into memory: what a killed process had written is still there.

Every row has a sequence number beside it, 0 while the row is being written and its number, counted from 1, once it is
whole. The file lies in a folder that the kernel keeps in RAM: writing a row is a copy, and no disk is touched.
"""

from __future__ import annotations

import mmap
import os
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from runtime.control.records import Records

MAGIC = b"trotd ring 1\n".ljust(16, b"\0")
PAGE = 4096
_ROWS = struct.Struct("<QQ")
"""Rows and bytes a row, after the magic: one pair for each kind."""


class RingError(ValueError):
    """A file that is no ring: the message names it."""


class Rows:
    """A ring of rows of one size over memory that somebody else owns."""

    def __init__(self, memory: np.ndarray, dtype: np.dtype[Any], length: int) -> None:
        """``memory``: ``space(dtype.itemsize, length)`` bytes."""
        self.rows = memory[8 * length :].view(dtype)
        """Shape (length,)."""
        self.sequence = memory[: 8 * length].view(np.uint64)
        """Shape (length,)."""
        self.count = 0
        """Rows put so far."""
        self._size = dtype.itemsize
        self._bytes, self._numbers = memory[8 * length :].data, self.sequence.data

    def put(self, row: Records) -> None:
        """Copy a row of shape (1,) over the oldest."""
        numbers, size = self._numbers, self._size
        place = self.count % len(numbers)
        numbers[place] = 0
        self._bytes[place * size : (place + 1) * size] = row.tobytes()  # a structured assignment goes field by field
        self.count += 1
        numbers[place] = self.count

    def whole(self) -> np.ndarray:
        """Places of the newest rows that follow each other without a gap, oldest first."""
        newest = int(self.sequence.max(initial=0))
        numbers = np.arange(newest, max(0, newest - len(self.rows)), -1)
        places = (numbers - 1) % len(self.rows)
        torn = np.flatnonzero(self.sequence[places] != numbers)
        return places[: torn[0] if len(torn) else None][::-1]


def space(itemsize: int, length: int) -> int:
    """Bytes that ``length`` rows and their sequence numbers take: whole pages."""
    return -(-(8 + itemsize) * length // PAGE) * PAGE


class Kind(NamedTuple):
    """What one of the rings in a file holds."""

    dtype: np.dtype[Any]
    length: int


def create(kinds: Sequence[Kind], path: Path | None = None) -> list[Rows]:
    """Rings in one piece of memory, every page of it there before this returns; with ``path``, in that new file.

    Raises:
        OSError: no room for it, or the file cannot be made.
    """
    sizes = [space(kind.dtype.itemsize, kind.length) for kind in kinds]
    total = PAGE + sum(sizes)
    if path is None:
        mapped = mmap.mmap(-1, total, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    else:
        with path.open("xb+") as file:
            os.posix_fallocate(file.fileno(), 0, total)  # a full file system refuses here, not by a signal in the tick
            mapped = mmap.mmap(file.fileno(), total)
    memory = np.frombuffer(mapped, np.uint8)
    memory[:] = 0
    head = MAGIC + b"".join(_ROWS.pack(kind.length, kind.dtype.itemsize) for kind in kinds)
    memory[: len(head)] = np.frombuffer(head, np.uint8)
    return _cut(memory, kinds)


def open_left(path: Path, kinds: int) -> list[Rows]:
    """The rings of a file that another process left, rows as raw bytes; nothing is copied.

    Raises:
        RingError: not such a file, or cut short.
        OSError: it cannot be read.
    """
    memory = np.memmap(path, np.uint8, "r") if path.stat().st_size else np.zeros(0, np.uint8)
    head = memory[:PAGE].tobytes()
    if len(head) < PAGE or not head.startswith(MAGIC):
        raise RingError(f"{path}: not a ring of trotd")
    described = [_ROWS.unpack_from(head, len(MAGIC) + place * _ROWS.size) for place in range(kinds)]
    if not all(length and size for length, size in described):
        raise RingError(f"{path}: a ring without rows")
    if len(memory) != PAGE + sum(space(size, length) for length, size in described):
        raise RingError(f"{path}: {len(memory)} bytes, which is not what it says of itself")
    return _cut(memory, [Kind(np.dtype((np.void, size)), length) for length, size in described])


def _cut(memory: np.ndarray, kinds: Sequence[Kind]) -> list[Rows]:
    rings, first = [], PAGE
    for kind in kinds:
        used = (8 + kind.dtype.itemsize) * kind.length
        rings.append(Rows(memory[first : first + used], kind.dtype, kind.length))
        first += space(kind.dtype.itemsize, kind.length)
    return rings
