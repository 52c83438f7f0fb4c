"""What a training run does, as data: it is saved beside its results and read again to resume."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from drivers.description import Name, NonNegative, Positive, Record

Count = Annotated[int, Meta(ge=1)]


class StagePlan(Record, frozen=True, kw_only=True):
    """One stage: a reward, conditions and a learning rate."""

    name: Name
    reward: Literal["table", "task"]
    """``table`` imitates the reference (Table I), ``task`` is the second stage's own reward."""
    iterations: Count
    directions: Count = 64
    ticks: Count = 1000
    conditions: str = "imitation"
    """One of ``training.randomize.SETS``."""
    symmetry: Literal["none", "left-right", "both"] = "left-right"
    stdev: Positive = 0.1
    stdev_learning_rate: NonNegative = 0.1
    learning_rate: Positive = 0.05
    learning_rate_end: Positive = 0.05
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
    variant: str = "linear"
    terms: bool = True
    """The fixed terms around the matrix (method: Past the teacher); off is the paper's letter."""
    reference: Literal["rigid-body", "robot"] = "rigid-body"
    physics_rate_hz: Positive = 600.0
    """Of the training's simulator; validation runs at 1000."""
    start: str = ""
    """Policy file whose numbers are the first mean; empty starts from zero."""
    stages: tuple[StagePlan, ...]


IMITATE = StagePlan(name="imitate", reward="table", iterations=20)
IMITATE_BOTH = StagePlan(name="imitate", reward="table", iterations=20, symmetry="both")
SERVE = StagePlan(
    name="serve", reward="task", iterations=45, ticks=520, conditions="task", symmetry="both", stdev=0.05,
    stdev_learning_rate=0.0, learning_rate=0.03, learning_rate_end=0.003, fall_weight=2.5,
)  # fmt: skip
ROUGHEN = StagePlan(
    name="roughen", reward="task", iterations=30, ticks=800, conditions="rough", symmetry="both", stdev=0.05,
    stdev_learning_rate=0.0, learning_rate=0.02, learning_rate_end=0.002, fall_weight=2.5,
)  # fmt: skip
PAPER = StagePlan(
    name="imitate", reward="table", iterations=60, conditions="paper", symmetry="none"
)  # fmt: skip
