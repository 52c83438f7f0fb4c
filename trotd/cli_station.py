"""``trotd view`` and the other commands of the operator's desk: one thin function each."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

ENDPOINT = "tcp/127.0.0.1:7447"

app = typer.Typer(no_args_is_help=True)
RobotOption = Annotated[str, typer.Option("--robot", help="A shipped robot's name or a .toml file.")]
ConnectOption = Annotated[str, typer.Option("--connect", help="Where the daemon listens.")]


@contextlib.contextmanager
def refusals() -> Iterator[None]:
    """What the user can mend, as one line and exit code 1; Ctrl-C as 130."""
    from runtime.config import ConfigError
    from runtime.policies import PolicyError
    from runtime.recorder import RecordingError
    from station.session import StationError

    try:
        yield
    except (ConfigError, PolicyError, RecordingError, StationError) as error:
        typer.echo(f"trotd: {error}", err=True)
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)


@app.command()
def view(
    recording: Annotated[Path | None, typer.Argument(help="A recording; without one, the live robot.")] = None,
    robot: RobotOption = "stoch3",
    connect: ConnectOption = ENDPOINT,
    web: Annotated[bool, typer.Option("--web", help="Serve the viewer to a browser.")] = False,
    web_port: Annotated[int, typer.Option(help="Where the browser finds it.")] = 9090,
    port: Annotated[int, typer.Option(help="Where the viewer takes data.")] = 9876,
    save: Annotated[Path | None, typer.Option("--save", help="Write an .rrd file instead.")] = None,
    memory: Annotated[str, typer.Option(help="The viewer's memory at most.")] = "1GiB",
    seconds: Annotated[float, typer.Option(help="Stop after this time; 0 for never.")] = 0.0,
) -> None:
    """See the robot: body, forces, charts and events, live or from a recording."""
    import time

    from runtime import config
    from station import viewer
    from station.session import connected

    screen = viewer.Screen(save=save, web=web, web_port=web_port, grpc_port=port, memory=memory)
    end = time.monotonic() + seconds if seconds > 0 else float("inf")
    if web:
        typer.echo(f"viewer: http://127.0.0.1:{web_port}  (Ctrl-C ends it)", err=True)
    with refusals():
        if recording is not None:
            viewer.view_recording(recording, screen)
            while web and time.monotonic() < end:
                time.sleep(0.1)
        else:
            known = config.load(config.find_robot(robot))
            with connected(known.robot.name, connect) as station:
                lost = viewer.view_live(station, known.robot, screen, lambda: time.monotonic() < end)
            typer.echo(f"{lost} ticks lost", err=True)


@app.command()
def joystick(
    robot: RobotOption = "stoch3",
    connect: ConnectOption = ENDPOINT,
    keyboard: Annotated[bool, typer.Option("--keyboard", help="The terminal's keys instead of a pad.")] = False,
    pad: Annotated[
        Path | None, typer.Option(help="The pad's event device, instead of the first that is known.")
    ] = None,
    mapping: Annotated[Path | None, typer.Option(help="A TOML that says which code is which stick.")] = None,
    speed: Annotated[float, typer.Option(min=0.05, max=1.0, help="Full sticks, as a share of the bounds.")] = 0.5,
) -> None:
    """Drive with a pad or the keyboard.

    Back damps, Start holds, X sits, Y stands (with the right bumper held it arms first), B walks. Left stick forward
    and turn, right stick sideways; nothing moves unless the right bumper is held.
    """
    from runtime import config
    from station.desk import drive
    from station.session import connected

    with refusals():
        known = config.load(config.find_robot(robot))
        with connected(known.robot.name, connect) as station:
            drive(station, known.control.bounds, keyboard, pad, mapping, speed)


@app.command()
def monitor(
    robot: RobotOption = "stoch3",
    connect: ConnectOption = ENDPOINT,
    json: Annotated[bool, typer.Option("--json", help="A line of JSON each time.")] = False,
    hz: Annotated[float, typer.Option(min=0.1, max=20, help="How often.")] = 2.0,
    count: Annotated[int, typer.Option(help="Stop after so many; 0 for never.")] = 0,
) -> None:
    """Asked against applied, with the reason of every clamp."""
    from itertools import islice

    import msgspec
    import numpy as np
    from rich.console import Console

    from runtime import config
    from station.monitor import draw_table, watch
    from station.session import connected

    with refusals():
        known = config.load(config.find_robot(robot))
        peak = np.array(known.robot.joints.peak_torque)
        screen = Console()
        with connected(known.robot.name, connect) as station:
            for summary in islice(watch(station, peak, hz), count or None):
                if json:
                    typer.echo(msgspec.json.encode(summary).decode())
                    continue
                if screen.is_terminal:
                    screen.clear()
                screen.print("no ticks" if summary is None else draw_table(summary))


@app.command()
def health(
    robot: RobotOption = "stoch3",
    connect: ConnectOption = ENDPOINT,
    json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
    seconds: Annotated[float, typer.Option(min=0.2, help="How long to look.")] = 2.0,
) -> None:
    """Whether the robot is in order. Exit code 0: yes, 1: a warning, 2: no, or nobody answers."""
    import msgspec

    from runtime import config
    from runtime.config import ConfigError
    from station.monitor import Level, examine, gather
    from station.session import StationError, connected

    try:
        known = config.load(config.find_robot(robot))
        with connected(known.robot.name, connect) as station:
            status = station.next_status()
            ticks, lost = gather(station, seconds)
    except (ConfigError, StationError) as error:
        typer.echo(f"trotd: {error}", err=True)
        raise typer.Exit(2) from error
    if len(ticks) < 2:
        typer.echo(f"trotd: robot {known.robot.name!r} sends no ticks", err=True)
        raise typer.Exit(2)
    checks = examine(ticks, status, known, lost)
    if json:
        typer.echo(msgspec.json.encode(checks).decode())
    else:
        for check in checks:
            typer.echo(f"{check.level.name.lower():8} {check.name:12} {check.words}")
    raise typer.Exit(int(max(check.level for check in checks) if checks else Level.OK))


def register(front: typer.Typer) -> None:
    """Put these commands beside those of the front door."""
    front.add_typer(app)


if __name__ == "__main__":
    app()
