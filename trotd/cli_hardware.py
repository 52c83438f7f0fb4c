"""``trotd twin``, ``trotd check`` and ``trotd commission``: what one does with a body on wires. One function each."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

FAILED, BAD_INPUT = 1, 2
RobotOption = Annotated[str, typer.Option("--robot", "-r", help="A shipped robot's name, or a .toml file.")]
StateOption = Annotated[Path | None, typer.Option("--state", help="Folder of calibration and lock.", file_okay=False)]
BodyOption = Annotated[str, typer.Option(help="hardware: the robot. twin: its stand-in, which trotd twin starts.")]


def register(app: typer.Typer) -> None:
    """Add the commands of this file to the front door."""
    app.command()(twin)
    app.command()(check)
    app.command()(commission)


@contextlib.contextmanager
def _one_line_errors() -> Iterator[None]:
    """Bad input ends with one line and code 2; what the wires refuse with its report and code 1."""
    from drivers.errors import DriverError
    from runtime.config import ConfigError

    try:
        yield
    except (ConfigError, ImportError, ValueError) as error:
        typer.echo(f"trotd: {error}", err=True)
        raise typer.Exit(FAILED if isinstance(error, DriverError) else BAD_INPUT) from error
    except (DriverError, OSError) as error:
        typer.echo(f"trotd: {error}", err=True)
        raise typer.Exit(FAILED) from error


def twin(
    robot: RobotOption = "stoch3",
    connect: Annotated[str, typer.Option(help="Endpoint of the daemon that drives it.")] = "tcp/127.0.0.1:7447",
    scramble: Annotated[
        int | None, typer.Option(help="Put it together at random by this seed; see commission.")
    ] = None,
    product: Annotated[str, typer.Option(help="Of the IMU: MTI-610 (no orientation), MTI-620, MTI-630.")] = "MTI-630",
    noise: Annotated[bool, typer.Option(help="Sensors as noisy as real ones.")] = True,
    rate_hz: Annotated[float | None, typer.Option(help="The daemon's, where it is not the robot's own.")] = None,
    folder: StateOption = None,
) -> None:
    """Be the robot's body on wires: servos on a CAN bus over UDP, an IMU on a pseudo-terminal, moved by the simulator.

    Then drive it from another terminal with `trotd run --body twin`, or all at once with `trotd tour --wire`.
    """
    with _one_line_errors():
        from runtime import config
        from runtime.state import state_folder
        from trotd.twin import TwinOptions, serve_twin

        if product not in ("MTI-610", "MTI-620", "MTI-630"):
            raise ValueError(f"--product {product}: MTI-610, MTI-620 or MTI-630")
        changes = {} if rate_hz is None else {"control.rate_hz": rate_hz}
        loaded = config.override(config.load(config.find_robot(robot)), "command line", changes)
        serve_twin(loaded, folder or state_folder(), connect, TwinOptions(scramble, product, noise))  # type: ignore[arg-type]


def check(robot: RobotOption = "stoch3", body: BodyOption = "hardware", folder: StateOption = None) -> None:
    """Look at every motor, the IMU, the wires and this computer before anything moves; energises nothing.

    Exit code 1 if anything failed.
    """
    with _one_line_errors():
        import asyncio

        from rich.console import Console

        from runtime import config
        from runtime.state import state_folder
        from trotd import check as pre_flight

        loaded = config.load(config.find_robot(robot))
        rows = asyncio.run(pre_flight.check(body, loaded, folder or state_folder()))
        console = Console()
        if not pre_flight.show(rows, Console(width=max(console.width, 120))):
            raise typer.Exit(FAILED)


def commission(
    robot: RobotOption = "stoch3",
    body: BodyOption = "hardware",
    undo: Annotated[str | None, typer.Option(help="Do a step again: joints, stops or mount.")] = None,
    folder: StateOption = None,
) -> None:
    """Find out how a robot is put together: ids, signs, zeros, the IMU's mount. Energises nothing; can be interrupted.

    People turn the joints, the encoders tell what moved. Writes the calibration that a daemon needs.
    """
    with _one_line_errors():
        from drivers import calibration
        from runtime import config
        from runtime.state import state_folder
        from trotd.commission import STEPS, Commission
        from trotd.commission_wires import CommissionWires
        from trotd.wire import calibration_file, wires_of

        place = folder or state_folder()
        loaded = config.load(config.find_robot(robot))
        wires = wires_of(body, loaded, place)
        path = calibration_file(body, loaded, place)
        with CommissionWires(wires) as readings:
            work = Commission(
                loaded,
                wires.motors,
                path.with_suffix(".progress.json"),
                readings.motors,
                readings.force,
                lambda text: typer.prompt(f"{text}; then Enter", default="", show_default=False) and None,
            )
            if undo is not None:
                steps = [step for step in STEPS if step == undo]
                if not steps:
                    raise ValueError(f"--undo {undo}: {', '.join(STEPS)}")
                work.undo(steps[0])
            calibration.save(work.run(), path)
        work.path.unlink(missing_ok=True)
        typer.echo(f"calibration: {path}")
