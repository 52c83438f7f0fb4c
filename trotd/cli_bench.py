"""``trotd bench``."""

from __future__ import annotations

from typing import Annotated

import typer

from trotd.bench.command import Section
from trotd.exits import FAILED


def register(app: typer.Typer) -> None:
    """Put the command beside those of the front door."""
    app.command()(bench)


def bench(
    only: Annotated[list[Section] | None, typer.Option(help="A section; may be given again. All if not given.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Seconds instead of minutes; smaller samples.")] = False,
    json: Annotated[bool, typer.Option("--json", help="The figures as JSON, for machines.")] = False,
) -> None:
    """Measure what docs/performance.md promises, as ratios within one run. Exit code 1 if a bound is missed."""
    from trotd.bench.command import bench as run

    if not run(only or list(Section), quick, json):
        raise typer.Exit(FAILED)
