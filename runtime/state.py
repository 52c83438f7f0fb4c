"""What the daemon keeps between runs, and the lock that lets one daemon serve one robot."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from drivers.durable import write_whole

PROBE = 65_536
"""Bytes that must fit into a state folder that is to keep anything."""
OWNER = "state"
"""In a folder in memory: the path of the state folder that it belongs to."""


class LockError(RuntimeError):
    """The robot's lock cannot be had: the message says why, and where."""


class AlreadyRunning(LockError):
    """Another daemon serves this robot."""


def state_folder() -> Path:
    """systemd's STATE_DIRECTORY, or ``$XDG_STATE_HOME/trotd``, or ``~/.local/state/trotd``."""
    if granted := os.environ.get("STATE_DIRECTORY"):
        return Path(granted.partition(":")[0])
    home = os.environ.get("XDG_STATE_HOME")
    return (Path(home) if home else Path.home() / ".local" / "state") / "trotd"


@contextlib.contextmanager
def lock(folder: Path, robot: str, spare: Path | None = None) -> Iterator[None]:
    """Hold the robot's lock; the kernel lets go of it whatever becomes of the process.

    Args:
        folder: state folder.
        robot: its name.
        spare: folder in memory, for a lock that the disk has no room for; one that lies there counts in any case.

    Raises:
        AlreadyRunning: another process holds it.
        LockError: it can lie nowhere.
    """
    name = f"{robot}.lock"
    with contextlib.ExitStack() as held:
        refused: OSError | None = None
        try:
            held.enter_context(_held(folder / name, robot))
        except OSError as error:
            refused = error
        if spare is not None and (refused is not None or (spare / name).exists()):
            try:
                held.enter_context(_held(spare / name, robot))
                refused = None
            except OSError as error:
                refused = refused or error
        if refused is not None:
            raise LockError(f"robot {robot!r}: no lock in {folder}: {refused.strerror}") from refused
        yield


@contextlib.contextmanager
def _held(path: Path, robot: str) -> Iterator[None]:
    """Raises OSError where there is no lock and none can be made."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        fd = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as refused:
        try:
            fd = os.open(path, os.O_RDONLY)  # one that is there can be held all the same
        except OSError:
            raise refused from None
    try:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(fd, 32, 0).decode(errors="replace").strip() or "unknown"
            raise AlreadyRunning(f"robot {robot!r} is served by process {holder} already ({path})") from None
        with contextlib.suppress(OSError):  # who holds it is for the message alone
            os.ftruncate(fd, 0)
            os.pwrite(fd, str(os.getpid()).encode(), 0)
        yield
    finally:
        os.close(fd)


def refusal(folder: Path) -> str:
    """Why nothing can be kept in the state folder; empty where it can."""
    probe = folder / f".{os.getpid()}.probe"
    try:
        write_whole(probe, bytes(PROBE))
        probe.unlink()
    except OSError as error:
        return error.strerror or str(error)
    return ""


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
    with contextlib.suppress(OSError):  # a disk that refuses is the lock's to tell
        state.mkdir(parents=True, exist_ok=True)
    for owner in root.glob(f"*/{OWNER}"):
        if not Path(owner.read_text()).is_dir():
            shutil.rmtree(owner.parent, ignore_errors=True)
    folder = root / hashlib.sha256(os.fsencode(state.resolve())).hexdigest()[:12]
    folder.mkdir(mode=0o700, exist_ok=True)
    (folder / OWNER).write_text(str(state.resolve()))
    return folder
