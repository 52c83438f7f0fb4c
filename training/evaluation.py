"""The proof: every contender through the same tests, as text, JSON and a page with the paper's figures."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from runtime.config import Config
from training.contest import Contender, Contest
from training.provenance import config_hash, versions
from training.table import Cells, Test

Progress = Callable[[str, str, Cells], None]
"""Called after every test with contender, test and result."""


@dataclass(slots=True)
class Report:
    """Results by test and contender."""

    robot: str
    config: str
    contenders: list[str]
    results: dict[str, dict[str, Cells]] = field(default_factory=dict)
    """test → contender → column → number."""

    def to_json(self) -> str:
        """For machines."""
        about: dict[str, Any] = {"robot": self.robot, "config": self.config, "versions": versions()}
        return json.dumps(about | {"contenders": self.contenders, "results": self.results}, indent=1)

    def to_text(self) -> str:
        """For people: a line for every number, a column for every contender."""
        head = ["test", *self.contenders]
        rows = [
            [f"{test}: {column}" if column not in ("stood", "N·s") else _title(test, column, cells)]
            + [_short(cells[name][column]) for name in self.contenders]
            for test, cells in self.results.items()
            for column in next(iter(cells.values()))
            if column != "of"
        ]
        widths = [max(len(row[i]) for row in [head, *rows]) for i in range(len(head))]
        lines = [
            "  ".join(
                [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
            )
            for row in [head, *rows]
        ]
        return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])


def evaluate(
    config: Config, contenders: Sequence[Contender], tests: dict[str, Test], workers: int, progress: Progress
) -> Report:
    """Play every test with every contender: same seeds for all."""
    report = Report(config.robot.name, config_hash(config), [who.name for who in contenders])
    with Contest(config, workers) as contest:
        for name, test in tests.items():
            report.results[name] = {}
            for who in contenders:
                report.results[name][who.name] = test(contest, who)
                progress(who.name, name, report.results[name][who.name])
    return report


def _title(test: str, column: str, cells: dict[str, Cells]) -> str:
    if column == "N·s":
        return f"{test}: N·s"
    return f"{test}: stood of {next(iter(cells.values()))['of']:.0f}"


def _short(value: float) -> str:
    if value == round(value) and abs(value) < 1e4:
        return f"{value:.0f}"
    return f"{value:.4f}" if abs(value) < 1 else f"{value:.1f}"
