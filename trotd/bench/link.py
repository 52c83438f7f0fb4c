"""What the link adds: from a client's command to the tick that uses it, the e-stop, publishing, and who looks on.

The clients are processes of their own, as a joystick, a viewer and a monitor are; times are of the one monotonic clock
that all processes of a machine share. The daemon runs under SCHED_FIFO where that is permitted, as the service does.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import queue
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import uvloop
import zenoh

from runtime import config
from runtime.config import Config
from runtime.control.records import Records
from runtime.cycle import Cycle
from runtime.doors.answers import Doors
from runtime.link import Link, session_config
from runtime.messages.mode import Mode
from runtime.messages.status import Status
from runtime.messages.tick import TICK_DTYPE
from runtime.policies import find_policy, load
from runtime.shelf import PolicyFile
from runtime.status import build_status
from station.requests import set_off
from station.session import Station, free_endpoint
from trotd.bench.daemon import ROBOT, Walking, may_fifo, walking_daemon
from trotd.bench.host import Window, calm_or_all, watched
from trotd.bench.report import Figure, Finding, shown

RATE = 200.0
QUICK_POSTURE = (
    "[posture]\nsoft_start = 0.05\nfold_time = 0.05\nrise_time = 0.05\nsettle_time = 0.01\nblend_time = 0.05\n"
)
TURN = 2.0
"""s with lookers-on or without."""
COME = 60.0
"""s that a viewer may take to come."""


def measure(quick: bool) -> Iterator[Finding]:
    """All of it, on the null body."""
    yield from command_to_applied(100 if quick else 1000, 5 if quick else 30)
    yield from publishing(2.0 if quick else 10.0)
    yield from looked_on(1 if quick else 4)


# Commands --------------------------------------------------------------------------------------------------------


def command_to_applied(commands: int, stops: int) -> Iterator[Finding]:
    """Velocity commands of distinct values found again in the daemon's ticks, and e-stops out of the walk."""
    sent: dict[float, float] = {}
    bare: list[float] = []
    stopped: list[float] = []
    jitter = random.Random(1)
    with walking_daemon(RATE, may_fifo(), commands // 20 + 5 * stops, steered=False, extra=QUICK_POSTURE) as walking:
        station = walking.station
        publisher = station.session.declare_publisher(station.keys.velocity, express=True)
        with _bare_put() as put:
            for number in shown(range(commands), "command to applied", commands):
                bare.append(put())
                value = (number + 1) * 1e-3 % 1.9
                sent[value] = time.monotonic()
                publisher.put(json.dumps({"linear": [value, 0.0], "yaw_rate": 0.0}))
                time.sleep(jitter.uniform(0.015, 0.03))
        for _ in shown(range(stops), "e-stop", stops):
            time.sleep(jitter.uniform(0.0, 0.02))
            stopped.append(time.monotonic())
            station.ask(station.keys.mode, b"damp")
            set_off(station)
    ticks = walking.read().records
    applied = np.array(list(_applied(ticks, sent)))
    floor = float(np.percentile(bare, 99))
    p50, p99 = np.percentile(applied, (50, 99)).tolist()
    bound = 1.0 / RATE + 2.0 * floor
    note = f"p50 {1e3 * p50:.2f} ms; a bare put to its callback: p99 {1e3 * floor:.2f} ms; {len(applied)} commands"
    yield Figure("link", "command to the tick that uses it: p99", 1e3 * p99, "ms", 1e3 * bound, note=note)
    damped = np.array([_damped(ticks, moment) - moment for moment in stopped]) * RATE
    yield Figure(
        "link", "e-stop to the damping command: worst", float(damped.max()), "ticks", 2.0, note=f"{stops} stops"
    )


def _applied(ticks: Records, sent: dict[float, float]) -> Iterator[float]:
    """s from each command to the tick that first followed it; a command that a newer one overtook has none."""
    asked = ticks["asked_velocity"][:, 0]
    first = {value: row for row, value in reversed(list(enumerate(asked.tolist())))}
    for value, moment in sent.items():
        if value in first:
            yield float(ticks["stamp"][first[value]]) - moment


def _damped(ticks: Records, moment: float) -> float:
    """When the first damping command after ``moment`` was ready, s."""
    after = ticks[(ticks["stamp"] + ticks["compute"] > moment) & (ticks["mode"] == Mode.DAMP)][0]
    assert not after["command_kp"].any()
    return float(after["stamp"] + after["compute"])


@contextlib.contextmanager
def _bare_put() -> Iterator[Any]:
    """A client and a peer with nothing behind them; what is yielded puts once and returns the time to the callback."""
    endpoint = free_endpoint()
    arrived: queue.SimpleQueue[float] = queue.SimpleQueue()
    key = "bare"
    with zenoh.open(session_config("peer", [endpoint], [])) as peer:
        peer.declare_subscriber(key, lambda _sample: arrived.put(time.monotonic()))
        with zenoh.open(session_config("client", [], [endpoint])) as client:
            publisher = client.declare_publisher(key, express=True)
            time.sleep(0.5)

            def put() -> float:
                begin = time.monotonic()
                publisher.put(b'{"linear": [0.3, 0.0], "yaw_rate": 0.1}')
                return arrived.get(timeout=5.0) - begin

            yield put


# Publishing ------------------------------------------------------------------------------------------------------


class _Lying:
    """Stands where the daemon stands; nothing is asked of it but its status, which costs what the daemon's does."""

    def __init__(self, made: Config) -> None:
        policy = load(find_policy(made.control.policy), made.robot.name)
        self._cycle = Cycle(made, policy)
        self._active = PolicyFile(policy, b"")
        self._compute = np.zeros(round(RATE))

    def status(self) -> Status:
        return build_status(self._cycle, self._active, self._compute, {}, {}, {})


def publishing(seconds: float) -> Iterator[Finding]:
    """What ticks cost the loop on their way out, with a monitor that listens; the mean over whole batches."""
    made = config.load(config.find_robot(ROBOT))
    endpoint = free_endpoint()
    made = config.override(made, "bench", {"link.listen": [endpoint]})
    link = Link(made, cast(Doors, _Lying(made)), Path())
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        costs = runner.run(_publish(link, endpoint, round(seconds * RATE)))
    batch = made.link.batch
    whole = costs[: len(costs) // batch * batch].reshape(-1, batch).mean(axis=1)
    note = f"p99 of a batch's mean {1e6 * float(np.percentile(whole, 99)):.1f} µs"
    yield Figure("link", "publishing, a tick", 1e6 * float(np.median(whole)), "µs", 30.0, note=note)


async def _publish(link: Link, endpoint: str, ticks: int) -> np.ndarray:
    row, costs = np.zeros(1, TICK_DTYPE), np.zeros(ticks)
    link.open()
    sender = asyncio.get_running_loop().create_task(link.run())
    with _looking(["monitor", "--json", "--hz", "5"], endpoint) as monitor:
        reading = asyncio.get_running_loop().create_task(asyncio.to_thread(monitor.stdout.readline))
        measured = 0
        while measured < ticks:
            await asyncio.sleep(1.0 / RATE)
            row["index"] += 1
            row["stamp"] = time.monotonic()
            begin = time.perf_counter()
            await _turns()
            bare = time.perf_counter() - begin
            begin = time.perf_counter()
            link.offer(row)
            await _turns()
            if reading.done():
                costs[measured] = time.perf_counter() - begin - bare
                measured += 1
    sender.cancel()
    await asyncio.gather(sender, return_exceptions=True)
    link.close()
    return costs


async def _turns() -> None:
    """Let the sender have its turn: it is woken in one, and sends in the next."""
    await asyncio.sleep(0)
    await asyncio.sleep(0)


# Who looks on ----------------------------------------------------------------------------------------------------


def looked_on(rounds: int) -> Iterator[Finding]:
    """Compute time of a tick with viewer, monitor and a recording being written, or without, in turns in one daemon.

    Then both lookers-on are stopped (SIGSTOP) in the middle of it all: neither ticks nor memory may show it. Turns in
    which the machine's host took processor time do not count, unless it did in all of one kind.
    """
    every: dict[str, list[Window]] = {"off": [], "on": [], "stuck": []}
    grown: list[float] = []
    with walking_daemon(RATE, may_fifo(), round(2 * rounds * (3 * TURN + COME))) as walking:
        for number in shown(range(2 * rounds), "viewer and monitor on or off", 2 * rounds):
            if number % 2:
                every["off"].append(watched(TURN))
            with tempfile.TemporaryDirectory() as folder, _lookers(walking, Path(folder)) as lookers:
                _write_recording(walking.station)
                every["on"].append(watched(TURN))
                for looker in lookers:
                    looker.send_signal(signal.SIGSTOP)
                before = _resident(walking.process)
                every["stuck"].append(watched(TURN))
                grown.append(_resident(walking.process) - before)
                for looker in lookers:
                    looker.send_signal(signal.SIGCONT)
            if not number % 2:
                every["off"].append(watched(TURN))
    whole = walking.read()
    used, word = calm_or_all(every)
    p99 = {name: whole.p99(windows) for name, windows in used.items()}
    for name, words in (("on", "viewer, monitor, recorder"), ("stuck", "both stopped")):
        note = (
            f"{p99['off']:.0f} without, {p99[name]:.0f} µs with, {len(used['off'])} and {len(used[name])} {word} turns"
        )
        yield Figure("link", f"{words}: tick p99", 100.0 * (p99[name] / p99["off"] - 1.0), "%", 5.0, note=note)
    yield Figure("link", "both stopped: the daemon's memory", max(grown), "MB", 20.0, note=f"grown in {TURN:g} s")


def _write_recording(station: Station) -> None:
    """Have one written, without waiting for it."""
    station.session.get(f"{station.keys.recording}?write", lambda _reply: None, timeout=30.0)


@contextlib.contextmanager
def _lookers(walking: Walking, folder: Path) -> Iterator[tuple[Any, Any]]:
    endpoint, drawn = walking.station.endpoint, folder / "seen.rrd"
    with (
        _looking(["monitor", "--json", "--hz", "5"], endpoint) as monitor,
        _looking(["view", "--save", str(drawn)], endpoint) as viewer,
    ):
        monitor.stdout.readline()
        end = time.monotonic() + COME
        while not (drawn.exists() and drawn.stat().st_size) and time.monotonic() < end:
            time.sleep(0.1)
        time.sleep(1.0)
        yield monitor, viewer


@contextlib.contextmanager
def _looking(arguments: list[str], endpoint: str) -> Iterator[Any]:
    command = [sys.executable, "-m", "trotd.cli", *arguments, "--robot", ROBOT, "--connect", endpoint]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


def _resident(process: int) -> float:
    """MB."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") / 1e6
