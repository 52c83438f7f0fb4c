"""The fault matrix from a shell: ``python tests/torture.py --help``."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from faults.matrix import BY_NAME, ROWS
from faults.process import find, suffer
from faults.report import print_json, print_outcome, print_table, shown, told, worst
from faults.run import BASES, BODIES, GAITS, Case, replay, run_trunk, trunks
from faults.watch import Outcome
from faults.workers import spread

FAILED, BAD_INPUT = 1, 2
WIRE_SHARE = 0.5
"""Seeds on the twin for each one on the simulator: it is five times slower."""


def plan(rows: Sequence[str], seeds: int, first: int, bodies: Sequence[str], brief: bool = False) -> list[Case]:
    """Every row on every body that has it, standing and walking."""
    return [
        Case(body, gait, row.name, first + seed, brief)
        for row in ROWS
        if row.name in rows
        for body in bodies
        if (row.sim if body == "sim" else row.wire) is not None
        for gait in GAITS
        for seed in range(seeds if body == "sim" else max(1, round(seeds * WIRE_SHARE)))
    ]


def pick(count: int) -> list[Case]:
    """``count`` brief faults of one robot: every row, body and gait once, then the simulator's again and again."""
    rows = list(BY_NAME)
    pool = plan(rows, 1, 0, BODIES, True)
    for again in range(1, count):
        pool += plan(rows, 1, again * BASES, ["sim"], True)
    return pool[:count]


def main(
    row: Annotated[list[str] | None, typer.Option(help="A row; may be given again. All if not given.")] = None,
    seed: Annotated[int | None, typer.Option(help="Replay this one seed and say all of it.")] = None,
    seeds: Annotated[int, typer.Option(help="Seeds of each row and gait; the wire twin has half as many.")] = 50,
    first: Annotated[int, typer.Option(help="The first seed.")] = 0,
    sample: Annotated[int | None, typer.Option(help="Only so many, briefly, spread over the whole matrix.")] = None,
    body: Annotated[str | None, typer.Option(help="sim or wire; both if not given.")] = None,
    gait: Annotated[str | None, typer.Option(help="stand or walk, with --seed; both if not given.")] = None,
    jobs: Annotated[int, typer.Option(help="Worker processes.")] = os.cpu_count() or 1,
    json: Annotated[bool, typer.Option("--json", help="Every fault as JSON.")] = False,
    process: Annotated[
        int | None,
        typer.Option(help="Instead of the matrix: faults of the daemon's process (kill, stop, hog, disk), so often."),
    ] = None,
    keep: Annotated[Path | None, typer.Option(help="Write the worst of every row to this file, as JSON.")] = None,
) -> None:
    """Break a simulated robot in every way of the fault matrix, standing and walking; hold what happens to its bounds.

    Exit code 1 if any was violated; each violation is printed with the command that shows it again.
    """
    if process is not None:
        _torture_the_process(row, process, json)
        return
    for name in row or ():
        if name not in BY_NAME:
            typer.echo(f"row {name!r}: not in the matrix; there are {', '.join(BY_NAME)}", err=True)
            raise typer.Exit(BAD_INPUT)
    bodies = [body] if body else list(BODIES)
    if seed is not None:
        bodies = [b for b in bodies if all((BY_NAME[n].sim if b == "sim" else BY_NAME[n].wire) for n in row or BY_NAME)]
        outcomes = [
            replay(Case(b, g, name, seed))
            for name in row or BY_NAME
            for b in bodies
            for g in ([gait] if gait else GAITS)
        ]
        for outcome in outcomes:
            print_outcome(outcome)
    else:
        cases = plan(row or list(BY_NAME), seeds, first, bodies) if sample is None else pick(sample)
        order = {(case.body, case.gait, case.row, case.seed): place for place, case in enumerate(cases)}
        outcomes = []
        try:
            for outcome in told(shown(spread(trunks(cases), run_trunk, jobs), "faults", len(cases))):
                outcomes.append(outcome)
        except KeyboardInterrupt:
            typer.echo(f"broken off after {len(outcomes)} of {len(cases)} faults", err=True)
        outcomes.sort(key=lambda o: order[o.body, o.gait, o.row, o.seed])
        (print_json if json else print_table)(outcomes)
    if keep is not None:
        keep.write_bytes(worst(outcomes))
    if any(outcome.violations for outcome in outcomes):
        raise typer.Exit(FAILED)


def _torture_the_process(rows: list[str] | None, times: int, json: bool) -> None:
    """One after the other, since each is about what the machine does meanwhile; ``rows`` are parts of their names."""
    names = find(rows)
    if not names:
        typer.echo(f"row {', '.join(rows or ())}: in no name of tests/test_process_faults.py", err=True)
        raise typer.Exit(BAD_INPUT)
    outcomes: list[Outcome] = []
    try:
        outcomes.extend(told(shown(suffer(names, times), "faults of the process", times * len(names))))
    except KeyboardInterrupt:
        typer.echo(f"broken off after {len(outcomes)} of {times * len(names)} faults", err=True)
    (print_json if json else print_table)(outcomes)
    if any(outcome.violations for outcome in outcomes):
        raise typer.Exit(FAILED)


if __name__ == "__main__":
    typer.run(main)
    sys.exit(0)
