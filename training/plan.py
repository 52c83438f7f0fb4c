"""What a training run does, as data: it is saved beside its results and read again to resume."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from drivers.description import Name, NonNegative, Positive, Record
from runtime.control.policy import SwingLift
from training.variants import CONTACT_SCALE, Term, find_terms

Count = Annotated[int, Meta(ge=1)]
PHYSICS_RATE_HZ = 600.0
"""Of the simulator that trains; what judges runs at the world's own 1000 (decision 9)."""


class StagePlan(Record, frozen=True, kw_only=True):
    """One stage: a reward, conditions and a learning rate."""

    name: Name
    reward: Literal["table", "task"]
    """``table`` imitates the reference (Table I), ``task`` is the second stage's own reward."""
    iterations: Count
    directions: Count = 64
    ticks: Count = 1000
    conditions: Literal["nominal", "paper", "noisy", "imitation", "task", "wide", "weak", "hard", "rough"] = "imitation"
    """Bounds of the draws: ``training.randomize.SETS``."""
    symmetry: Literal["none", "left-right", "both"] = "left-right"
    rest: bool = False
    """Contacts are read less four feet on the ground, so that who stands asks for nothing (decision 14)."""
    contact_scale: Positive = CONTACT_SCALE
    """Of the contacts in the observation: ten times as large learns them ten times as fast."""
    swing_lift: SwingLift = 0.0
    """m by which feet swing higher than the gait says (``policy.Terms``): falls are too rare a sign to learn it by."""
    stdev: Positive = 0.1
    stdev_learning_rate: NonNegative = 0.1
    learning_rate: Positive = 0.05
    learning_rate_end: Positive = 0.05
    weight_decay: NonNegative = 0.0
    """Pull of every number towards zero (``pgpe.Params``)."""
    fall_weight: NonNegative = 0.0
    """Above zero the pairs are ranked among themselves, with this weight of a fall (``pgpe.paired_ranks``)."""


class RunPlan(Record, frozen=True, kw_only=True):
    """A whole run."""

    format: Literal[1] = 1
    name: Name
    robot: str
    config: str
    """Hash of the robot's config (``training.provenance``)."""
    seed: Annotated[int, Meta(ge=0)] = 0
    variant: Literal["linear", "linear-plain", "linear-grf", "mlp", "mlp-plain", "mlp-grf"] = "linear"
    terms: bool = True
    """The fixed terms around the matrix (method: Past the teacher); off is the paper's letter."""
    without: tuple[Term, ...] = ()
    """Fixed terms that are off all the same."""
    reference: Literal["rigid-body", "robot"] = "rigid-body"
    physics_rate_hz: Positive = PHYSICS_RATE_HZ
    start: str = ""
    """Policy file whose numbers are the first mean; empty starts from zero."""
    stages: tuple[StagePlan, ...]

    def shortened(self, iterations: int | None, directions: int | None, ticks: int | None) -> RunPlan:
        """The same plan with other counts in every stage; None keeps the stage's own."""
        changes = {"iterations": iterations, "directions": directions, "ticks": ticks}
        given = {name: value for name, value in changes.items() if value is not None}
        return msgspec.structs.replace(
            self, stages=tuple(msgspec.structs.replace(stage, **given) for stage in self.stages)
        )


IMITATE = StagePlan(
    name="imitate", reward="table", iterations=20, ticks=400, conditions="noisy", symmetry="both",
    learning_rate=0.1, learning_rate_end=0.04,
)  # fmt: skip
"""From nothing to a walk, with the paper's 64 directions: with 32, one seed of five does not pass the teacher."""
SERVE = StagePlan(
    name="serve", reward="task", iterations=40, ticks=520, conditions="task", symmetry="both",
    stdev=0.05, stdev_learning_rate=0.0, learning_rate=0.03, learning_rate_end=0.01, fall_weight=2.5,
)  # fmt: skip
"""From a walk to one that follows commands and takes pushes."""
SHED = msgspec.structs.replace(
    SERVE, name="shed", iterations=60, conditions="wide", learning_rate=0.03, learning_rate_end=0.003, fall_weight=8.0,
    weight_decay=1.0,
)  # fmt: skip
"""Numbers that grew while nothing asked for them make a robot fall that is pushed hard: they fade here."""
POLISH = msgspec.structs.replace(
    SERVE, name="polish", iterations=180, stdev=0.04, learning_rate=0.02, learning_rate_end=0.001,
    fall_weight=5.0, weight_decay=0.1,
)  # fmt: skip
"""What was shed is won back, where it serves."""
SETTLE = msgspec.structs.replace(
    POLISH, name="settle", iterations=90, conditions="weak", stdev=0.03, learning_rate=0.008,
    learning_rate_end=0.0008, weight_decay=0.05, rest=True, contact_scale=0.2,
)  # fmt: skip
"""From numbers that walk: what stands asks for nothing, and motors may be weak. Small steps keep what was polished."""
HARDEN = msgspec.structs.replace(
    SETTLE, name="harden", iterations=40, ticks=800, conditions="hard", learning_rate=0.008, learning_rate_end=0.0008,
)  # fmt: skip
"""What little friction, a hard torque clip and hard pushes still take down."""
ROUGHEN = msgspec.structs.replace(
    POLISH, name="roughen", iterations=60, directions=48, ticks=800, conditions="rough", learning_rate=0.015,
    learning_rate_end=0.0015, rest=True, contact_scale=0.2, swing_lift=0.05,
)  # fmt: skip
"""The same on uneven ground, which takes longer to cross."""
PAPER = StagePlan(name="imitate", reward="table", iterations=60, conditions="imitation", symmetry="none")
"""Section IV.B: 64 directions, 1000 ticks, 60 iterations; with the sensors' noise, without which nothing transfers."""


def make_plan(
    name: str,
    robot: str,
    config: str,
    *,
    seed: int = 0,
    variant: str = "linear",
    start: str = "",
    paper: bool = False,
    rough: bool = False,
    reference: str = "rigid-body",
    without: Sequence[str] = (),
) -> RunPlan:
    """The plan of a ``trotd train`` from nothing, from a policy's numbers, by the paper's letter or on rough ground."""
    stages: tuple[StagePlan, ...] = (
        (PAPER,) if paper else (ROUGHEN,) if rough else (IMITATE, SERVE, SHED, POLISH, SETTLE, HARDEN)
    )
    if start and not paper and not rough:
        stages = (SETTLE, HARDEN)
    if variant.endswith("plain"):  # commands mean nothing to it: it can only imitate one
        stages = tuple(stage for stage in stages if stage.reward == "table") or stages
    return msgspec.convert(
        {
            "name": name, "robot": robot, "config": config, "seed": seed, "variant": variant, "terms": not paper,
            "start": start, "reference": reference, "stages": stages, "without": find_terms(without),
        },
        RunPlan,
    )  # fmt: skip
