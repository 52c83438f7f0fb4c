"""The walks that judge a run's policies: the kinds of the table's rows, under seeds of their own."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np

from sim.terrain import HeightField
from training.contest import Trial
from training.randomize import Randomization, draw
from training.walks import CLIPPED, Walks

VALIDATION_SEED = 5_000
"""Of the episodes that judge; apart from training's and from the table's."""
WALKS = Walks(VALIDATION_SEED)
DRAWS = 96
"""Episodes drawn at random, whose return counts."""
FORWARD, SIDEWAYS = 60.0, 50.0
"""N·s of the pushes along and across: 5 more than is asked of the shipped policy, where nearly all stand."""
PHASES = 8
CLIPPED_WALKS = 48
"""With torques clipped, where policies of one run differ most: of 16 one tells a fall in twenty by chance."""
SMOOTH_WALKS = 32
"""With friction 0.3."""
FIELDS = 40
"""Of each lattice of steep ground: of 16 all policies of one run fell on none to two."""


@dataclass(frozen=True, slots=True)
class ValidationSet:
    """Three kinds of walks."""

    measured: list[Trial]
    """Commands on level ground, whose velocities are compared with what was asked."""
    hard: list[Trial]
    """To be survived."""
    drawn: list[Trial]
    """Random draws, whose return counts."""


def validation_set(bounds: Randomization) -> ValidationSet:
    """``bounds`` of the draws; where they hold uneven ground, the hard walks cross the steepest of it."""
    rng = np.random.default_rng(VALIDATION_SEED)
    return ValidationSet(
        measured=_measured(),
        hard=_steep_fields() if bounds.bump else _taken_down(),
        drawn=[Trial(draw(bounds, rng), 2.6) for _ in range(DRAWS)],
    )


def _measured() -> list[Trial]:
    commands = ((0.0, 0.0, 0.0), (0.8, 0.0, 0.0), (-0.4, 0.0, 0.0), (1.6, 0.0, 0.0), (0.0, 0.3, 0.0), (0.5, 0.0, 0.5))
    return [*(WALKS.follow(command, 5.0) for command in commands), WALKS.stand(0)]


def _taken_down() -> list[Trial]:
    pushes = WALKS.pushed(0.0, FORWARD, PHASES) + WALKS.pushed(pi / 2, SIDEWAYS, PHASES)
    return pushes + WALKS.hard(CLIPPED_WALKS, motor_strength=CLIPPED) + WALKS.hard(SMOOTH_WALKS, friction=0.3)


def _steep_fields() -> list[Trial]:
    """On one lattice a foot is caught between cells, on the other it climbs: policies fall on either."""
    seeds = range(VALIDATION_SEED, VALIDATION_SEED + FIELDS)
    return [WALKS.cross(HeightField(0.08, cell, seed, extent=24.0), 20.0) for cell in (0.10, 0.25) for seed in seeds]
