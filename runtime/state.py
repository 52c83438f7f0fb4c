"""What the daemon keeps between runs, and the lock that lets one daemon serve one robot."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path


class AlreadyRunning(RuntimeError):
    """Another daemon serves this robot."""


def state_folder() -> Path:
    """systemd's STATE_DIRECTORY, or ``$XDG_STATE_HOME/trotd``, or ``~/.local/state/trotd``."""
    if granted := os.environ.get("STATE_DIRECTORY"):
        return Path(granted.partition(":")[0])
    home = os.environ.get("XDG_STATE_HOME")
    return (Path(home) if home else Path.home() / ".local" / "state") / "trotd"


@contextlib.contextmanager
def lock(folder: Path, robot: str) -> Iterator[None]:
    """Hold the robot's lock; the kernel lets go of it whatever becomes of the process.

    Raises:
        AlreadyRunning: another process holds it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{robot}.lock"
    with path.open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read().strip() or "unknown"
            raise AlreadyRunning(f"robot {robot!r} is served by process {holder} already ({path})") from None
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield


def write_whole(path: Path, data: bytes) -> None:
    """Replace a file by ``data``, whole or not at all, and on the disk when this returns."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.part")
    with unfinished.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    unfinished.replace(path)
