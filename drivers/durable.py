"""Files that a power cut leaves as they were or as they were to be, never in between."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A file to write into, which takes the place of ``path`` at the end, whole and on the disk; not at all if that
    fails.

    Raises:
        OSError: the disk refused.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = part_of(path)
    try:
        with unfinished.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)
        raise
    _sync(path.parent)


def write_whole(path: Path, data: bytes) -> None:
    """Replace a file by ``data``.

    Raises:
        OSError: the disk refused; the file is as it was.
    """
    with replacing(path) as file:
        file.write(data)


def part_of(path: Path) -> Path:
    """Where the unfinished ``path`` lies; a process that is killed there leaves it, and the next one writes over it."""
    return path.with_name(f".{path.name}.part")


def _sync(folder: Path) -> None:
    """Bring the folder's list of names to the disk."""
    fd = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
