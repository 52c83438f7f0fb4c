"""What a benchmark found, figure by figure, for people and for machines; and the bars that show it at work."""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar

import msgspec
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Figure:
    """One number, and the bound that it is held to, if any."""

    section: str
    name: str
    value: float
    unit: str = ""
    bound: float | None = None
    sense: Literal["<=", ">="] = "<="
    note: str = ""

    @property
    def met(self) -> bool | None:
        """Whether the bound holds; None without one."""
        if self.bound is None:
            return None
        return self.value <= self.bound if self.sense == "<=" else self.value >= self.bound


@dataclass(frozen=True, slots=True)
class Missing:
    """What could not be measured here, and why."""

    section: str
    name: str
    why: str


Finding = Figure | Missing


def machine() -> str:
    """Processor, cores, kernel and Python in one line."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line.partition(":")[2].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = f"{len(names)} x {names[0]}" if names else model
    return f"{model}, Linux {platform.release()}, Python {platform.python_version()}"


def shown(items: Iterable[Item], words: str, total: int) -> Iterable[Item]:
    """``items`` behind a progress bar on the error stream; nothing is drawn where that is not a terminal."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield from items
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(words, total=total)
        for item in items:
            yield item
            progress.advance(task)


def print_table(findings: Sequence[Finding]) -> None:
    """One row a figure."""
    table = Table(title=machine(), title_justify="left")
    for heading, justify in (("", "left"), ("", "left"), ("measured", "right"), ("bound", "right"), ("", "left")):
        table.add_column(heading, justify=justify)  # type: ignore[arg-type]
    for finding in findings:
        if isinstance(finding, Missing):
            table.add_row(finding.section, finding.name, "-", "", finding.why)
            continue
        bound = "" if finding.bound is None else f"{finding.sense} {finding.bound:g}"
        mark = {None: "", True: "[green]met[/green]", False: "[red]missed[/red]"}[finding.met]
        value = f"{finding.value:.4g} {finding.unit}".strip()
        table.add_row(finding.section, finding.name, value, bound, " ".join(filter(None, (mark, finding.note))))
    console = Console(file=sys.stdout)
    if not console.is_terminal:
        console.width = 160
    console.print(table)


def print_json(findings: Sequence[Finding]) -> None:
    """The same for machines."""
    rows = [
        {"section": f.section, "name": f.name, "missing": f.why}
        if isinstance(f, Missing)
        else {**{key: getattr(f, key) for key in f.__slots__}, "met": f.met}
        for f in findings
    ]
    sys.stdout.write(msgspec.json.encode({"machine": machine(), "figures": rows}).decode() + "\n")
