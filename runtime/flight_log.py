"""What one run of the daemon leaves behind: every tick in the ring, and a recording on fault, on request and at stop.

``keep`` belongs to the tick and waits for nothing; files are written on a thread beside it. What a run before left,
because it was killed, is written then as well.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import platform
import shutil
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from importlib import metadata
from pathlib import Path
from typing import TypeVar

import msgspec

from runtime import crash
from runtime.config import Config
from runtime.cycle import Cycle
from runtime.messages.event import Event
from runtime.recorder import Recorder
from runtime.recording import Header, layout, stem

log = logging.getLogger("trotd")

POLICIES = 9
"""Files of policies that a recording takes along: the active one and those before it."""
VERSIONED = ("trotd", "numpy", "numba", "daqp", "msgspec", "eclipse-zenoh")
STOPPING = "the daemon is stopping"
Result = TypeVar("Result")


class FlightLog:
    """The recorder of one run and the recordings that are due."""

    recorder: Recorder
    """There once the log is open."""

    def __init__(self, config: Config, robot_toml: str, folder: Path, memory: Path, cycle: Cycle) -> None:
        """Nothing is touched yet.

        Args:
            config: the robot's.
            robot_toml: the text that it was read from.
            folder: for the recordings.
            memory: for the ring: what lies there outlives the process.
            cycle: whose ticks are kept.
        """
        self.folder = folder
        self.written: list[Path] = []
        """Recordings of this run, oldest first."""
        self.refused: Counter[str] = Counter()
        """How often something could not be written, by the reason."""
        self._config, self._robot_toml, self._memory, self._cycle = config, robot_toml, memory, cycle
        self._policies: dict[int, bytes] = {}
        self._left: list[Path] = []
        self._outlives = False
        """The ring is in ``memory``."""
        self._ended = False
        """All that the ring holds is in a recording."""
        self._header_due = False
        self._due = asyncio.Event()
        self._waiting: deque[tuple[int, str, Future[Path] | None]] = deque()

    @contextlib.contextmanager
    def open(self) -> Iterator[None]:
        """Make the ring, and let go of it at the end unless it holds what could not be written. Under the robot's lock.

        Raises:
            OSError: no memory for it.
        """
        self._left = self._try(lambda: crash.claim(self._memory)) or []
        self.recorder = self._new_recorder()
        self._header_due = True
        self._keep_header()
        yield
        if self._outlives and (self._ended or not self.recorder.count):
            shutil.rmtree(self._memory, ignore_errors=True)

    def _new_recorder(self) -> Recorder:
        def create(ring: Path | None) -> Recorder:
            limits, rate_hz = self._config.recorder, self._config.control.rate_hz
            return Recorder(self.folder, rate_hz, limits.seconds, limits.max_files, limits.max_bytes, ring)

        def outliving() -> Recorder:
            self._memory.mkdir(parents=True)
            return create(self._memory / crash.RING)

        recorder = self._try(outliving)
        if recorder is None and self._left:
            self._salvage()  # two rings do not fit into memory: the one before makes room
            recorder = self._try(outliving)
        self._outlives = recorder is not None
        return recorder or create(None)

    def keep(self) -> None:
        """Take the tick that the cycle has just finished."""
        recorder, cycle = self.recorder, self._cycle
        recorder.keep(cycle.tick)
        if recorder.count % recorder.keyframe_every == 1 % recorder.keyframe_every:
            recorder.keep_keyframe(cycle.remember())
        if self._waiting and self._waiting[0][0] <= recorder.count:
            self._due.set()

    def take_event(self, event: Event) -> None:
        """Note what happened; a fault is written once the ring ran on a little after it."""
        self.recorder.keep_event(event)
        if event.kind == "fault":
            after = round(self._config.recorder.after_fault * self._config.control.rate_hz)
            self._waiting.append((self.recorder.count + after, "fault", None))

    def take_policy(self, generation: int, data: bytes) -> None:
        """Remember the file of the policy that ticks of ``generation`` use."""
        self._policies[generation] = data
        if len(self._policies) > POLICIES:
            del self._policies[min(self._policies)]
        self._header_due = True
        self._due.set()

    def ask(self, reason: str, done: Future[Path]) -> None:
        """Write a recording with the next tick."""
        self._waiting.appendleft((self.recorder.count, reason, done))

    async def run(self) -> None:
        """Write what the run before left, then what becomes due, for ever."""
        await asyncio.gather(asyncio.to_thread(self._salvage), self._write_what_is_due())

    async def _write_what_is_due(self) -> None:
        while True:
            await self._due.wait()
            self._due.clear()
            await asyncio.to_thread(self._keep_header)
            while self._waiting and self._waiting[0][0] <= self.recorder.count:
                _, reason, done = self._waiting.popleft()
                try:
                    path = await asyncio.to_thread(self.write, reason)
                except (OSError, asyncio.CancelledError) as error:
                    stopping = isinstance(error, asyncio.CancelledError)
                    if done is not None:
                        done.set_exception(OSError(STOPPING) if stopping else error)
                    if stopping:
                        raise
                else:
                    if done is not None:
                        done.set_result(path)

    def finish(self) -> None:
        """The loop is over: keep its recording, disappoint who still waits for one."""
        for _, _, done in self._waiting:
            if done is not None:
                done.set_exception(OSError(STOPPING))
        self._waiting.clear()
        if self.recorder.count:
            with contextlib.suppress(OSError):
                self.write("stop")
                self._ended = True

    def write(self, reason: str) -> Path:
        """Write what the ring holds now. Blocks; not for the loop while it ticks.

        Raises:
            OSError: the disk refused.
        """
        now = time.time()
        try:
            path = self.recorder.write(self._header(reason, now), stem(now, reason))
        except OSError as error:
            self._refuse(f"{reason}: {self.folder}", error)
            raise
        self.written.append(path)
        self._cycle.note("recording", f"{reason}: {path}")
        return path

    def _salvage(self) -> None:
        limits = self._config.recorder
        while self._left:
            left = self._left.pop(0)
            try:
                path, words = crash.salvage(left, self.folder, limits.max_files, limits.max_bytes)
            except crash.CrashError as error:
                self._cycle.note("recording", f"the run before cannot be read: {error}")
            except OSError as error:
                self._refuse(f"the run before: {self.folder}", error)
            else:
                self._cycle.note("recording", f"the run before: {words}" + (f": {path}" if path else ""))

    def _keep_header(self) -> None:
        if self._outlives and self._header_due:
            self._header_due = False
            self._try(lambda: crash.keep_header(self._memory, self._header("crash", time.time())))

    def _try(self, act: Callable[[], Result]) -> Result | None:
        """What concerns the memory that outlives the process: without it the run goes on."""
        try:
            return act()
        except OSError as error:
            self._refuse(f"not kept over a crash: {self._memory}", error)
            return None

    def _refuse(self, what: str, error: OSError) -> None:
        why = error.strerror or str(error)
        self.refused[why] += 1
        self._cycle.note("recording", f"{what}: {why} ({self.refused[why]} times so far)")

    def _header(self, reason: str, now: float) -> Header:
        policies = dict(self._policies)  # another thread may add one
        *before, active = sorted(policies)
        return Header(
            robot=self._config.robot.name,
            robot_toml=self._robot_toml,
            config=msgspec.to_builtins(self._config),
            policy=policies[active].decode(),
            rate_hz=self._config.control.rate_hz,
            reason=reason,
            written=time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(now)),
            versions=versions(),
            layout=layout(),
            itemsize=self._cycle.tick.dtype.itemsize,
            events=[] if reason == "crash" else list(self.recorder.events),
            keyframes=[] if reason == "crash" else self.recorder.keyframes(),
            policies={generation: policies[generation].decode() for generation in before},
        )


def versions() -> dict[str, str]:
    """What a replay must have been run with."""
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for name in VERSIONED:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found
