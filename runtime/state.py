"""What the daemon keeps between runs, and the lock that lets one daemon serve one robot."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

OWNER = "state"
"""In a folder in memory: the path of the state folder that it belongs to."""


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


def memory_folder(state: Path) -> Path:
    """Where that lies which must outlive the process but need not outlive the machine's power.

    systemd's RUNTIME_DIRECTORY, ``$XDG_RUNTIME_DIR/trotd``, or ``/dev/shm/trotd-<uid>``, all kept in RAM; in it a
    folder of its own for every state folder. What belongs to a state folder that is gone is removed.

    Raises:
        OSError: it is somebody else's, or cannot be made.
    """
    if granted := os.environ.get("RUNTIME_DIRECTORY"):
        root = Path(granted.partition(":")[0])
    elif own := os.environ.get("XDG_RUNTIME_DIR"):
        root = Path(own) / "trotd"
    else:
        root = Path("/dev/shm") / f"trotd-{os.getuid()}"
    root.mkdir(mode=0o700, parents=True, exist_ok=True)
    if root.is_symlink() or root.stat().st_uid != os.getuid():
        raise PermissionError(f"{root} is not a folder of this user: remove it")
    state.mkdir(parents=True, exist_ok=True)
    for owner in root.glob(f"*/{OWNER}"):
        if not Path(owner.read_text()).is_dir():
            shutil.rmtree(owner.parent, ignore_errors=True)
    folder = root / hashlib.sha256(os.fsencode(state.resolve())).hexdigest()[:12]
    folder.mkdir(mode=0o700, exist_ok=True)
    (folder / OWNER).write_text(str(state.resolve()))
    return folder
