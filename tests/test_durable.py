"""Files that are never half: the power goes after any one of the steps, and the file is the old or the new one."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from drivers import durable
from drivers.durable import part_of, write_whole

OLD, NEW = b"old" * 1000, b"new" * 5000


class PowerCut(BaseException):
    """The machine is gone: nothing after this ran."""


class Machine:
    """Cuts the power before step ``cut``, and loses what was not brought to the disk by then."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, cut: int) -> None:
        self.cut = cut
        self.steps: list[str] = []
        self.synced: set[int] = set()
        self._step(monkeypatch, Path, "open")
        self._step(monkeypatch, Path, "replace", self._lose_what_is_not_synced)
        self._step(monkeypatch, os, "fsync", lambda fd: self.synced.add(os.fstat(fd).st_ino))
        monkeypatch.setattr(Path, "unlink", lambda *_args, **_more: None)  # a dead process tidies nothing up

    def _step(
        self, monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, also: Callable[..., None] = lambda *_: None
    ) -> None:
        real = getattr(owner, name)

        def step(*args: Any, **more: Any) -> Any:
            self.steps.append(name)
            if len(self.steps) == self.cut:
                raise PowerCut
            also(*args)
            return real(*args, **more)

        monkeypatch.setattr(owner, name, step)

    def _lose_what_is_not_synced(self, source: Path, _target: Path) -> None:
        if source.stat().st_ino not in self.synced:
            os.truncate(source, 0)  # the name reached the disk, the data did not


@pytest.mark.parametrize("cut", range(1, 6))
@pytest.mark.parametrize("before", [OLD, None])
def test_the_power_goes_between_any_two_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cut: int, before: bytes | None
) -> None:
    path = tmp_path / "deep" / "file"
    if before is not None:
        path.parent.mkdir()
        path.write_bytes(before)
    with monkeypatch.context() as patched:
        machine = Machine(patched, cut)
        try:
            write_whole(path, NEW)
        except PowerCut:
            assert len(machine.steps) == cut
        else:
            assert machine.steps == ["open", "fsync", "replace", "fsync"]
    found = path.read_bytes() if path.exists() else None
    assert found in (before, NEW)
    assert found == NEW or cut <= 3
    write_whole(path, b"after")
    assert path.read_bytes() == b"after" and not part_of(path).exists()


def test_a_disk_that_refuses_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_fd: int) -> None:
        raise OSError(28, "No space left on device")

    path = tmp_path / "file"
    write_whole(path, OLD)
    monkeypatch.setattr(durable.os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_whole(path, NEW)
    assert path.read_bytes() == OLD and list(tmp_path.iterdir()) == [path]
