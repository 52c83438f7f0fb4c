"""ask → evaluate → tell → checkpoint → report, stage after stage (paper IV.B). Resumes to the very same bits."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import msgspec
import numpy as np

from drivers.robot import Array
from runtime.config import Config
from runtime.control.policy import Policy, encode_policy
from sim.scenario import Scenario
from training import pgpe
from training.checkpoint import Checkpoint, Row, RunFolder
from training.evaluators import Evaluator
from training.plan import RunPlan, StagePlan
from training.provenance import declared, versions
from training.randomize import SENSORS, SETS, Conditions, draw
from training.reference import Reference
from training.reward import TableReward, TaskReward
from training.rollout import Episode, Setup, Task
from training.symmetry import Folding
from training.variants import (
    VARIANTS,
    folding_of,
    make_policy,
    reading_contacts,
    swinging_higher,
    with_parameters,
    without_terms,
)

MakeEvaluator = Callable[[Setup], Evaluator]
Report = Callable[[Row], None]
VALIDATION_COMMAND = (0.5, 0.0, 0.0)
"""What the mean is asked in its own episode of a task stage."""


@dataclass(frozen=True, slots=True)
class _Course:
    """A stage, ready to run."""

    plan: StagePlan
    template: Policy
    """Its policies but for the numbers."""
    folding: Folding
    params: pgpe.Params


class Trainer:
    """One run in its folder."""

    def __init__(
        self,
        config: Config,
        plan: RunPlan,
        folder: RunFolder,
        make_evaluator: MakeEvaluator,
        reference: Reference | None,
        first: Policy | None = None,
    ) -> None:
        """Prepare.

        Args:
            config: the robot.
            plan: what to do.
            folder: where to keep it.
            make_evaluator: gives the workers of a stage.
            reference: what table stages imitate.
            first: whose numbers the first mean has; zero where not given.
        """
        self.config, self.plan, self.folder = config, plan, folder
        self._make_evaluator, self._reference = make_evaluator, reference
        height = config.control.gait.walking_height
        shape = make_policy(config.robot, height, VARIANTS[plan.variant], plan.terms, plan.name)
        template = declared(without_terms(shape, plan.without), config)
        self._first = template if first is None else first
        self._courses = [self._course(stage, template) for stage in plan.stages]
        self.template: Policy = self._courses[0].template
        """The first stage's policies but for their numbers."""

    def start(self) -> Checkpoint:
        """The run before its first iteration, saved."""
        checkpoint = Checkpoint(0, 0, self._enter(0, self._first))
        self.folder.save(checkpoint, self._policy_file(checkpoint), None)
        return checkpoint

    def run(self, checkpoint: Checkpoint, report: Report) -> Checkpoint:
        """Go on from ``checkpoint`` to the end of the last stage."""
        for number in range(checkpoint.stage, len(self._courses)):
            if number > checkpoint.stage:
                checkpoint = Checkpoint(number, checkpoint.iteration, self._enter(number, self._mean(checkpoint)))
            for reached, row in self._iterate(checkpoint):
                self.folder.save(reached, self._policy_file(reached), row)
                report(row)
                checkpoint = reached
        return checkpoint

    def policy(self, checkpoint: Checkpoint) -> Policy:
        """The mean as a policy, with how it was made."""
        return msgspec.structs.replace(self._mean(checkpoint), provenance=self._provenance(checkpoint))

    def _mean(self, checkpoint: Checkpoint) -> Policy:
        course = self._courses[checkpoint.stage]
        return with_parameters(course.template, course.folding.unfold(checkpoint.state.mean))

    def _iterate(self, checkpoint: Checkpoint) -> Iterator[tuple[Checkpoint, Row]]:
        course = self._courses[checkpoint.stage]
        if checkpoint.state.iteration >= course.plan.iterations:
            return
        evaluator = self._make_evaluator(self._setup(course))
        try:
            while checkpoint.state.iteration < course.plan.iterations:
                checkpoint, row = self._step(checkpoint, course, evaluator)
                yield checkpoint, row
        finally:
            evaluator.close()

    def _step(self, checkpoint: Checkpoint, course: _Course, evaluator: Evaluator) -> tuple[Checkpoint, Row]:
        """One iteration. Its randomness depends on seed and iteration alone."""
        began = time.monotonic()
        rng = np.random.default_rng([self.plan.seed, checkpoint.iteration])
        population = pgpe.ask(checkpoint.state, course.params, rng)
        bounds = SETS[course.plan.conditions]
        pairs = [draw(bounds, rng) for _ in range(course.params.directions)]
        tasks = [Task(course.folding.unfold(member), pairs[index // 2]) for index, member in enumerate(population)]
        own = Task(course.folding.unfold(checkpoint.state.mean), self._own_conditions(course.plan))
        *episodes, mine = evaluator.evaluate([*tasks, own])
        state = pgpe.tell(checkpoint.state, course.params, population, _utilities(course.plan, episodes))
        after = Checkpoint(checkpoint.stage, checkpoint.iteration + 1, state)
        return after, _row(course.plan, after, episodes, mine, time.monotonic() - began)

    def _own_conditions(self, stage: StagePlan) -> Conditions:
        noisy = SETS[stage.conditions].noise
        scenario = Scenario(noise=SENSORS) if noisy else Scenario()
        return Conditions(scenario, VALIDATION_COMMAND if stage.reward == "task" else None)

    def _setup(self, course: _Course) -> Setup:
        stage = course.plan
        features = commands = None
        if stage.reward == "table":
            assert self._reference is not None, "a table stage imitates a reference"
            features, commands = self._reference.resampled(self.config.control.rate_hz, stage.ticks)
        reward = TableReward() if stage.reward == "table" else TaskReward()
        return Setup(self.config, course.template, reward, stage.ticks, features, commands, self.plan.physics_rate_hz)

    def _enter(self, number: int, start: Policy) -> pgpe.State:
        course = self._courses[number]
        read = reading_contacts(start, course.plan.rest, course.plan.contact_scale)
        return pgpe.start(course.folding.fold(read.parameters), course.plan.stdev)

    def _course(self, stage: StagePlan, template: Policy) -> _Course:
        params = pgpe.Params(
            directions=stage.directions,
            learning_rate=stage.learning_rate,
            learning_rate_end=stage.learning_rate_end,
            learning_rate_steps=stage.iterations,
            stdev_learning_rate=stage.stdev_learning_rate,
            weight_decay=stage.weight_decay,
        )
        template = swinging_higher(reading_contacts(template, stage.rest, stage.contact_scale), stage.swing_lift)
        return _Course(stage, template, folding_of(template, stage.symmetry), params)

    def _policy_file(self, checkpoint: Checkpoint) -> bytes:
        return encode_policy(self.policy(checkpoint))

    def _provenance(self, checkpoint: Checkpoint) -> dict[str, object]:
        return {
            "made": "trotd train",
            "run": msgspec.to_builtins(self.plan),
            "iteration": checkpoint.iteration,
            "versions": versions(),
        }


def _utilities(stage: StagePlan, episodes: list[Episode]) -> Array:
    fitness = np.array([episode.fitness for episode in episodes])
    if stage.fall_weight == 0.0:
        return pgpe.centred_ranks(fitness)
    falls = np.array([float(episode.fell) for episode in episodes])
    return pgpe.paired_ranks(fitness, falls, stage.fall_weight)


def _row(stage: StagePlan, after: Checkpoint, episodes: list[Episode], mine: Episode, seconds: float) -> Row:
    fitness = np.array([episode.fitness for episode in episodes])
    usable = fitness[np.isfinite(fitness)]
    return Row(
        stage=stage.name,
        iteration=after.iteration,
        mean_return=mine.fitness,
        population_mean=float(usable.mean()) if usable.size else float("nan"),
        population_best=float(usable.max()) if usable.size else float("nan"),
        survival=float(np.mean([not episode.fell for episode in episodes])),
        lost=int(fitness.size - usable.size),
        steps=sum(episode.steps for episode in episodes) + mine.steps,
        stdev=float(after.state.stdev.mean()),
        seconds=seconds,
        terms=mine.terms,
    )
