"""``trotd``: the front door. One thin function a subcommand; each imports only the rooms that it needs.

Exit codes: 0 done, 1 it failed, 2 bad input, 130 Ctrl-C.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trotd import cli_bench, cli_hardware, cli_live, cli_ros2, cli_station, cli_study, cli_training
from trotd.exits import FAILED, one_line_errors

if TYPE_CHECKING:
    from runtime.config import Config
    from runtime.messages.mode import ModeReply

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")  # before numpy loads: small matrices are 80 times slower on two threads


app = typer.Typer(
    name="trotd",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    help="""Runtime service for force-controlled quadrupeds.

**See it walk** (simulated, needs nothing else): `trotd tour`

**Drive it yourself**: `trotd run --body sim` in one terminal, then in another
`trotd arm`, `trotd stand`, `trotd walk`, velocities as JSON on `trotd/<robot>/command/velocity`,
`trotd sit`, and `trotd damp` at any moment.

The daemon never moves the robot by itself: it starts in DAMP and waits to be armed.
Exit codes: 0 done, 1 it failed, 2 bad input, 130 Ctrl-C.""",
)

RobotOption = Annotated[str, typer.Option("--robot", "-r", help="A shipped robot's name, or a .toml file.")]
RateOption = Annotated[float | None, typer.Option("--rate-hz", help="Ticks a second, instead of the robot's own.")]
ConnectOption = Annotated[str, typer.Option("--connect", help="Endpoint of the daemon.", metavar="ENDPOINT")]
StateOption = Annotated[
    Path | None, typer.Option("--state", help="Folder of lock, kept policy and recordings.", file_okay=False)
]
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"


def _load(robot: str, rate_hz: float | None, listen: list[str] | None) -> tuple[Config, Path]:
    from runtime import config

    path = config.find_robot(robot)
    changes: dict[str, object] = {}
    if rate_hz is not None:
        changes["control.rate_hz"] = rate_hz
    if listen:
        changes["link.listen"] = listen
    return config.override(config.load(path), "command line", changes), path


@app.command()
def run(
    robot: RobotOption = "stoch3",
    body: Annotated[
        str,
        typer.Option(help="sim: the simulator. hardware: the robot. twin: its stand-in on wires. null: no physics."),
    ] = "sim",
    observe: Annotated[bool, typer.Option("--observe", help="Energise no motor, whatever is asked.")] = False,
    rate_hz: RateOption = None,
    policy: Annotated[str | None, typer.Option(help="A policy file or a shipped one's name.")] = None,
    listen: Annotated[list[str] | None, typer.Option(help="Endpoint to listen on; may be given again.")] = None,
    folder: StateOption = None,
) -> None:
    """Serve one robot in the foreground until SIGTERM or Ctrl-C; damps it on every way out.

    Example: `trotd run --body sim --robot my.toml --rate-hz 500`
    """
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s", stream=sys.stderr)
    with one_line_errors(), _announced() as started:
        from runtime import daemon, policies
        from runtime.state import state_folder
        from trotd.bodies import build_body, lenient

        config, path = _load(robot, rate_hz, listen)
        policy_path = policies.find_policy(policy or config.control.policy, path.parent)
        chosen = policies.load(policy_path, config.robot.name)
        place = folder or state_folder()
        config = lenient(body, config)
        if body in ("hardware", "twin"):
            from trotd.wire import with_baseline

            config = with_baseline(body, config, place)
        part = build_body(body, config, path, place, observe)
        job = daemon.Job(
            config,
            path.read_text(),
            chosen,
            part.robot,
            place,
            part.channels,
            lambda: _say_ready(started),
            simulated=body != "hardware",
            memory=_memory(place),
            policy_file=policy_path.read_bytes(),
            checks=part.checks,
        )
        for written in daemon.main(job).flight.written:
            typer.echo(f"recording: {written}")


def _memory(state: Path) -> Path | None:
    from runtime.state import memory_folder

    try:
        return memory_folder(state)
    except OSError as error:
        logging.getLogger("trotd").warning("nothing is kept over a crash: %s", error)
        return None


LONG = 2.0
"""s that a start may take before it says that it takes long."""


@contextlib.contextmanager
def _announced() -> Iterator[Callable[[], None]]:
    """Say so when a start takes longer than ``LONG``; what is given ends the wait."""
    words = "starting; the first start after an installation compiles for minutes"
    timer = threading.Timer(LONG, lambda: logging.getLogger("trotd").info(words))
    timer.daemon = True
    timer.start()
    try:
        yield timer.cancel
    finally:
        timer.cancel()


def _say_ready(started: Callable[[], None]) -> None:
    started()
    logging.getLogger("trotd").info("ready: in DAMP, waiting to be armed")


@app.command()
def tour(
    robot: RobotOption = "stoch3",
    rate_hz: RateOption = None,
    json: Annotated[bool, typer.Option("--json", help="The report as JSON, for machines.")] = False,
    policy: Annotated[str | None, typer.Option(help="A policy file or a shipped one's name.")] = None,
    wire: Annotated[
        bool, typer.Option("--wire", help="Over the real drivers, with the wire twin as the body.")
    ] = False,
    folder: StateOption = None,
) -> None:
    """Start a daemon on the simulated body, drive it through everything it can do, and report how well it did.

    Exit code 1 if it fell or missed a bound. Under 90 s.
    """
    with one_line_errors():
        from trotd.tour import take_tour

        config, path = _load(robot, rate_hz, None)
        arguments = ["--robot", str(path), "--rate-hz", str(config.control.rate_hz)]
        arguments += ["--policy", policy] if policy else []
        arguments += ["--state", str(folder)] if folder else []
        if not take_tour(config, arguments, json, wire):
            raise typer.Exit(FAILED)


@app.command()
def status(robot: RobotOption = "stoch3", connect: ConnectOption = DEFAULT_ENDPOINT) -> None:
    """Print the robot's next status as JSON."""
    with one_line_errors():
        import msgspec

        from station.session import connected

        config, _ = _load(robot, None, None)
        with connected(config.robot.name, connect) as station:
            typer.echo(msgspec.json.format(msgspec.json.encode(station.next_status())))


def _ask(word: str, robot: str, connect: str) -> ModeReply:
    from runtime.messages.mode import Request
    from station.requests import request
    from station.session import connected

    config, _ = _load(robot, None, None)
    with connected(config.robot.name, connect) as station:
        return request(station, Request(word))


def _say_reply(reply: ModeReply) -> None:
    typer.echo(f"{reply.mode}: {reply.reason}" if reply.accepted else f"refused in {reply.mode}: {reply.reason}")


def _request(word: str, robot: str, connect: str) -> None:
    with one_line_errors():
        reply = _ask(word, robot, connect)
        _say_reply(reply)
        if not reply.accepted:
            raise typer.Exit(FAILED)


@app.command()
def arm(
    robot: RobotOption = "stoch3",
    connect: ConnectOption = DEFAULT_ENDPOINT,
    json: Annotated[bool, typer.Option("--json", help="The reply with the whole list as JSON.")] = False,
) -> None:
    """Let the robot leave DAMP, if nothing speaks against it: the arming list, each line ok or why not.

    No motor gets torque before every line is ok, and then only through a soft start. Exit code 1 if it was refused.
    """
    with one_line_errors():
        import msgspec

        reply = _ask("arm", robot, connect)
        if json:
            typer.echo(msgspec.json.encode(reply).decode())
        else:
            for check in reply.checks:
                typer.echo(f"{'ok  ' if check.ok else 'NO  '} {check.name:12} {check.words}")
            _say_reply(reply)
        if not reply.accepted:
            raise typer.Exit(FAILED)


@app.command()
def faults(
    robot: RobotOption = "stoch3",
    connect: ConnectOption = DEFAULT_ENDPOINT,
    json: Annotated[bool, typer.Option("--json", help="The history as JSON.")] = False,
    folder: Annotated[
        Path | None, typer.Option("--state", help="Read it from this state folder instead of asking the daemon.")
    ] = None,
) -> None:
    """The history of faults, oldest first: when, what, where, how much, against which bound, and what it led to."""
    with one_line_errors():
        import msgspec

        from runtime.faults import fault_file, load_faults
        from runtime.messages.fault import FaultRecord
        from station.session import connected

        config, _ = _load(robot, None, None)
        if folder is not None:
            history = load_faults(fault_file(folder, config.robot.name))
        else:
            with connected(config.robot.name, connect) as station:
                history = station.ask_for(list[FaultRecord], station.keys.faults)
        if json:
            typer.echo(msgspec.json.encode(history).decode())
            return
        for fault in history:
            typer.echo(f"{fault.time}  tick {fault.tick:>9}  {fault.mode} -> {fault.led_to}: {fault.evidence.words}")
        if not history:
            typer.echo("no fault in memory")


@app.command()
def stand(robot: RobotOption = "stoch3", connect: ConnectOption = DEFAULT_ENDPOINT) -> None:
    """Stand up from DAMP, or stop walking."""
    _request("stand", robot, connect)


@app.command()
def walk(robot: RobotOption = "stoch3", connect: ConnectOption = DEFAULT_ENDPOINT) -> None:
    """Follow velocity commands; stands again when they stop coming."""
    _request("walk", robot, connect)


@app.command()
def sit(robot: RobotOption = "stoch3", connect: ConnectOption = DEFAULT_ENDPOINT) -> None:
    """Sit down and damp."""
    _request("sit", robot, connect)


@app.command()
def damp(robot: RobotOption = "stoch3", connect: ConnectOption = DEFAULT_ENDPOINT) -> None:
    """Damp at once, from anything, and disarm. A standing robot sinks."""
    _request("damp", robot, connect)


@app.command()
def clear(robot: RobotOption = "stoch3", connect: ConnectOption = DEFAULT_ENDPOINT) -> None:
    """Acknowledge a fault, so that the robot can be armed again."""
    _request("clear", robot, connect)


cli_hardware.register(app)
cli_station.register(app)
cli_live.register(app)
cli_ros2.register(app)
cli_training.register(app)
cli_study.register(app)
cli_bench.register(app)


def main() -> None:
    """The console script."""
    app()


if __name__ == "__main__":
    main()
