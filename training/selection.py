"""The policy that is shipped is the best on a validation set, not on the training episode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from runtime import policies
from runtime.config import Config
from runtime.control.policy import Policy, encode_policy
from training.checkpoint import RunFolder, write_whole
from training.contest import Contender, Contest
from training.plan import StagePlan
from training.randomize import SETS, TASK, Randomization
from training.validation import validation_set
from training.variants import with_parameters

CANDIDATES = 6
"""Checkpoints that are compared: of the last stage, evenly spread over its last two thirds."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """A candidate on the validation set."""

    iteration: int
    averaged: int
    """Checkpoints up to this one that its numbers are the mean of; 1: it is that checkpoint."""
    falls: int
    """On all of the set."""
    error: float
    """Mean velocity error of the measured walks, m/s."""
    task_return: float
    """Mean of the drawn walks, each with what its fall cost it."""

    @property
    def score(self) -> float:
        """Return less 5 a fall and 10 a cm/s of error: what the table asks for, in one number.

        One fall of the hard walks of a kind is 2 to 6 % of them, for which 0.4 % of the return is a fair price; at 10
        a mean of checkpoints was kept that fell once less and missed the return that is asked.
        """
        return self.task_return - 5.0 * self.falls - 1000.0 * self.error


def judge(contest: Contest, who: Contender, iteration: int, averaged: int = 1, bounds: Randomization = TASK) -> Verdict:
    """One candidate; ``bounds`` of the draws."""
    walks = validation_set(bounds)
    measured, hard, drawn = (contest.play(who, trials) for trials in (walks.measured, walks.hard, walks.drawn))
    wanted = np.array([trial.conditions.command for trial in walks.measured])
    errors = np.abs(np.array([outcome.velocity for outcome in measured]) - wanted)[:, :2]
    return Verdict(
        iteration=iteration,
        averaged=averaged,
        falls=sum(outcome.fell for outcome in [*measured, *hard, *drawn]),
        error=float(errors.mean()),
        task_return=float(np.mean([outcome.task_return for outcome in drawn])),
    )


def select(config: Config, folder: RunFolder, stage: StagePlan, workers: int, say: Callable[[str], None]) -> Policy:
    """The best of the last stage's checkpoints and their mean, with the verdicts in its provenance.

    ``stage``, the last, tells what ground judges: uneven ground what was trained on it, else the level task, whatever
    harder draws it was trained with.
    """
    trained = SETS[stage.conditions]
    bounds = trained if trained.bump else TASK
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
