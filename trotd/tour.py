"""``trotd tour``: the daemon in a child process, the client in this one, the report on the screen."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO

import msgspec
from rich.console import Console
from rich.status import Status as Line
from rich.table import Table
from rich.text import Text

from runtime.config import Config
from runtime.messages.status import Status
from station.session import Station, StationError, connected, free_endpoint
from station.tour import Tour, TourReport
from trotd.exits import BAD_INPUT
from trotd.wire import MEETING, twin_folder

START_TIMEOUT = 180.0
"""s; the first start of all compiles the core."""
STOP_TIMEOUT = 15.0


class DaemonFailed(StationError):
    """The child process did not start, or did not end, as it should."""


class DaemonRefused(DaemonFailed, ValueError):
    """The child process did not like its input."""


def take_tour(config: Config, arguments: Sequence[str], as_json: bool, wire: bool = False) -> bool:
    """Start the daemon with ``arguments``, drive it, print the report; whether it passed.

    With ``wire`` the body is the wire twin, in a process of its own, behind the drivers of the real robot.

    Raises:
        StationError: the daemon does not start.
    """
    console = Console(stderr=as_json)
    endpoint = free_endpoint()
    with contextlib.ExitStack() as stack:
        body = "sim"
        if wire:
            body, arguments = "twin", stack.enter_context(running_twin(config.robot.name, endpoint, arguments))
        output = stack.enter_context(tempfile.TemporaryFile("w+"))
        line = stack.enter_context(console.status("starting the daemon"))
        child = subprocess.Popen(
            [sys.executable, "-m", "trotd.cli", "run", "--body", body, "--listen", endpoint, *arguments],
            stdout=output,
            stderr=subprocess.STDOUT,
        )
        try:
            with (
                _reach(config.robot.name, endpoint, child, output) as station,
                Tour(station, config, _shown(line)) as tour,
            ):
                report = tour.drive()
            report = _stopped(child, output, report)
        finally:
            if child.poll() is None:
                child.kill()
            child.wait()
    if as_json:
        sys.stdout.write(msgspec.json.encode(report).decode() + "\n")
    else:
        _print(console, report)
    return report.passed


@contextlib.contextmanager
def running_twin(robot: str, endpoint: str, arguments: Sequence[str]) -> Iterator[list[str]]:
    """A running twin for a daemon with ``arguments``, among them --robot and --rate-hz; those, with the state folder
    that both share.

    Raises:
        DaemonFailed: it does not start.
    """
    arguments = list(arguments)
    with contextlib.ExitStack() as stack:
        if "--state" not in arguments:
            arguments += ["--state", stack.enter_context(tempfile.TemporaryDirectory(prefix="trotd-"))]
        folder = arguments[arguments.index("--state") + 1]
        place = twin_folder(Path(folder), robot) / MEETING
        output = stack.enter_context(tempfile.TemporaryFile("w+"))
        toml = arguments[arguments.index("--robot") + 1]
        command = [sys.executable, "-m", "trotd.cli", "twin", "--robot", toml, "--state", folder, "--connect", endpoint]
        command += ["--rate-hz", arguments[arguments.index("--rate-hz") + 1]]
        child = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
        try:
            end = time.monotonic() + START_TIMEOUT
            while not place.exists():
                if child.poll() is not None or time.monotonic() > end:
                    raise DaemonFailed(f"the twin did not start: {_last_line(output)}")
                time.sleep(0.1)
            yield arguments
        finally:
            child.terminate()
            try:
                child.wait(STOP_TIMEOUT)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()


@contextlib.contextmanager
def _reach(robot: str, endpoint: str, child: subprocess.Popen[bytes], output: IO[str]) -> Iterator[Station]:
    end = time.monotonic() + START_TIMEOUT
    with contextlib.ExitStack() as stack:
        while True:
            if child.poll() is not None:
                kind = DaemonRefused if child.returncode == BAD_INPUT else DaemonFailed
                raise kind(f"the daemon did not start: {_last_line(output)}")
            attempt = contextlib.ExitStack()
            try:
                station = attempt.enter_context(connected(robot, endpoint))
                station.ask(station.keys.tick_schema)  # it listens before it has compiled what it answers with
                stack.push(attempt)
                break
            except StationError:
                attempt.close()
                if time.monotonic() > end:
                    raise
                time.sleep(0.2)
        yield station


def _shown(line: Line) -> Callable[[Status | None, str], None]:
    """Writes the status line; the way from the daemon is a status message ten times a second."""

    def show(status: Status | None, activity: str) -> None:
        if status is None:
            return
        wanted, measured = status.velocity_command, status.velocity
        text = (
            f"{activity} · {status.mode} · {_triple(wanted)} → {_triple(measured)}"
            f" · {status.tick_p50 * 1e3:.1f}/{status.tick_p99 * 1e3:.1f} ms · late {status.overruns}"
        )
        line.update(Text(text, no_wrap=True, overflow="ellipsis"))

    return show


def _stopped(child: subprocess.Popen[bytes], output: IO[str], report: TourReport) -> TourReport:
    """Stop the daemon and take the recording's place from its last words."""
    problems = list(report.problems)
    child.send_signal(signal.SIGTERM)
    try:
        code = child.wait(STOP_TIMEOUT)
        if code:
            problems.append(f"the daemon ended with code {code}: {_last_line(output)}")
    except subprocess.TimeoutExpired:
        problems.append(f"the daemon did not stop within {STOP_TIMEOUT:g} s")
    output.seek(0)
    recordings = [line.partition(": ")[2].strip() for line in output if line.startswith("recording: ")]
    return msgspec.structs.replace(
        report,
        problems=problems,
        passed=report.passed and not problems,
        recording=recordings[-1] if recordings else "",
    )


def _last_line(output: IO[str]) -> str:
    output.seek(0)
    lines = [line.strip() for line in output if line.strip()]
    return lines[-1].removeprefix("trotd: ") if lines else "no word from it"


def _print(console: Console, report: TourReport) -> None:
    table = Table(title=f"{report.robot} at {report.rate_hz:g} Hz", box=None, padding=(0, 1, 0, 0))
    for name in ("leg", "commanded", "measured", "RMSE", "roll", "pitch", "est.", ""):
        table.add_column(name, no_wrap=name != "", justify="left" if name in ("leg", "") else "right")
    for leg in report.legs:
        table.add_row(
            leg.name,
            _triple(leg.commanded),
            _triple(leg.measured),
            f"{leg.rmse:.3f}",
            f"{leg.roll:.2f}",
            f"{leg.pitch:.2f}",
            f"{leg.estimator_rmse:.3f}",
            "; ".join(leg.problems) or "ok",
        )
    console.print(table)
    console.print(
        "vx, vy m/s and yaw rate rad/s, the simulator's truth; RMSE after 1 s, m/s; worst roll and pitch, rad;"
        " est.: the estimator's error, m/s"
    )
    for problem in report.problems:
        console.print(f"problem: {problem}", style="red", markup=False)
    if report.legs:
        median = sorted(leg.tick_p50 for leg in report.legs)[len(report.legs) // 2]
        worst = max(leg.tick_p99 for leg in report.legs)
        console.print(
            f"falls {sum(leg.falls for leg in report.legs)} · tick p50 {median * 1e3:.2f} ms, p99 {worst * 1e3:.2f} ms"
            f" · overruns {sum(leg.overruns for leg in report.legs)}"
        )
    console.print(f"recording: {report.recording}", soft_wrap=True)
    console.print(f"{'passed' if report.passed else 'FAILED'} in {report.seconds:.0f} s", style="bold")


def _triple(values: Sequence[float]) -> str:
    return " ".join(f"{value:.2f}" for value in values)
