"""Disks for tests that refuse: a small one that can be filled, and folders that may be read only."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

SIZE = 2**21


def mount(*arguments: str) -> None:
    done = subprocess.run(["mount", *arguments], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        pytest.skip(f"mounting a small disk is not permitted here: {done.stderr.strip()}")


@contextmanager
def small_file_system(disk: Path) -> Iterator[Path]:
    """A file system of 2 MB at ``disk``, which a recording of a few seconds fills."""
    if shutil.which("mount") is None:
        pytest.skip("no mount here")
    disk.mkdir()
    mount("-t", "tmpfs", "-o", f"size={SIZE}", "trotd-test", str(disk))
    try:
        yield disk
    finally:
        while disk.is_mount():  # one over the other, where the test forbade all of it
            subprocess.run(["umount", "--lazy", str(disk)], check=True)


def fill(disk: Path, leave: int = SIZE // 16) -> Callable[[], None]:
    """Leave so many bytes at most; returns what makes room again."""
    filler = disk / "filler"
    with filler.open("wb", buffering=0) as file:
        room = shutil.disk_usage(disk).free - leave
        while room > 0:
            room -= file.write(bytes(min(room, 4096)))
    return filler.unlink


def forbid(folder: Path) -> Callable[[], None]:
    """Make a folder read-only, for root as well; returns what undoes it."""
    folder.mkdir(parents=True, exist_ok=True)
    mount("--bind", str(folder), str(folder))
    mount("-o", "remount,ro,bind", str(folder))
    return lambda: subprocess.run(["umount", "--lazy", str(folder)], check=True) and None
