"""What the matrix showed, for people and for machines."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, TypeVar

import msgspec
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from faults import process
from faults.watch import Outcome
from runtime.failsafe_figures import Worst

SHOWN = 40
"""Violations printed in full."""
SILENCE = 60.0
"""s between two lines of progress where there is no terminal."""


Result = TypeVar("Result")


def shown(outcomes: Iterable[Result], words: str, total: int) -> Iterator[Result]:
    """``outcomes`` behind a progress bar on the error stream, or a line a minute where that is no terminal."""
    console, bad, told = Console(stderr=True), 0, time.monotonic()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(words, total=total)
        for count, outcome in enumerate(outcomes, 1):
            bad += any(bool(getattr(outcome, name, ())) for name in ("violations", "falls"))
            progress.update(task, advance=1, description=f"{words}, {bad} bad")
            if not console.is_terminal and time.monotonic() - told > SILENCE:
                told = time.monotonic()
                sys.stderr.write(f"{count} of {total} {words}, {bad} bad\n")
            yield outcome


def told(outcomes: Iterable[Outcome]) -> Iterator[Outcome]:
    """``outcomes``, each violation said at once: a run that is broken off has told what it found."""
    for outcome in outcomes:
        if outcome.violations:
            sys.stderr.write(f"{describe(outcome)}\n")
        yield outcome


def describe(outcome: Outcome) -> str:
    """A violation in one line, with the command that shows it again."""
    return f"{'; '.join(outcome.violations)} [{outcome.fault}]: {command(outcome)}"


def command(outcome: Outcome) -> str:
    """What shows one fault again."""
    if outcome.body == "process":
        return process.command(outcome.row)
    place = f"--body {outcome.body} --gait {outcome.gait} --row {outcome.row} --seed {outcome.seed}"
    return f"python tests/torture.py {place}"


def group(outcomes: Sequence[Outcome]) -> dict[tuple[str, str], list[Outcome]]:
    """By row and gait."""
    groups: dict[tuple[str, str], list[Outcome]] = {}
    for outcome in outcomes:
        groups.setdefault((outcome.row, outcome.gait), []).append(outcome)
    return groups


def print_outcome(outcome: Outcome) -> None:
    """One fault, whole."""
    sys.stdout.write(msgspec.json.format(msgspec.json.encode(outcome)).decode() + "\n")


def print_json(outcomes: Sequence[Outcome]) -> None:
    sys.stdout.write(msgspec.json.encode(list(outcomes)).decode() + "\n")


def _most(values: Iterable[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{max(known):.3g}" if known else "-"


def print_table(outcomes: Sequence[Outcome]) -> None:
    """One line a row and gait, then every violation with the command that shows it again."""
    table = Table(title="worst of each row", title_justify="left", box=None, padding=(0, 1, 0, 0))
    headings = ("row", "gait", "n", "ends", "evidence", "answer", "N·m", "rad/s", "impact", "fell", "bad")
    for heading in headings:
        table.add_column(heading, justify="left" if heading in ("row", "gait", "ends") else "right")
    for (row, gait), members in group(outcomes).items():
        ends = Counter(outcome.ends for outcome in members).most_common(3)
        bad = sum(bool(outcome.violations) for outcome in members)
        table.add_row(
            row,
            gait,
            str(len(members)),
            ", ".join(f"{end.lower()} {count}" for end, count in ends),
            _most(outcome.evidence for outcome in members),
            _most(outcome.answered for outcome in members),
            _most(outcome.torque for outcome in members),
            _most(outcome.speed for outcome in members),
            _most(outcome.impact for outcome in members),
            str(sum(outcome.fell for outcome in members)),
            f"[red]{bad}[/red]" if bad else "0",
        )
    console = Console(file=sys.stdout)
    if not console.is_terminal:
        console.width = 160
    console.print(table)
    console.print(
        "evidence, answer: latest tick after the injection in which a reading broke a bound, and in which the robot"
        " damped, sat down or stopped; N·m, rad/s: largest torque and joint speed after it; impact: fastest touch of"
        " the ground, m/s"
    )
    failed = [outcome for outcome in outcomes if outcome.violations]
    for outcome in failed[:SHOWN]:
        console.print(describe(outcome), markup=False)
    console.print(f"{len(outcomes)} faults, {len(failed)} with violations", style="bold")


def worst(outcomes: Sequence[Outcome]) -> bytes:
    """The worst of every row, for docs and their checks: JSON."""

    def most(values: Iterable[Any]) -> Any:
        return max((value for value in values if value is not None), default=None)

    rows: dict[str, dict[str, Worst]] = {}
    for (row, gait), members in group(outcomes).items():
        after = [o.answered - o.evidence for o in members if o.answered is not None and o.evidence is not None]
        rows.setdefault(row, {})[gait] = Worst(
            faults=len(members),
            ends=dict(Counter(outcome.ends for outcome in members).most_common()),
            answered_ticks=most(outcome.answered for outcome in members),
            ticks_from_evidence=most(after),
            torque=most(round(outcome.torque, 2) for outcome in members),
            joint_speed=most(round(outcome.speed, 2) for outcome in members),
            impact=most(round(o.impact, 2) for o in members if o.impact is not None),
            falls_before_answer=sum(outcome.fell for outcome in members),
            violations=sum(bool(outcome.violations) for outcome in members),
        )
    return msgspec.json.format(msgspec.json.encode(rows), indent=1) + b"\n"
