"""Take every guard out once and see that a test notices: ``python tests/mutation.py --help``.

A guard is an ``if`` of a guard module's functions, or one operand of a condition there. Each is replaced by what lets
everything pass, the module is written into a copy of the tree, and the tests of that module run until one fails.
"""

from __future__ import annotations

import ast
import copy
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

ROOT = Path(__file__).parents[1]
TESTS = {
    "runtime/limits.py": ("tests/test_limits.py", "tests/test_plausibility.py"),
    "runtime/plausibility.py": ("tests/test_plausibility.py", "tests/test_limits.py"),
    "runtime/encoders.py": ("tests/test_encoders.py", "tests/test_plausibility.py"),
    "runtime/derating.py": ("tests/test_derating.py", "tests/test_limits.py"),
    "runtime/modes.py": ("tests/test_modes.py",),
    "runtime/reasons.py": ("tests/test_modes.py", "tests/test_cycle.py"),
    "runtime/arming.py": ("tests/test_arming.py",),
}
"""Modules that hold guards, and the tests that must notice, quickest first."""
ROOMS = ("drivers", "runtime", "sim", "station", "training", "trotd", "tests")
SURVIVED = 1


@dataclass(frozen=True)
class Mutant:
    """One guard taken out."""

    module: str
    line: int
    what: str
    source: str


def mutants(module: str) -> Iterator[Mutant]:
    """Every guard of ``module`` taken out, one at a time."""
    tree = ast.parse((ROOT / module).read_text())
    conditions = [node for node in ast.walk(tree) if isinstance(node, ast.If | ast.IfExp)]
    for place, node in enumerate(conditions):
        for what, test in _weaker(node.test):
            changed = copy.deepcopy(tree)
            twins = [twin for twin in ast.walk(changed) if isinstance(twin, ast.If | ast.IfExp)]
            twins[place].test = test
            yield Mutant(module, node.lineno, what, ast.unparse(ast.fix_missing_locations(changed)))


def _weaker(test: ast.expr) -> Iterator[tuple[str, ast.expr]]:
    """What a condition becomes: never true; and without each of its operands."""
    yield f"if {ast.unparse(test)}: never", ast.Constant(False)
    if isinstance(test, ast.BoolOp):
        for index, operand in enumerate(test.values):
            rest = [value for other, value in enumerate(test.values) if other != index]
            left = rest[0] if len(rest) == 1 else ast.BoolOp(test.op, rest)
            yield f"if {ast.unparse(test)}: without {ast.unparse(operand)}", left


def survives(mutant: Mutant, tree: Path) -> bool:
    """Whether no test notices."""
    path = tree / mutant.module
    original = path.read_text()
    path.write_text(mutant.source)
    environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *TESTS[mutant.module]]
        result = subprocess.run(command, cwd=tree, env=environment, capture_output=True, check=False)
        if result.returncode not in (0, 1):
            raise SystemExit(f"{mutant.module}:{mutant.line}: {result.stdout.decode()[-2000:]}")
        return result.returncode == 0
    finally:
        path.write_text(original)


def main(
    module: Annotated[list[str] | None, typer.Option(help="Only this one; may be given again.")] = None,
    line: Annotated[int | None, typer.Option(help="Only the guard on this line.")] = None,
    list_only: Annotated[bool, typer.Option("--list", help="Say what would be taken out.")] = False,
) -> None:
    """Remove each single guard, one at a time; exit code 1 if any removal is noticed by no test."""
    from rich.progress import track

    chosen = [m for name in module or ["runtime/limits.py"] for m in mutants(name) if line in (None, m.line)]
    if list_only:
        for mutant in chosen:
            typer.echo(f"{mutant.module}:{mutant.line}: {mutant.what}")
        return
    survivors = []
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        for room in ROOMS:
            shutil.copytree(ROOT / room, tree / room, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", tree)
        for mutant in track(chosen, "guards taken out"):
            if survives(mutant, tree):
                survivors.append(mutant)
                typer.echo(f"survived: {mutant.module}:{mutant.line}: {mutant.what}")
    typer.echo(f"{len(chosen)} guards taken out one at a time, {len(survivors)} noticed by no test")
    raise typer.Exit(SURVIVED if survivors else 0)


if __name__ == "__main__":
    typer.run(main)
