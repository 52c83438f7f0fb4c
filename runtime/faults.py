"""The history of faults: what stood, with its evidence, kept across restarts in one small file that is never half.

JSON with a version; bounded, newest last. A file that is not ours to read is put aside, never overwritten.
"""

from __future__ import annotations

import asyncio
import threading
import time
from pathlib import Path

import msgspec

from drivers.durable import write_whole
from runtime.cycle import Fault
from runtime.messages.fault import FaultRecord

VERSION = 1
KEPT = 200
"""Faults that are remembered; the oldest go first."""


class FaultFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The file."""

    version: int
    faults: list[FaultRecord]


class FaultFileError(ValueError):
    """A history that cannot be read: the message names the file and why."""


def load_faults(path: Path) -> list[FaultRecord]:
    """The history in ``path``, oldest first; none where there is no file.

    Raises:
        FaultFileError: not readable, or of another version.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise FaultFileError(f"{path}: {error.strerror}") from error
    try:
        version = msgspec.json.decode(data, type=dict).get("version")
        if version != VERSION:
            raise FaultFileError(f"{path}: format {version!r}, this program reads {VERSION}")
        return msgspec.json.decode(data, type=FaultFile).faults
    except msgspec.MsgspecError as error:
        raise FaultFileError(f"{path}: {error}") from error


def fault_file(folder: Path, robot: str) -> Path:
    """Where the history of ``robot`` is kept in the state folder."""
    return folder / "faults" / f"{robot}.json"


class FaultHistory:
    """One robot's faults. ``take`` belongs to the loop; the disk is waited for on another thread."""

    def __init__(self, path: Path) -> None:
        """Read what is there; ``problem`` says why not."""
        self.path = path
        self.problem = ""
        try:
            self.records = load_faults(path)[-KEPT:]
        except FaultFileError as error:
            self.records, self.problem = [], str(error)
            self._put_aside()
        self._due = asyncio.Event()
        self._saved = True
        self._one_writer = threading.Lock()

    def take(self, fault: Fault) -> None:
        """Remember a fault that has just begun to stand."""
        record = FaultRecord(
            time=time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            tick=fault.tick,
            mode=fault.mode.name,
            led_to=fault.led_to.name,
            evidence=fault.evidence,
        )
        self.records = [*self.records, record][-KEPT:]
        self._saved = False
        self._due.set()

    async def run(self) -> None:
        """Write the file after every fault, until cancelled."""
        while True:
            await self._due.wait()
            self._due.clear()
            await asyncio.to_thread(self.save)

    def save(self) -> None:
        """Write what is not yet written; a disk that refuses is noted in ``problem``, never fatal."""
        with self._one_writer:
            if self._saved:
                return
            records = self.records
            data = msgspec.json.format(msgspec.json.encode(FaultFile(version=VERSION, faults=records)), indent=1)
            try:
                write_whole(self.path, data + b"\n")
            except OSError as error:
                self.problem = f"{self.path}: {error.strerror}"
            else:
                self._saved = records is self.records

    def _put_aside(self) -> None:
        try:
            self.path.replace(self.path.with_name(f"{self.path.name}.{time.strftime('%Y%m%dT%H%M%S')}"))
        except OSError as error:
            self.problem += f"; {error.strerror}"
