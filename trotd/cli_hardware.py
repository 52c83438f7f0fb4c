"""``trotd twin``, ``trotd check`` and ``trotd commission``: what one does with a body on wires. One function each."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trotd.exits import FAILED, one_line_errors

RobotOption = Annotated[str, typer.Option("--robot", "-r", help="A shipped robot's name, or a .toml file.")]
StateOption = Annotated[Path | None, typer.Option("--state", help="Folder of calibration and lock.", file_okay=False)]
BodyOption = Annotated[str, typer.Option(help="hardware: the robot. twin: its stand-in, which trotd twin starts.")]


def register(app: typer.Typer) -> None:
    """Add the commands of this file to the front door."""
    app.command()(twin)
    app.command()(check)
    app.command()(commission)


def twin(
    robot: RobotOption = "stoch3",
    connect: Annotated[str, typer.Option(help="Endpoint of the daemon that drives it.")] = "tcp/127.0.0.1:7447",
    scramble: Annotated[
        int | None, typer.Option(help="Put it together at random by this seed; see commission.")
    ] = None,
    product: Annotated[str, typer.Option(help="Of the IMU: MTI-610 (no orientation), MTI-620, MTI-630.")] = "MTI-630",
    noise: Annotated[bool, typer.Option(help="Sensors as noisy as real ones.")] = True,
    patience: Annotated[
        float,
        typer.Option(min=0.0, max=10.0, help="s that its time stands still for a daemon that is held up."),
    ] = 0.8,
    rate_hz: Annotated[float | None, typer.Option(help="The daemon's, where it is not the robot's own.")] = None,
    folder: StateOption = None,
) -> None:
    """Be the robot's body on wires: servos on a CAN bus over UDP, an IMU on a pseudo-terminal, moved by the simulator.

    Then drive it from another terminal with `trotd run --body twin`, or all at once with `trotd tour --wire`.
    """
    with one_line_errors():
        from runtime import config
        from runtime.state import state_folder
        from trotd.twin import TwinOptions, serve_twin

        if product not in ("MTI-610", "MTI-620", "MTI-630"):
            raise ValueError(f"--product {product}: MTI-610, MTI-620 or MTI-630")
        changes = {} if rate_hz is None else {"control.rate_hz": rate_hz}
        loaded = config.override(config.load(config.find_robot(robot)), "command line", changes)
        serve_twin(loaded, folder or state_folder(), connect, TwinOptions(scramble, product, noise, patience))  # type: ignore[arg-type]


def check(
    robot: RobotOption = "stoch3",
    body: BodyOption = "hardware",
    folder: StateOption = None,
    json: Annotated[bool, typer.Option("--json", help="The rows as JSON, for machines.")] = False,
) -> None:
    """Look at every motor, the IMU, the wires and this computer before anything moves; energises nothing.

    Exit code 1 if anything failed; warnings alone are 0.
    """
    with one_line_errors():
        import asyncio

        from rich.console import Console

        from runtime import config
        from runtime.state import state_folder
        from trotd.check import command as pre_flight
        from trotd.check.rows import passed, print_json, print_table

        loaded = config.load(config.find_robot(robot))
        with Console(stderr=True).status("asking motors, IMU and kernel"):
            rows = asyncio.run(pre_flight.check(body, loaded, folder or state_folder()))
        console = Console()
        if json:
            print_json(rows)
        else:
            print_table(rows, Console(width=max(console.width, 120)))
        if not passed(rows):
            raise typer.Exit(FAILED)


def commission(
    robot: RobotOption = "stoch3",
    body: BodyOption = "hardware",
    wiggle: Annotated[
        bool, typer.Option("--wiggle", help="Motors turn a little by their own power; you say what moved.")
    ] = False,
    jig: Annotated[
        str | None,
        typer.Option(help="Zeros from a jig that holds all legs at abduction,hip,knee, rad; else from end stops."),
    ] = None,
    undo: Annotated[str | None, typer.Option(help="Forget a step: joints, zeros, mount or baseline.")] = None,
    anew: Annotated[bool, typer.Option("--anew", help="Forget all that was found.")] = False,
    baseline: Annotated[
        bool, typer.Option("--baseline", help="Last step: the robot stands under its daemon; listen to its legs.")
    ] = False,
    rehearse: Annotated[
        bool, typer.Option("--rehearse", help="With --body twin: the twin's own hands do what is asked.")
    ] = False,
    connect: Annotated[str, typer.Option(help="Endpoint of the daemon.", metavar="ENDPOINT")] = "tcp/127.0.0.1:7447",
    folder: StateOption = None,
) -> None:
    """Find out how a robot is put together: ids, signs, zeros, the IMU's mount. Writes its calibration.

    Can be interrupted and goes on where it was. Energises nothing, unless --wiggle says so. By hand: people turn
    the joints, the encoders tell what moved. A daemon does not start without a calibration that is valid for its robot.

    Afterwards, with the robot standing under `trotd run`: `trotd commission --baseline`, and start the daemon anew.
    """
    with one_line_errors():
        from runtime import config
        from runtime.state import state_folder
        from trotd.commission import command

        place = folder or state_folder()
        choices = command.Choices(body, wiggle, jig, undo, anew, rehearse, connect)
        loaded = config.load(config.find_robot(robot))
        act = command.listen_to_legs if baseline else command.commission
        act(loaded, place, choices, typer.echo)
