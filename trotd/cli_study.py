"""``trotd study seeds|variants``: imitation compared like with like."""

from __future__ import annotations

import json as json_module
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trotd.cli_training import RobotOption, WorkersOption
from trotd.exits import one_line_errors

if TYPE_CHECKING:
    from training.checkpoint import Row
    from training.evaluators import Evaluator
    from training.rollout import Setup
    from training.study import Imitated

study_app = typer.Typer(no_args_is_help=True, help="Imitation, compared: several seeds, or the six shapes of policy.")
IterationsOption = Annotated[int, typer.Option(help="Of each run.", min=1)]
TicksOption = Annotated[int, typer.Option(help="Of an episode.", min=1)]
ConditionsOption = Annotated[str, typer.Option(help="Draws of an episode: nominal, noisy, imitation or paper.")]
TeacherOption = Annotated[str, typer.Option(help="rigid-body, or robot: who walks the reference.")]
DirectionsOption = Annotated[int, typer.Option(help="Mirrored pairs an iteration.", min=1)]
OutOption = Annotated[Path, typer.Option(help="Folder of the runs; what it holds already is not trained again.")]
JsonOption = Annotated[bool, typer.Option("--json", help="For machines.")]


def register(app: typer.Typer) -> None:
    """Add this family of commands to the front door."""
    app.add_typer(study_app, name="study")


@study_app.command()
def seeds(
    count: Annotated[int, typer.Argument(help="How many.", min=1)] = 5,
    out: OutOption = Path("runs/seeds"),
    robot: RobotOption = "stoch3",
    iterations: IterationsOption = 20,
    directions: DirectionsOption = 64,
    ticks: TicksOption = 400,
    conditions: ConditionsOption = "noisy",
    teacher: TeacherOption = "rigid-body",
    workers: WorkersOption = 0,
    json: JsonOption = False,
) -> None:
    """From zero with several seeds: at which iteration each passes the teacher's own score.

    Example: `trotd study seeds 5`
    """
    runs = [("linear", seed) for seed in range(1, count + 1)]
    changes = {"iterations": iterations, "directions": directions, "ticks": ticks, "conditions": conditions}
    _study(robot, out, runs, changes, True, teacher, workers, json)


@study_app.command()
def variants(
    out: OutOption = Path("runs/variants"),
    robot: RobotOption = "stoch3",
    seed: Annotated[int, typer.Option(min=0)] = 1,
    iterations: IterationsOption = 20,
    directions: DirectionsOption = 32,
    workers: WorkersOption = 0,
    json: JsonOption = False,
) -> None:
    """Linear and fully-connected, wrench and forces, relative and plain observation: six policies alike (Section V.B).

    No symmetry is imposed and no fixed term acts: the shapes alone differ.

    Example: `trotd study variants`
    """
    from training.variants import VARIANTS

    changes = {"iterations": iterations, "directions": directions, "symmetry": "none"}
    _study(robot, out, [(name, seed) for name in VARIANTS], changes, False, "rigid-body", workers, json)


def _study(
    robot: str,
    out: Path,
    runs: list[tuple[str, int]],
    changes: dict[str, object],
    terms: bool,
    teacher: str,
    workers: int,
    json: bool,
) -> None:
    with one_line_errors():
        import msgspec

        from runtime import config
        from training.evaluators import make_evaluator
        from training.plan import IMITATE
        from training.robot_reference import walked_by
        from training.study import study

        known = config.load(config.find_robot(robot))
        reference = walked_by(teacher, known)
        stage = msgspec.convert(msgspec.to_builtins(IMITATE) | changes, type(IMITATE))

        def report(row: Row) -> None:
            typer.echo(f"{row.iteration:4d}  mean {row.mean_return:8.0f}  {row.seconds:.0f} s", err=True)

        def make(setup: Setup) -> Evaluator:
            return make_evaluator(setup, workers or None)

        results = list(study(known, reference, out, runs, make, report, stage, terms))
        if json:
            typer.echo(json_module.dumps([asdict(result) for result in results]))
        else:
            _print(results)


def _print(results: list[Imitated]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table()
    for heading in ("", "seed", "numbers", "passed the MPC at", "of the largest return", "of the MPC's own", "fell"):
        table.add_column(heading, justify="left" if not heading else "right")
    for one in results:
        cells = (str(one.seed), str(one.numbers), str(one.passed or "-")) if one.numbers else ("", "", "")
        table.add_row(one.name, *cells, f"{one.share:.1%}", f"{one.of_teacher:.0%}", f"{one.fell:.0%}")
    Console().print(table)
