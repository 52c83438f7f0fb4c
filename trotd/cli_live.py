"""What changes a robot while it lives: ``trotd push``, ``policies``, ``set`` and ``get``."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from trotd.cli_station import ENDPOINT, ConnectOption, RobotOption
from trotd.exits import UsageError, one_line_errors

if TYPE_CHECKING:
    from station.session import Station

JsonOption = Annotated[bool, typer.Option("--json", help="As JSON, for machines.")]


@contextlib.contextmanager
def _robot(robot: str, connect: str) -> Iterator[Station]:
    from runtime import config
    from station.session import connected

    with one_line_errors():
        known = config.load(config.find_robot(robot))
        with connected(known.robot.name, connect) as station:
            yield station


def push(
    policy: Annotated[str | None, typer.Argument(help="A policy file, or a shipped one's name.")] = None,
    robot: RobotOption = "stoch3",
    connect: ConnectOption = ENDPOINT,
    rollback: Annotated[bool, typer.Option("--rollback", help="Back to the last one that proved good.")] = False,
    immediate: Annotated[
        bool, typer.Option("--immediate", help="No shadow and no waiting, but every check. Simulated bodies only.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Send a policy to the robot, or have it take the one before again; without either, say which is active.

    Example: `trotd push runs/trot-1/trot.json`, `trotd push --rollback`

    A standing or walking robot runs the candidate in shadow for 2 s, takes it over on four feet or where the gait
    changes legs, blends it in over 0.5 s and watches it for 3 s; when tilt, height, clamps or failed solutions rise, it
    returns to the policy before and says why. What has walked so long without that is kept for the next start.

    Exit code 1 when it was refused or given back.
    """
    import msgspec

    from runtime.policies import find_policy
    from runtime.proving import describe
    from station.push import active, roll_back
    from station.push import push as send
    from station.session import StationError

    with _robot(robot, connect) as station:
        if policy is not None and rollback:
            raise UsageError("either a policy or --rollback, not both")
        if policy is None and not rollback:
            current, digest = active(station)
            typer.echo(f"{current.name} {digest[:12]} is active")
            return
        with _told(station):
            reply = send(station, find_policy(policy), immediate) if policy is not None else roll_back(station)
        if json:
            typer.echo(msgspec.json.encode(reply).decode())
        elif reply.report:
            typer.echo(describe(reply.report))
        if not reply.accepted:
            raise StationError(f"refused: {reply.reason}; {reply.name} {reply.sha256[:12]} is active")
        if not json:
            typer.echo(f"{reply.name} {reply.sha256[:12]}: {reply.reason}")


@contextlib.contextmanager
def _told(station: Station) -> Iterator[None]:
    """What the robot tells about policies meanwhile, on the error stream, behind something that turns."""
    from rich.console import Console

    from runtime.messages.event import Event
    from station.ticks import hearing

    console = Console(stderr=True)
    with console.status("waiting for the robot's verdict") as status:

        def tell(event: Event) -> None:
            if event.kind == "policy":
                status.update(event.text)

        with hearing(station, tell):
            yield


def policies(robot: RobotOption = "stoch3", connect: ConnectOption = ENDPOINT, json: JsonOption = False) -> None:
    """List the policies that the robot knows: active, previous (what --rollback takes), good, kept, shipped."""
    import msgspec

    from station.push import known

    with _robot(robot, connect) as station:
        entries = known(station)
        if json:
            typer.echo(msgspec.json.encode(entries).decode())
            return
        for entry in entries:
            typer.echo(f"{entry.role:9} {entry.sha256[:12]}  {entry.name:24} {entry.made}")


def change(
    name: Annotated[str, typer.Argument(help="What to change; trotd get lists the names.")],
    value: Annotated[str, typer.Argument(help="A number, a gait's name, or own for the robot's own.")],
    robot: RobotOption = "stoch3",
    connect: ConnectOption = ENDPOINT,
    save: Annotated[bool, typer.Option("--save", help="For the next start too; own forgets it.")] = False,
) -> None:
    """Change gait, timing, heights, gains or, while it stands, the body's pose; the robot moves there within a second.

    Example: `trotd set swing_height 0.1`, `trotd set gait walk`, `trotd set kp_knee own --save`

    Gone at the next start unless saved. Exit code 1 when the robot refuses; it says the bound.
    """
    from station.session import StationError
    from station.tuning import change as send

    with _robot(robot, connect) as station:
        reply = send(station, name, value, save)
        if not reply.accepted:
            raise StationError(f"refused: {reply.reason}")
        typer.echo(reply.reason)


def get(
    name: Annotated[str | None, typer.Argument(help="One name; all if not given.")] = None,
    robot: RobotOption = "stoch3",
    connect: ConnectOption = ENDPOINT,
    json: JsonOption = False,
) -> None:
    """Show what can be set: the value in force, the robot's own, the bounds, and what is saved."""
    import msgspec

    from station.tuning import describe, known

    with _robot(robot, connect) as station:
        entries = [entry for entry in known(station) if name in (None, entry.name)]
        if not entries:
            raise UsageError(f"{name!r} cannot be set; trotd get lists what can")
        typer.echo(msgspec.json.encode(entries).decode() if json else "\n".join(describe(entry) for entry in entries))


def register(front: typer.Typer) -> None:
    """Put these commands beside those of the front door."""
    front.command()(push)
    front.command()(policies)
    front.command("set")(change)
    front.command()(get)
