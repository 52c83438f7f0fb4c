"""What the pre-flight found, for people and for machines."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import msgspec
from rich.console import Console
from rich.table import Table

Verdict = Literal["ok", "warn", "fail"]
_COLOURS = {"ok": "green", "warn": "yellow", "fail": "red"}


@dataclass(frozen=True, slots=True)
class Row:
    """One thing that was looked at."""

    what: str
    verdict: Verdict
    found: str
    advice: str = ""


def passed(rows: Sequence[Row]) -> bool:
    """Whether nothing failed."""
    return all(row.verdict != "fail" for row in rows)


def print_table(rows: Sequence[Row], console: Console) -> None:
    """One line a row."""
    table = Table("", "what", "found", "what to do")
    for row in rows:
        colour = _COLOURS[row.verdict]
        table.add_row(f"[{colour}]{row.verdict}[/{colour}]", row.what, row.found, row.advice)
    console.print(table)


def print_json(rows: Sequence[Row]) -> None:
    """The same for machines."""
    sys.stdout.write(msgspec.json.encode({"passed": passed(rows), "rows": rows}).decode() + "\n")
