"""``trotd view`` and the other commands of the operator's desk: one thin function each."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from trotd.exits import UsageError, one_line_errors

ENDPOINT = "tcp/127.0.0.1:7447"

app = typer.Typer(no_args_is_help=True)
RobotOption = Annotated[str, typer.Option("--robot", help="A shipped robot's name or a .toml file.")]
ConnectOption = Annotated[str, typer.Option("--connect", help="Where the daemon listens.")]


@app.command()
def view(
    recording: Annotated[Path | None, typer.Argument(help="A recording; without one, the live robot.")] = None,
    robot: RobotOption = "stoch3",
    connect: ConnectOption = ENDPOINT,
    web: Annotated[bool, typer.Option("--web", help="To a browser; rerun listens on all interfaces.")] = False,
    web_port: Annotated[int, typer.Option(help="Where the browser finds it.")] = 9090,
    port: Annotated[int, typer.Option(help="Where the viewer takes data.")] = 9876,
    save: Annotated[Path | None, typer.Option("--save", help="Write an .rrd file instead.")] = None,
    memory: Annotated[str, typer.Option(help="The viewer's memory at most.")] = "1GiB",
    seconds: Annotated[float, typer.Option(help="Stop after this time; 0 for never.")] = 0.0,
) -> None:
    """See the robot: body, forces, charts and events, live or from a recording.

    Opens a window; `--web` serves a browser instead, and `--save` writes a file for `rerun` on another machine.

    Example: `trotd view`, `trotd view --web`, `trotd view crash.trotd --save crash.rrd`
    """
    import time

    from runtime import config
    from station import viewer
    from station.session import connected

    end = time.monotonic() + seconds if seconds > 0 else float("inf")
    with one_line_errors():
        screen = viewer.Screen(save=save, web=web, web_port=web_port, grpc_port=port, memory=memory)
        if web:
            typer.echo(f"viewer: {screen.address}  (Ctrl-C ends it)", err=True)
        if recording is not None:
            drawn = viewer.view_recording(recording, screen)
            while web and time.monotonic() < end:
                time.sleep(0.1)
            drawn.disconnect()
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
    and turn, right stick sideways; nothing moves unless the right bumper is held. A: the sticks lean the standing body.
    Left bumper: the next gait. Ctrl-C leaves, and a walking robot stands.

    Example: `trotd joystick --keyboard`, `trotd joystick --speed 1 --pad /dev/input/event5`
    """
    from runtime import config
    from station.desk import drive
    from station.session import connected

    with one_line_errors():
        if keyboard and not sys.stdin.isatty():
            raise UsageError("--keyboard reads a terminal's keys, and this is none")
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
    """Asked against applied, with the reason of every clamp, and what happened lately. Ctrl-C ends it.

    Example: `trotd monitor`, `trotd monitor --json --hz 10 --count 100 > walk.jsonl`
    """
    from collections import deque
    from itertools import islice

    import msgspec
    import numpy as np
    from rich.console import Console

    from runtime import config
    from runtime.messages.event import Event
    from station.monitor import draw_table, watch
    from station.session import connected

    with one_line_errors():
        known = config.load(config.find_robot(robot))
        peak = np.array(known.robot.joints.peak_torque)
        screen = Console()
        lately: deque[Event] = deque(maxlen=8)
        with connected(known.robot.name, connect) as station:
            for summary in islice(watch(station, peak, hz), count or None):
                lately.extend(summary.events if summary is not None else ())
                if json:
                    typer.echo(msgspec.json.encode(summary).decode())
                    continue
                if screen.is_terminal:
                    screen.clear()
                screen.print("no ticks" if summary is None else draw_table(summary, lately))


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


@app.command()
def recordings(
    name: Annotated[str | None, typer.Argument(help="Fetch this one; without it, list them.")] = None,
    robot: RobotOption = "stoch3",
    connect: ConnectOption = ENDPOINT,
    write: Annotated[bool, typer.Option("--write", help="Write what the recorder holds now, first.")] = False,
    to: Annotated[Path, typer.Option("--to", help="Folder to fetch into.", file_okay=False)] = Path(),
) -> None:
    """List the robot's recordings, or fetch one over the link.

    Example: `trotd recordings --write`, then `trotd recordings NAME --to .` with a name of the list
    """
    from runtime import config
    from runtime.messages.recording import RecordingEntry, RecordingReply
    from station.session import StationError, connected

    with one_line_errors():
        known = config.load(config.find_robot(robot))
        with connected(known.robot.name, connect) as station:
            key = station.keys.recording
            if write:
                reply = station.ask_for(RecordingReply, key, parameters="write")
                if not reply.accepted:
                    raise StationError(f"robot {known.robot.name!r}: {reply.reason}")
                typer.echo(f"written on the robot: {reply.path}")
            if name is not None:
                to.mkdir(parents=True, exist_ok=True)
                path = to / Path(name).name
                path.write_bytes(station.ask(key, parameters=f"name={name}", timeout=60.0))
                typer.echo(f"fetched: {path} ({path.stat().st_size} bytes)")
            elif not write:
                for entry in station.ask_for(list[RecordingEntry], key):
                    typer.echo(f"{entry.name}  {entry.size / 1e6:.1f} MB")


@app.command()
def replay(
    recording: Annotated[Path, typer.Argument(help="A .trotd file.", exists=True, dir_okay=False)],
    policy: Annotated[Path | None, typer.Option(help="Ask what this policy would have done.", exists=True)] = None,
) -> None:
    """Run a recording through the core again: bit for bit the same, or the first tick and stage that differ.

    Exit code 1 where it differs. With --policy: how far another policy's commands would have been from those then.
    """
    import time

    from rich.console import Console

    from runtime import policies
    from runtime.recording import load
    from runtime.replay import Player, compare_policy
    from runtime.replay import replay as play

    with one_line_errors():
        loaded = load(recording)
        if policy is not None:
            other = compare_policy(loaded, policies.load(policy, loaded.header.robot))
            typer.echo(f"{other.ticks} walking ticks under {policy.name}, differences as root mean squares:")
            typer.echo(f"  shifts {other.shift * 1e3:.1f} mm, force {other.force:.1f} N, moment {other.moment:.1f} N·m")
            typer.echo(f"  feed-forward torque {other.torque:.2f} N·m")
            typer.echo(f"  ticks with a clamp {other.clamped_before:.1%} then, {other.clamped_now:.1%} now")
            return
        with Console(stderr=True).status("replaying"):
            next(Player(loaded).play(), None)  # compiled code is loaded before the clock runs
            began = time.perf_counter()
            result = play(loaded)
            speed = result.ticks / loaded.header.rate_hz / (time.perf_counter() - began)
        modes = ", ".join(f"{name} {count}" for name, count in result.modes.items())
        typer.echo(
            f"{result.ticks} ticks ({modes}), {result.skipped} before the first keyframe, {speed:.0f} x real time"
        )
        if result.difference is not None:
            typer.echo(f"differs: {result.difference}")
            typer.echo(f"recorded with {', '.join(f'{k} {v}' for k, v in result.versions.items())}")
            raise typer.Exit(1)
        typer.echo("bit for bit the same")


@app.command()
def export(
    recording: Annotated[Path, typer.Argument(help="A .trotd file.", exists=True, dir_okay=False)],
    csv: Annotated[Path | None, typer.Option("--csv", help="Every number of every tick.")] = None,
    mcap: Annotated[Path | None, typer.Option("--mcap", help="ROS 2 messages, for Foxglove.")] = None,
    rrd: Annotated[Path | None, typer.Option("--rrd", help="For rerun.")] = None,
) -> None:
    """Write a recording as CSV, MCAP or RRD; several at once if asked for.

    Example: `trotd export walk.trotd --csv walk.csv --mcap walk.mcap`
    """
    from rich.console import Console

    from runtime.recording import load
    from station.export import EXPORTS

    with one_line_errors():
        wanted = {kind: path for kind, path in (("csv", csv), ("mcap", mcap), ("rrd", rrd)) if path is not None}
        if not wanted:
            raise UsageError("name at least one of --csv FILE, --mcap FILE, --rrd FILE")
        loaded = load(recording)
        for kind, path in wanted.items():
            with Console(stderr=True).status(f"writing {path}"):
                EXPORTS[kind](loaded, path)
            typer.echo(f"{path}: {path.stat().st_size} bytes")


keys_app = typer.Typer(no_args_is_help=True, help="Certificates: who may see, drive or teach a robot.")
app.add_typer(keys_app, name="keys")
AuthorityOption = Annotated[Path, typer.Option("--authority", help="Folder of the authority.", file_okay=False)]
AUTHORITY = Path("trotd-keys")


@keys_app.command("init")
def init_keys(authority: AuthorityOption = AUTHORITY) -> None:
    """Make a private certificate authority. Keep its folder off the robot."""
    from station.keys import make_authority

    with one_line_errors():
        make_authority(authority)
        typer.echo(f"{authority}: the authority; its ca-key.pem leaves this machine never")


@keys_app.command("add")
def add_key(
    role: Annotated[str, typer.Argument(help="robot, viewer, operator or trainer.")],
    name: Annotated[str, typer.Argument(help="Who bears it.")],
    host: Annotated[list[str] | None, typer.Option(help="A robot's name or address; may be given again.")] = None,
    authority: AuthorityOption = AUTHORITY,
) -> None:
    """Make a certificate: for the robot, or for a person who sees, drives or teaches it."""
    from runtime.access import Role
    from station.keys import add_bearer

    with one_line_errors():
        if role not in list(Role):
            raise UsageError(f"role {role!r}: must be one of {', '.join(Role)}")
        folder = add_bearer(authority, Role(role), name, tuple(host or ()))
        typer.echo(f"{folder}: copy its three files to the bearer")
        use = "link.certificates in the robot's TOML names it" if role == Role.ROBOT else "TROTD_CERTIFICATES names it"
        typer.echo(f"  {use}")


def register(front: typer.Typer) -> None:
    """Put these commands beside those of the front door."""
    front.add_typer(app)


if __name__ == "__main__":
    app()
