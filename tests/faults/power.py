"""A disk whose power can be cut between any two steps, and what such a disk may have kept.

What was not brought to it by ``fsync`` is lost in part: of a file's data any beginning remains, or zeros of the whole
length; a new name remains or the old one is back, until its folder was brought to the disk. Journalling file systems
promise less loss than this, never more.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


class PowerCut(BaseException):
    """The machine is gone: nothing after this ran."""


class Disk:
    """Stands between the program and the files below ``folder`` while it is patched in."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path, cut: int, seed: int) -> None:
        """Cut the power before step ``cut`` (from 1; 0 for never); ``seed`` decides what is lost then."""
        self.steps: list[str] = []
        self._folder, self._cut, self._random = folder, cut, random.Random(seed)
        self._unsynced: dict[int, int] = {}
        """Inode → bytes of it that are certain."""
        self._renamed: list[tuple[Path, Path, bytes | None]] = []
        """Source, target and what the target held, of renames whose folder is not on the disk yet, oldest first."""
        self._open, self._replace, self._fsync = Path.open, Path.replace, os.fsync
        monkeypatch.setattr(Path, "open", self._wrap("open", Path.open, self._opened))
        monkeypatch.setattr(Path, "replace", self._wrap("replace", self._rename))
        monkeypatch.setattr(Path, "unlink", self._wrap("unlink", Path.unlink))
        monkeypatch.setattr(os, "fsync", self._wrap("fsync", self._sync))

    def lose(self) -> None:
        """The power is gone: what the disk has of it all, as the next start will find it."""
        for source, target, before in reversed(self._renamed):
            if self._random.random() < 0.5:
                continue
            target.rename(source)
            if before is not None:
                target.write_bytes(before)
        for path in self._folder.rglob("*"):
            if path.is_file() and (certain := self._unsynced.get(path.stat().st_ino)) is not None:
                data = path.read_bytes()
                keep = self._random.randint(certain, len(data))
                tail = b"\0" * (len(data) - keep) if self._random.random() < 0.3 else b""
                path.write_bytes(data[:keep] + tail)

    def _wrap(self, name: str, act: Callable[..., Any], also: Callable[..., Any] | None = None) -> Callable[..., Any]:
        def step(*args: Any, **more: Any) -> Any:
            if name == "open" and (args[1:2] or ("r",))[0].startswith("r"):
                return act(*args, **more)
            self._count(name)
            result = act(*args, **more)
            return result if also is None else also(result)

        return step

    def _count(self, name: str) -> None:
        self.steps.append(name)
        if self._cut and len(self.steps) >= self._cut:
            raise PowerCut

    def _opened(self, file: Any) -> Any:
        self._unsynced[os.fstat(file.fileno()).st_ino] = 0
        write = file.write

        class Counted:
            def __getattr__(_self, name: str) -> Any:  # noqa: N805
                return getattr(file, name)

            def write(_self, data: bytes) -> int:  # noqa: N805
                self._count("write")
                number: int = write(data)
                file.flush()
                self._unsynced.setdefault(os.fstat(file.fileno()).st_ino, 0)
                return number

            def __enter__(_self) -> Any:  # noqa: N805
                return _self

            def __exit__(_self, *_: object) -> None:  # noqa: N805
                file.close()

        return Counted()

    def _rename(self, source: Path, target: Path) -> Path:
        before = target.read_bytes() if target.exists() else None
        self._renamed.append((Path(source), Path(target), before))
        return self._replace(source, target)

    def _sync(self, fd: int) -> None:
        self._fsync(fd)
        at = Path(f"/proc/self/fd/{fd}").readlink()
        if at.is_dir():
            self._renamed = [entry for entry in self._renamed if entry[1].parent != at]
        else:
            self._unsynced.pop(os.fstat(fd).st_ino, None)
