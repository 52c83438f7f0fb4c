"""Daemons for tests: a robot of its own name on a port of its own, quick movements, and a body that remembers."""

from __future__ import annotations

import asyncio
import itertools
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec

from drivers.null import NullRobot
from drivers.robot import JointCommand, Measurement
from runtime import config, policies
from runtime.config import ROBOTS, Config
from runtime.control.policy import Policy
from runtime.control.posture import Posture
from runtime.daemon import Daemon, Job
from runtime.messages.mode import Mode, ModeReply, Request
from runtime.messages.status import Status
from runtime.tick_record import Wake
from station.session import Station, StationError, connected, free_endpoint

_numbers = itertools.count()
PATIENCE = 120.0
"""s that a test waits for what has to happen, on a machine that may be very busy."""
QUICK = {
    "posture.soft_start": 0.05,
    "posture.fold_time": 0.05,
    "posture.rise_time": 0.05,
    "posture.settle_time": 0.01,
    "posture.blend_time": 0.02,
    "damp.deadline": 0.3,
    "arming.soak_time": 0.0,  # the machine may be busy: no test is held to a time
    "command.stand_after": 600.0,
    "arming.max_missed": 1.0,
    "arming.max_lateness": 60.0,
    "limits.stall_stand": 60.0,
    "limits.stall_damp": 60.0,
    "limits.max_position_jump": 3.0,  # the null body is at once where it was told to be, without any speed
    "limits.max_position_noise": 3.0,
    "recorder.seconds": 2.0,
    "audition.shadow": 0.1,
    "audition.blend": 0.05,
    "audition.trial": 0.2,
    "recorder.after_fault": 0.02,
}


def make_config(**changes: Any) -> Config:
    """Stoch3 under a name of its own; keys with ``__`` for the dot."""
    named = {key.replace("__", "."): value for key, value in changes.items()}
    own = {"robot.name": f"test-{os.getpid()}-{next(_numbers)}", "link.listen": [free_endpoint()]}
    return config.override(config.load(config.find_robot("stoch3")), "test", QUICK | own | named)


def make_policy(robot: str = "stoch3") -> Policy:
    policy = policies.load(policies.find_policy("balance"), "stoch3")
    return msgspec.structs.replace(policy, robot=robot)


class Probe(NullRobot):
    """The null body, remembering every command, doing what a test asks before it answers."""

    def __init__(self, made: Config) -> None:
        super().__init__(Posture(made.robot, made.control, made.posture).folded_joints)
        self.commands: list[JointCommand] = []
        self.closed = False
        self.before: Callable[[Probe], None] = lambda _probe: None
        self.change: Callable[[Measurement], Measurement] = lambda measurement: measurement

    async def exchange(self, command: JointCommand) -> Measurement:
        self.commands.append(command)
        self.before(self)
        return self.change(await super().exchange(command))

    async def close(self) -> None:
        self.closed = True
        await super().close()


def is_damp(command: JointCommand) -> bool:
    return not command.kp.any() and not command.torque.any() and bool((command.kd > 0).all())


class Served:
    """A daemon in this process and a client beside it; the client's calls run on a thread, as another process would."""

    def __init__(
        self,
        made: Config,
        folder: Path,
        body: Any = None,
        channels: Any = lambda _keys: (),
        memory: Path | None = None,
        simulated: bool = True,
    ) -> None:
        self.config = made
        self.body = body or Probe(made)
        self.ready = asyncio.Event()
        policy = make_policy(made.robot.name)
        job = Job(made, "# test", policy, self.body, folder, channels, lambda: self.ready.set(), simulated, memory)
        self.daemon = Daemon(job)

    async def __aenter__(self) -> Served:
        self.task = asyncio.get_running_loop().create_task(self.daemon.run())
        waiting = asyncio.get_running_loop().create_task(self.ready.wait())
        await asyncio.wait((self.task, waiting), return_when=asyncio.FIRST_COMPLETED)
        if self.task.done():
            waiting.cancel()
            await self.task
        return self

    async def __aexit__(self, *_: object) -> None:
        self.daemon.stop()
        await asyncio.gather(self.task, return_exceptions=True)

    async def client(self, act: Callable[[Station], Any]) -> Any:
        def run() -> Any:
            with connected(self.config.robot.name, self.config.link.listen[0], PATIENCE) as station:
                return act(station)

        return await asyncio.to_thread(run)

    async def ask(self, word: str) -> ModeReply:
        reply: ModeReply = await self.client(
            lambda station: station.ask_for(ModeReply, station.keys.mode, word.encode())
        )
        return reply

    async def reach(self, mode: Mode) -> None:
        await self.until(lambda: self.daemon.cycle.state.mode is mode)

    async def stand(self) -> None:
        for wish in (Request.ARM, Request.STAND):
            await self.until(lambda wish=wish: self.daemon.take_request(wish).accepted)
        await self.reach(Mode.STAND)

    async def until(self, fact: Callable[[], bool]) -> None:
        await until(fact)

    async def ticks(self, count: int) -> None:
        """Until the loop has lived ``count`` ticks more."""
        end = self.daemon.flight.recorder.count + count
        await self.until(lambda: self.daemon.flight.recorder.count >= end)

    async def walk(self) -> None:
        await self.stand()
        assert self.daemon.take_request(Request.WALK).accepted
        await self.ticks(10)


def status_when(station: Station, fact: Callable[[Status], bool]) -> Status:
    """The first status of which ``fact`` holds."""
    end = time.monotonic() + PATIENCE
    while not fact(status := station.next_status()):
        assert time.monotonic() < end, status
    return status


async def until(fact: Callable[[], bool]) -> None:
    """Until ``fact`` holds."""
    async with asyncio.timeout(PATIENCE):
        while not fact():  # noqa: ASYNC110
            await asyncio.sleep(0.005)


def wake(index: int, rate_hz: float = 200.0) -> Wake:
    """The tick at ``index`` periods, on time."""
    return Wake(index, index / rate_hz, 1.0 / rate_hz, 0.0, 0)


@contextmanager
def running(
    folder: Path, robot: Path, body: str, state: Path | None = None
) -> Iterator[tuple[subprocess.Popen[str], Station]]:
    """A daemon in a process of its own, all that it leaves below ``folder``, or in ``state``, and a client of it."""
    endpoint = free_endpoint()
    command = [sys.executable, "-m", "trotd.cli", "run", "--body", body, "--robot", str(robot)]
    command += ["--listen", endpoint, "--state", str(state or folder)]
    environment = os.environ | {"RUNTIME_DIRECTORY": str(folder / "run")}
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
    try:
        with _reached(process, robot.stem, endpoint) as station:
            yield process, station
    finally:
        process.kill()
        process.communicate()


@contextmanager
def _reached(process: subprocess.Popen[str], robot: str, endpoint: str) -> Iterator[Station]:
    end = time.monotonic() + 240.0  # on a busy machine compiling alone takes two minutes
    while True:
        try:
            with connected(robot, endpoint, PATIENCE) as station:
                station.next_status()
                yield station
                return
        except StationError:
            assert process.poll() is None and time.monotonic() < end, "the daemon does not come up"
            time.sleep(0.1)


CALM = ("arming", "limits", "command")
"""Tables of ``QUICK`` that keep a robot going on a busy machine."""


def quick_robot(folder: Path, more: str = "", tables: tuple[str, ...] = ("posture", *CALM)) -> Path:
    """The TOML of a Stoch3 with ``tables`` of ``QUICK`` and ``more`` of its own."""
    path = folder / "stoch3.toml"
    path.write_text(f"{(ROBOTS / 'stoch3.toml').read_text()}\n{quick_tables(*tables)}\n{more}")
    return path


def quick_tables(*tables: str) -> str:
    """``QUICK`` as TOML: all of it, or these tables."""
    lines: dict[str, list[str]] = {}
    for key, value in QUICK.items():
        table, _, name = key.partition(".")
        lines.setdefault(table, [f"[{table}]"]).append(f"{name} = {value}")
    return "\n".join("\n".join(lines[table]) for table in tables or lines)
