"""What one run of the daemon leaves behind: every tick in the ring, and a recording on fault, on request and at stop.

``keep`` belongs to the tick and waits for nothing; files are written on a thread beside it.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import platform
import time
from collections import deque
from concurrent.futures import Future
from importlib import metadata
from pathlib import Path

from runtime.config import Config
from runtime.cycle import Cycle
from runtime.messages import Event
from runtime.recorder import Header, Recorder, layout

log = logging.getLogger("trotd")

POLICIES = 9
"""Files of policies that a recording takes along: the active one and those before it."""
VERSIONED = ("trotd", "numpy", "numba", "daqp", "msgspec", "eclipse-zenoh")


class FlightLog:
    """The recorder of one run and the recordings that are due."""

    def __init__(self, config: Config, robot_toml: str, folder: Path, cycle: Cycle) -> None:
        """``folder`` is the state folder; ``robot_toml`` the text that ``config`` was read from."""
        name, limits = config.robot.name, config.recorder
        self.recorder = Recorder(
            folder / "recordings" / name, config.control.rate_hz, limits.seconds, limits.max_files, limits.max_bytes
        )
        self.written: list[Path] = []
        """Recordings of this run, oldest first."""
        self._config, self._robot_toml, self._cycle = config, robot_toml, cycle
        self._policies: dict[int, bytes] = {}
        self._due = asyncio.Event()
        self._waiting: deque[tuple[int, str, Future[Path] | None]] = deque()

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
        self.recorder.events.append(event)
        if event.kind == "fault":
            after = round(self._config.recorder.after_fault * self._config.control.rate_hz)
            self._waiting.append((self.recorder.count + after, "fault", None))

    def take_policy(self, generation: int, data: bytes) -> None:
        """Remember the file of the policy that ticks of ``generation`` use."""
        self._policies[generation] = data
        if len(self._policies) > POLICIES:
            del self._policies[min(self._policies)]

    def ask(self, reason: str, done: Future[Path]) -> None:
        """Write a recording with the next tick."""
        self._waiting.appendleft((self.recorder.count, reason, done))

    async def run(self) -> None:
        """Write what becomes due, for ever."""
        while True:
            await self._due.wait()
            self._due.clear()
            while self._waiting and self._waiting[0][0] <= self.recorder.count:
                _, reason, done = self._waiting.popleft()
                try:
                    path = await asyncio.to_thread(self.write, reason)
                except OSError as error:
                    self._cycle.note("recording", f"not written: {error}")
                    if done is not None:
                        done.set_exception(error)
                else:
                    if done is not None:
                        done.set_result(path)

    def finish(self) -> None:
        """The loop is over: keep its recording, disappoint who still waits for one."""
        for _, _, done in self._waiting:
            if done is not None:
                done.set_exception(OSError("the daemon is stopping"))
        self._waiting.clear()
        try:
            if self.recorder.count:
                self.write("stop")
        except OSError as error:
            log.error("recording: %s", error)

    def write(self, reason: str) -> Path:
        """Write what the ring holds now. Blocks; not for the loop while it ticks.

        Raises:
            OSError: the disk refused.
        """
        now = time.time()
        stamp = time.strftime("%Y%m%dT%H%M%S", time.localtime(now)) + f"-{int(now * 1000) % 1000:03d}"
        path = self.recorder.write(self._header(reason, now), f"{stamp}-{reason.replace(' ', '-')}")
        self.written.append(path)
        self._cycle.note("recording", f"{reason}: {path}")
        return path

    def _header(self, reason: str, now: float) -> Header:
        *before, active = sorted(self._policies)
        return Header(
            robot=self._config.robot.name,
            robot_toml=self._robot_toml,
            policy=self._policies[active].decode(),
            rate_hz=self._config.control.rate_hz,
            reason=reason,
            written=time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(now)),
            versions=versions(),
            layout=layout(),
            itemsize=self._cycle.tick.dtype.itemsize,
            events=list(self.recorder.events),
            keyframes=self.recorder.keyframes(),
            policies={generation: self._policies[generation].decode() for generation in before},
        )


def versions() -> dict[str, str]:
    """What a replay must have been run with."""
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for name in VERSIONED:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found
