"""Imitation compared like with like: several seeds, or the six shapes of policy (paper Section V.B), and the teacher.

Every run is a whole one in a folder of its own, so it can be resumed, looked at and evaluated like any other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from runtime.config import Config
from runtime.control.policy import Policy
from sim.scenario import Scenario
from training.checkpoint import RunError, RunFolder
from training.mpc_controller import MpcController
from training.plan import IMITATE, PHYSICS_RATE_HZ, RunPlan, StagePlan
from training.provenance import config_hash, versions
from training.randomize import IMITATION, SENSORS, Conditions, draw
from training.reference import Reference
from training.reward import TableReward
from training.rollout import Setup, Stage, Task
from training.trainer import MakeEvaluator, Report, Trainer
from training.validation import VALIDATION_SEED
from training.variants import Variant, make_policy

DRAWS = 16
"""Episodes that judge a finished run."""
FULL_LENGTH = 1000
"""Their ticks: the whole reference."""


@dataclass(frozen=True, slots=True)
class Imitated:
    """What came of one run, beside its teacher's own score."""

    name: str
    seed: int
    numbers: int
    """Trained."""
    passed: int
    """First iteration whose mean scored more than the teacher in the same episode; 0 for none."""
    share: float
    """Of the largest return, over the judging episodes at the full length."""
    of_teacher: float
    """Of the teacher's own return in the same episodes."""
    fell: float
    """Share of them."""


@dataclass(frozen=True, slots=True)
class Judge:
    """The same episodes for everybody."""

    config: Config
    reference: Reference

    def setup(self, policy: Policy, ticks: int) -> Setup:
        """Episodes of ``ticks`` against the reference."""
        features, commands = self.reference.resampled(self.config.control.rate_hz, ticks)
        return Setup(self.config, policy, TableReward(), ticks, features, commands, PHYSICS_RATE_HZ)

    def teacher(self, ticks: int, tasks: Sequence[Task]) -> list[tuple[float, bool]]:
        """Returns of the MPC walking the simulated robot itself, each a share of the largest; and whether it fell."""
        shape = make_policy(self.config.robot, self.config.control.gait.walking_height, Variant(), False)
        return _play(Stage(self.setup(shape, ticks), MpcController(self.config)), ticks, tasks)

    def trained(self, policy: Policy, ticks: int, tasks: Sequence[Task]) -> list[tuple[float, bool]]:
        """The same of a policy of this shape, whose numbers come with the tasks."""
        return _play(Stage(self.setup(policy, ticks)), ticks, tasks)


def _play(stage: Stage, ticks: int, tasks: Sequence[Task]) -> list[tuple[float, bool]]:
    best = TableReward().best * ticks
    episodes = [stage.rollout(task) for task in tasks]
    stage.close()
    return [(episode.fitness / best, episode.fell) for episode in episodes]


def judging_tasks(parameters: np.ndarray) -> list[Task]:
    """Spawns tilted by up to 0.2 rad, friction, noise and sensors' biases, of a seed that no training draws from."""
    rng = np.random.default_rng(VALIDATION_SEED)
    return [Task(parameters, draw(IMITATION, rng)) for _ in range(DRAWS)]


def own_task(parameters: np.ndarray) -> Task:
    """The episode in which every iteration's mean is scored (``Trainer``)."""
    return Task(parameters, Conditions(Scenario(noise=SENSORS)))


def study(
    config: Config,
    reference: Reference,
    folder: Path,
    runs: Sequence[tuple[str, int]],
    make_evaluator: MakeEvaluator,
    report: Report,
    stage: StagePlan = IMITATE,
    terms: bool = False,
) -> Iterator[Imitated]:
    """Judge the teacher, then train (variant, seed) after (variant, seed) and judge each by the same episodes.

    What ``folder`` has already is not trained again.

    Raises:
        RunError: a run of another reference, stage or config lies there.
    """
    judge = Judge(config, reference)
    share, fell = _means(judge.teacher(FULL_LENGTH, judging_tasks(np.zeros(0))))
    yield Imitated("mpc", 0, 0, 0, share, 1.0, fell)
    for variant, seed in runs:
        plan = msgspec.convert(
            {
                "name": f"{variant}-{seed}", "robot": config.robot.name, "config": config_hash(config), "seed": seed,
                "variant": variant, "terms": terms, "reference": reference.source, "stages": (stage,),
            },
            RunPlan,
        )  # fmt: skip
        run = _opened(RunFolder(folder / plan.name), plan)
        trainer = Trainer(config, plan, run, make_evaluator, reference)
        trainer.run(run.load() if run.iterations() else trainer.start(), report)
        yield _judged(judge, trainer, run, share)


def _opened(run: RunFolder, plan: RunPlan) -> RunFolder:
    """The run's folder, begun or found as the same plan left it."""
    if not (run.path / "run.json").exists():
        run.begin(plan, versions())
    elif run.plan(plan.config) != plan:
        raise RunError(f"{run.path} is a run of another plan (reference, stage or terms): choose another --out")
    return run


def _judged(judge: Judge, trainer: Trainer, run: RunFolder, teacher_share: float) -> Imitated:
    plan, ticks = trainer.plan, trainer.plan.stages[0].ticks
    ((bar, _),) = judge.teacher(ticks, [own_task(np.zeros(0))])
    wanted = bar * TableReward().best * ticks
    passed = next((row.iteration for row in run.curve() if row.mean_return > wanted), 0)
    parameters = trainer.policy(run.load()).parameters
    share, fell = _means(judge.trained(trainer.template, FULL_LENGTH, judging_tasks(parameters)))
    return Imitated(plan.variant, plan.seed, parameters.size, passed, share, share / teacher_share, fell)


def _means(shares: Sequence[tuple[float, bool]]) -> tuple[float, float]:
    return float(np.mean([share for share, _ in shares])), float(np.mean([fell for _, fell in shares]))
