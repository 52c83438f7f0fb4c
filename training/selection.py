"""The policy that is shipped is the best on a validation set, not on the training episode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import pi

import msgspec
import numpy as np

from runtime import policies
from runtime.config import Config
from runtime.control.policy import Policy, encode_policy
from sim.scenario import Push, Scenario
from training.checkpoint import RunFolder, write_whole
from training.contest import Contender, Contest, Outcome, Trial
from training.plan import StagePlan
from training.randomize import SENSORS, SETS, TASK, Conditions, Randomization, draw
from training.variants import with_parameters

CANDIDATES = 4
"""Checkpoints that are compared: the last ones, evenly spread over the last stage."""
DRAWS = 24
"""Episodes drawn at random, beside the measured walks and the pushes."""
STANDING_TIME = 20.0
"""s: what leans a little more every second has fallen by then."""
VALIDATION_SEED = 5_000
"""Of the episodes that judge; apart from training's and from the table's."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """A candidate on the validation set."""

    iteration: int
    averaged: int
    """Checkpoints up to this one that its numbers are the mean of; 1: it is that checkpoint."""
    falls: int
    error: float
    """Mean velocity error over the grid, m/s."""
    task_return: float

    @property
    def score(self) -> float:
        """Return less 50 a fall and 10 a cm/s of error: what the table asks for, in one number."""
        return self.task_return - 50.0 * self.falls - 1000.0 * self.error


def validation_set(bounds: Randomization = TASK) -> tuple[list[Trial], list[Trial]]:
    """Velocities that are measured on level ground, and pushes, spawns and draws that are to be survived."""
    commands = ((0.0, 0.0, 0.0), (0.8, 0.0, 0.0), (-0.4, 0.0, 0.0), (1.6, 0.0, 0.0), (0.0, 0.3, 0.0), (0.5, 0.0, 0.5))
    measured = [Trial(Conditions(Scenario(seed=VALIDATION_SEED, noise=SENSORS), command), 5.0) for command in commands]
    pushed = [
        Trial(
            Conditions(
                Scenario(
                    seed=VALIDATION_SEED + phase,
                    noise=SENSORS,
                    pushes=(Push(1.6 + 0.1 * phase, 0.1, (450.0 * np.cos(side), 450.0 * np.sin(side), 0.0)),),
                ),
                (0.4, 0.0, 0.0),
            ),
            3.5,
        )
        for phase in range(4)
        for side in (0.0, pi / 2, pi, -pi / 2)
    ]
    standing = Conditions(Scenario(seed=VALIDATION_SEED, noise=SENSORS), (0.0, 0.0, 0.0), standing=True)
    measured.append(Trial(standing, STANDING_TIME))
    rng = np.random.default_rng(VALIDATION_SEED)
    return measured, pushed + [Trial(draw(bounds, rng), 2.6) for _ in range(DRAWS)]


def judge(contest: Contest, who: Contender, iteration: int, averaged: int = 1, bounds: Randomization = TASK) -> Verdict:
    """One candidate; ``bounds`` of the draws."""
    measured, survived = validation_set(bounds)
    walks = contest.play(who, measured)
    rest: list[Outcome] = contest.play(who, survived)
    wanted = np.array([trial.conditions.command for trial in measured])
    errors = np.abs(np.array([outcome.velocity for outcome in walks]) - wanted)[:, :2]
    return Verdict(
        iteration=iteration,
        averaged=averaged,
        falls=sum(outcome.fell for outcome in [*walks, *rest]),
        error=float(errors.mean()),
        task_return=float(np.mean([outcome.task_return for outcome in rest])),
    )


def select(config: Config, folder: RunFolder, stage: StagePlan, workers: int, say: Callable[[str], None]) -> Policy:
    """The best of the last stage's checkpoints and their mean, with the verdicts in its provenance.

    ``stage``, the last, tells what draws judge: its own where it serves a task, so that uneven ground judges what was
    trained on it.
    """
    bounds = SETS[stage.conditions] if stage.reward == "task" else TASK
    numbers = folder.iterations()
    last_stage = [row.iteration for row in folder.curve() if row.stage == folder.curve()[-1].stage]
    last = [number for number in numbers if number in last_stage] or numbers
    chosen = sorted({last[round(k)] for k in np.linspace(len(last) // 3, len(last) - 1, CANDIDATES)})
    half = last[len(last) // 2 :]
    mean = folder.path / "mean.json"
    members = [policies.load(folder.policy_file(number), config.robot.name) for number in half]
    write_whole(mean, encode_policy(mean_of(members)))
    candidates = [(folder.policy_file(number), number, 1) for number in chosen] + [(mean, half[-1], len(half))]
    verdicts: list[Verdict] = []
    with Contest(config, workers) as contest:
        for path, number, averaged in candidates:
            verdicts.append(judge(contest, Contender(path.stem, "policy", str(path)), number, averaged, bounds))
            say(f"validation of {path.stem}: {msgspec.to_builtins(verdicts[-1])}, score {verdicts[-1].score:.0f}")
    best = max(range(len(verdicts)), key=lambda place: verdicts[place].score)
    policy = policies.load(candidates[best][0], config.robot.name)
    results = [msgspec.to_builtins(verdict) for verdict in verdicts]
    return msgspec.structs.replace(policy, provenance=policy.provenance | {"validation": results})


def mean_of(members: Sequence[Policy]) -> Policy:
    """The mean of several checkpoints of one run: a stage's random walk around its optimum averages out."""
    mean = np.mean([member.parameters for member in members], axis=0)
    last = with_parameters(members[-1], mean)
    return msgspec.structs.replace(last, provenance=last.provenance | {"averaged": len(members)})
