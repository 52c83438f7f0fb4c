"""``trotd train``, ``trotd evaluate`` and ``trotd policy show|diff``: one thin function each."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trotd.cli_station import ENDPOINT
from trotd.exits import INTERRUPTED, UsageError, one_line_errors

if TYPE_CHECKING:
    from runtime.config import Config
    from runtime.control.policy import Policy
    from training.checkpoint import Checkpoint, Row, RunFolder
    from training.contest import Contender
    from training.plan import RunPlan
    from training.reference import Reference
    from training.trainer import Trainer

policy_app = typer.Typer(no_args_is_help=True, help="Look at policies.")
RobotOption = Annotated[str, typer.Option("--robot", "-r", help="A shipped robot's name, or a .toml file.")]
WorkersOption = Annotated[int, typer.Option(help="Worker processes; 0 for every core.", min=0)]
QUICK_TESTS = ("velocity, noisy", "push sideways", "push forward", "start at U[0, π/6]", "task draws")


def register(app: typer.Typer) -> None:
    """Add this family of commands to the front door."""
    app.command()(train)
    app.command()(evaluate)
    app.add_typer(policy_app, name="policy")


def train(
    out: Annotated[Path | None, typer.Option(help="Folder of the run; default runs/<name>-<seed>.")] = None,
    resume: Annotated[Path | None, typer.Option(help="Go on with the run in this folder, to the same bits.")] = None,
    robot: RobotOption = "stoch3",
    name: Annotated[str, typer.Option(help="Name of the policy.")] = "trot",
    seed: Annotated[int, typer.Option(min=0)] = 1,
    variant: Annotated[
        str, typer.Option(help="linear, linear-plain, linear-grf, mlp, mlp-plain or mlp-grf.")
    ] = "linear",
    paper: Annotated[bool, typer.Option("--paper", help="The paper's letter: one stage, no fixed terms.")] = False,
    rough: Annotated[bool, typer.Option("--rough", help="Fine-tune --start on uneven ground.")] = False,
    without: Annotated[list[str] | None, typer.Option(help="A fixed term that stays off; may be given again.")] = None,
    start: Annotated[str | None, typer.Option(help="Policy to refine, instead of beginning at zero.")] = None,
    iterations: Annotated[int | None, typer.Option(help="Of every stage, instead of the plan's.", min=1)] = None,
    directions: Annotated[int | None, typer.Option(help="Of every stage, instead of the plan's.", min=1)] = None,
    ticks: Annotated[int | None, typer.Option(help="Of every episode, instead of the plan's.", min=1)] = None,
    teacher: Annotated[str, typer.Option(help="rigid-body, or robot: who walks the reference.")] = "rigid-body",
    reference: Annotated[Path | None, typer.Option(help="A saved reference episode, instead of a new one.")] = None,
    workers: WorkersOption = 0,
    ray: Annotated[str | None, typer.Option(help="Address of a Ray cluster, instead of this machine.")] = None,
    push: Annotated[
        bool, typer.Option("--push", help="Send each iteration's mean to the running simulated robot: watch it learn.")
    ] = False,
    connect: Annotated[str, typer.Option(help="zenoh endpoint of that robot's daemon.")] = ENDPOINT,
    validate: Annotated[bool, typer.Option(help="End with the table against the MPC and the shipped policy.")] = True,
) -> None:
    """Learn to walk, from nothing: imitate the teacher, then learn what walking is for.

    Example: `trotd train --seed 1`
    """
    with one_line_errors():
        from training.checkpoint import RunFolder
        from training.provenance import config_hash, versions

        if rough and not start and resume is None:
            raise UsageError("--rough goes on from a policy that walks: say which with --start")
        config, beside = _load(robot)
        folder = RunFolder(resume or out or Path("runs") / f"{name}-{seed}")
        with _pushed(config.robot.name, connect, folder) if push else contextlib.nullcontext(_keep) as send:
            if resume is not None:
                plan = folder.plan(config_hash(config))
            else:
                from training.plan import make_plan

                plan = make_plan(
                    name, config.robot.name, config_hash(config), seed=seed, variant=variant, start=start or "",
                    paper=paper, rough=rough, reference=teacher, without=without or (),
                )  # fmt: skip
                plan = plan.shortened(iterations, directions, ticks)
            first = _first(config, beside, plan)
            episode = _reference(config, plan, reference)
            if resume is None:
                folder.begin(plan, versions())
            trainer = _trainer(config, plan, folder, first, episode, workers, ray)
            checkpoint = folder.load() if resume is not None and folder.iterations() else trainer.start()
            end = _run(trainer, plan, checkpoint, send)
        _finish(config, folder, trainer, end, workers, validate)


def _load(robot: str) -> tuple[Config, Path]:
    from runtime import config

    path = config.find_robot(robot)
    return config.load(path), path.parent


def _reference(config: Config, plan: RunPlan, saved: Path | None) -> Reference | None:
    from training.reference import load_reference
    from training.robot_reference import walked_by

    if not any(stage.reward == "table" for stage in plan.stages):
        return None
    if saved is not None:
        return load_reference(saved, config)
    return walked_by(plan.reference, config)


def _first(config: Config, beside: Path, plan: RunPlan) -> Policy | None:
    """Whose numbers the run begins with."""
    from runtime import policies
    from training.variants import check_variant

    if not plan.start:
        return None
    first = policies.load(policies.find_policy(plan.start, beside), config.robot.name)
    check_variant(first, plan.variant)
    return first


def _trainer(
    config: Config, plan: RunPlan, folder: RunFolder, first: Policy | None, reference: Reference | None, workers: int,
    ray: str | None,
) -> Trainer:  # fmt: skip
    from training.evaluators import make_evaluator
    from training.reference import save_reference
    from training.trainer import Trainer

    if reference is not None:
        save_reference(reference, folder.path / "reference.npz")
    return Trainer(config, plan, folder, lambda setup: make_evaluator(setup, workers or None, ray), reference, first)


def _keep(_: Row) -> str:
    """Nothing is pushed."""
    return ""


@contextlib.contextmanager
def _pushed(robot: str, endpoint: str, folder: RunFolder) -> Iterator[Callable[[Row], str]]:
    """What sends an iteration's mean through the robot's own door for policies, and says what came of it."""
    from station.push import send
    from station.session import StationError, connected

    with connected(robot, endpoint) as station:

        def push(row: Row) -> str:
            try:
                reply = send(station, folder.policy_file(row.iteration).read_bytes(), immediate=True)
            except StationError as error:
                return f"  not pushed: {error}"
            return "  pushed" if reply.accepted else f"  refused: {reply.reason}"

        yield push


def _run(trainer: Trainer, plan: RunPlan, checkpoint: Checkpoint, push: Callable[[Row], str]) -> Checkpoint:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    total = sum(stage.iterations for stage in plan.stages)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        bar = progress.add_task("training", total=total, completed=checkpoint.iteration)

        def report(row: Row) -> None:
            progress.update(bar, completed=row.iteration, description=row.stage)
            progress.console.print(_line(row) + push(row))

        try:
            return trainer.run(checkpoint, report)
        except KeyboardInterrupt:
            progress.console.print(f"stopped; go on with: trotd train --resume {trainer.folder.path}")
            raise typer.Exit(INTERRUPTED) from None


def _line(row: Row) -> str:
    lost = f"  lost {row.lost}" if row.lost else ""
    return (
        f"{row.stage:8} {row.iteration:4d}  mean {row.mean_return:8.0f}  population {row.population_mean:8.0f}  "
        f"best {row.population_best:8.0f}  stood {row.survival:4.0%}  σ {row.stdev:.3f}  {row.seconds:.1f} s{lost}"
    )


def _finish(config: Config, folder: RunFolder, trainer: Trainer, end: Checkpoint, workers: int, validate: bool) -> None:
    """Choose the best checkpoint on the validation set, write the policy, show the table."""
    from runtime.control.policy import encode_policy
    from training.checkpoint import write_whole

    policy = trainer.policy(end)
    last = trainer.plan.stages[-1]
    if validate:
        from training.selection import select

        count = workers or os.cpu_count() or 1
        policy = select(config, folder, last, count, lambda text: typer.echo(text, err=True))
    target = folder.path / f"{policy.name}.json"
    write_whole(target, encode_policy(policy))
    typer.echo(f"policy: {target}")
    if validate:
        from training.contest import find_contenders

        contenders = find_contenders([str(target), "mpc", "mpc-tuned", config.control.policy])
        _show_table(config, contenders, workers, quick=True, rough=last.conditions == "rough")


def evaluate(
    contenders: Annotated[list[str] | None, typer.Argument(help="Policy files or shipped policies.")] = None,
    controller: Annotated[list[str] | None, typer.Option(help="mpc or mpc-tuned; may be given again.")] = None,
    baseline: Annotated[list[str] | None, typer.Option(help="zero or balance; may be given again.")] = None,
    without: Annotated[
        list[str] | None,
        typer.Option(help="Also the first policy without this fixed term; may be given again, or all for each."),
    ] = None,
    robot: RobotOption = "stoch3",
    quick: Annotated[bool, typer.Option("--quick", help="Few seeds, the most telling tests.")] = False,
    rough: Annotated[bool, typer.Option("--rough", help="The tests on uneven ground instead.")] = False,
    only: Annotated[list[str] | None, typer.Option(help="Only tests whose name contains this.")] = None,
    json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
    page: Annotated[Path | None, typer.Option(help="Also write an HTML page with the paper's figures.")] = None,
    run: Annotated[Path | None, typer.Option(help="Run folder whose learning curve goes on the page.")] = None,
    workers: WorkersOption = 0,
) -> None:
    """The test table, side by side: same seeds, noise and latency for all, each walking on its own estimate.

    Example: `trotd evaluate trot --controller mpc --baseline zero --page trot.html`
    """
    with one_line_errors():
        config, beside = _load(robot)
        from training.contest import ablated, find_contenders

        names = [*(contenders or []), *(controller or []), *(baseline or [])] or [config.control.policy]
        found = find_contenders(names, beside)
        found += ablated(found[0], without or ())
        text = _show_table(config, found, workers, quick, rough, only, json)
        if page is not None:
            _write_page(config, found, text, page, run, workers)


def _show_table(
    config: Config, contenders: list[Contender], workers: int, quick: bool, rough: bool = False,
    only: list[str] | None = None, json: bool = False,
) -> str:  # fmt: skip
    from training.evaluation import evaluate as play
    from training.table import FULL, QUICK, make_rough_tests, make_tests

    size = QUICK if quick else FULL
    tests = make_rough_tests(size) if rough else make_tests(size)
    if quick and not rough and not only:
        tests = {name: test for name, test in tests.items() if name in QUICK_TESTS}
    if only:
        tests = {name: test for name, test in tests.items() if any(part in name for part in only)}
    report = play(
        config,
        contenders,
        tests,
        workers or os.cpu_count() or 1,
        lambda who, test, _: typer.echo(f"{who}: {test}", err=True),
    )
    typer.echo(report.to_json() if json else report.to_text())
    return report.to_text()


def _write_page(
    config: Config, contenders: list[Contender], text: str, target: Path, run: Path | None, workers: int
) -> None:
    from training import figures
    from training.checkpoint import RunFolder
    from training.contest import Contest
    from training.reference import make_reference

    first, recorder = contenders[0], figures.Recorder(config)
    drawn = {
        "Fig. 4: on flat ground": figures.figure_4(recorder, contenders, make_reference(config)),
        "Fig. 5: phase portrait and forces": figures.figure_5(recorder, first),
        "Fig. 6: pushed": figures.figure_6(recorder, first),
        "Fig. 7: on uneven ground": figures.figure_7(recorder, first),
    }
    recorder.close()
    with Contest(config, workers or os.cpu_count() or 1) as contest:
        drawn["Pushes from every side"] = figures.push_map(contest, contenders)
    rows = RunFolder(run).curve() if run is not None else []
    if rows:
        drawn["Learning curve"] = figures.learning_curve(rows)
    target.write_text(figures.page(f"{first.name} on {config.robot.name}", text, drawn))
    typer.echo(f"page: {target}", err=True)


@policy_app.command()
def show(
    policy: Annotated[str, typer.Argument(help="A policy file or a shipped one's name.")], robot: RobotOption = "stoch3"
) -> None:
    """The matrix in physical units: what drives what, symmetry, worst case, a dead contact sensor."""
    with one_line_errors():
        from training.inspection import describe

        typer.echo(describe(_policy(policy, robot)))


@policy_app.command()
def diff(
    first: Annotated[str, typer.Argument(help="A policy file or a shipped one's name.")],
    second: Annotated[str, typer.Argument(help="Another.")],
    robot: RobotOption = "stoch3",
) -> None:
    """Where two policies differ most, in physical units."""
    with one_line_errors():
        from training.inspection import compare

        typer.echo(compare(_policy(first, robot), _policy(second, robot)))


def _policy(name: str, robot: str) -> Policy:
    from runtime import policies

    config, beside = _load(robot)
    return policies.load(policies.find_policy(name, beside), config.robot.name)
