"""Long runs from a shell: ``python tests/soak.py --help``."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path
from typing import Annotated

import msgspec
import typer
from faults.report import shown
from faults.shift import Shift, share, work
from faults.wander import Wandering, wander
from faults.workers import spread
from rich.console import Console
from rich.table import Table
from rich.text import Text

FAILED = 1
GROWTH = 5.0
"""MiB that the daemon's memory may grow by."""
app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
JsonOption = Annotated[bool, typer.Option("--json", help="The report as JSON.")]


def _print_json(report: object) -> None:
    sys.stdout.write(msgspec.json.encode(report).decode() + "\n")


@app.command()
def daemon(
    minutes: Annotated[float, typer.Option(help="How long it walks.")] = 60.0,
    robot: Annotated[str, typer.Option(help="A shipped robot or a .toml file.")] = "stoch3",
    wire: Annotated[bool, typer.Option("--wire", help="On the wire twin, over its buses and its IMU's line.")] = False,
    watched: Annotated[bool, typer.Option("--watched/--alone", help="With monitor and viewer, or without.")] = True,
    rate_hz: Annotated[float, typer.Option(help="Ticks a second.")] = 200.0,
    json: JsonOption = False,
) -> None:
    """The daemon walks on the simulator or its wire twin in real time: a joystick drives, a monitor and a viewer watch.

    Its memory may grow by 5 MiB; it may not fall, nor leave the walk unasked. Missed ticks are counted, so are halts
    because the loop came too late, after which it walks on: on a busy machine they say more about the machine.
    """
    console = Console(stderr=True)
    with console.status("starting the daemon") as line:

        def show(words: str) -> None:
            line.update(Text(words, no_wrap=True, overflow="ellipsis"))

        shift = work(minutes, robot, "twin" if wire else "sim", rate_hz, watched, show)
    problems = shift.problems(GROWTH)
    if json:
        _print_json({"shift": shift, "problems": problems})
    else:
        _print_shift(shift, problems)
    if problems:
        raise typer.Exit(FAILED)


def _print_shift(shift: Shift, problems: list[str]) -> None:
    table = Table(box=None, show_header=False, padding=(0, 1, 0, 0))
    for name, value in (
        ("walked", f"{shift.minutes:g} min, {shift.distance:.0f} m"),
        ("ticks", f"{shift.ticks}, missed {shift.missed} ({100 * share(shift.missed, shift.ticks):.2f} %)"),
        (
            "calm",
            f"{shift.calm} of them while the host took no time, missed {shift.calm_missed}"
            f" ({100 * share(shift.calm_missed, shift.calm):.2f} %)",
        ),
        ("wires", ", ".join(f"{count} {name}" for name, count in shift.wires.items()) or "nothing lost, nothing late"),
        ("memory", f"{shift.resident:.1f} MiB, grew by {shift.growth:.2f}, bound {GROWTH:g}"),
        ("halts", f"{len(shift.halts)} because the loop came late {', '.join(shift.halts)}"),
        ("falls", str(shift.falls)),
    ):
        table.add_row(name, value)
    console = Console(file=sys.stdout)
    console.print(table)
    for problem in problems:
        console.print(f"problem: {problem}", style="red", markup=False)
    console.print("FAILED" if problems else "passed", style="bold")


@app.command()
def sim(
    hours: Annotated[float, typer.Option(help="Simulated hours in all.")] = 24.0,
    episode: Annotated[float, typer.Option(help="Simulated minutes of one robot.")] = 5.0,
    first: Annotated[int, typer.Option(help="The first seed.")] = 0,
    jobs: Annotated[int, typer.Option(help="Worker processes.")] = os.cpu_count() or 1,
    keep: Annotated[
        Path | None, typer.Option(help="Add each episode to this file, a line each; those that it has are not run.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Simulated hours of random commands and pushes of a size that must be borne, stops, sits and starts; free-running.

    A fall is printed with its seed and what had happened before; ``sim --first SEED --hours 0.08`` shows it again.
    """
    seeds = range(first, first + max(1, round(60.0 * hours / episode)))
    results = [one for one in _kept(keep) if one.seed in seeds and one.seconds == 60.0 * episode]
    items = [(seed, 60.0 * episode) for seed in seeds if seed not in {one.seed for one in results}]
    with keep.open("ab") if keep is not None else contextlib.nullcontext() as file:
        try:
            for result in shown(spread(items, wander, jobs), "episodes", len(items)):
                results.append(result)
                if file is not None:
                    file.write(msgspec.json.encode(result) + b"\n")
                    file.flush()
        except KeyboardInterrupt:
            typer.echo(f"broken off after {len(results)} of {len(seeds)} episodes", err=True)
    failed = [result for result in results if result.falls or result.not_finite or result.over_limit]
    if json:
        _print_json(results)
    else:
        _print_hours(results, failed)
    if failed or len(results) < len(seeds):
        raise typer.Exit(FAILED)


def _kept(path: Path | None) -> list[Wandering]:
    """Episodes of earlier runs; none where there is no such file."""
    if path is None or not path.exists():
        return []
    return [msgspec.json.decode(line, type=Wandering) for line in path.read_bytes().splitlines()]


def _print_hours(results: list[Wandering], failed: list[Wandering]) -> None:
    console = Console(file=sys.stdout, soft_wrap=True)
    faults: dict[str, int] = {}
    for result in results:
        for name, number in result.faults.items():
            faults[name] = faults.get(name, 0) + number
    console.print(
        f"{sum(r.seconds for r in results) / 3600:.2f} simulated hours, {sum(r.distance for r in results):.0f} m,"
        f" {sum(r.commands for r in results)} commands, {sum(r.pushes for r in results)} pushes,"
        f" {sum(r.sits for r in results)} times down and up"
    )
    console.print(
        f"falls {sum(len(r.falls) for r in results)} · commands not finite {sum(r.not_finite for r in results)}"
        f" · past the torque limit {sum(r.over_limit for r in results)}"
        f" · largest torque {max((r.torque for r in results), default=0.0):.1f} N·m"
    )
    console.print(f"other ends in damp: {faults or 'none'}")
    for result in failed:
        for fall in result.falls:
            console.print(f"seed {result.seed}: {fall}", markup=False)
    console.print("FAILED" if failed else "nothing failed", style="bold")


if __name__ == "__main__":
    app()
