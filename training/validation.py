"""The walks that judge a run's policies: the kinds of the table's rows, under seeds of their own."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, sin

import numpy as np

from sim.scenario import Push, Scenario
from sim.terrain import HeightField
from training.contest import Trial
from training.randomize import SENSORS, Conditions, Randomization, draw
from training.table import CLIPPED, CYCLE, HARD_COMMANDS

VALIDATION_SEED = 5_000
"""Of the episodes that judge; apart from training's and from the table's."""
DRAWS = 96
"""Episodes drawn at random, whose return counts."""
STANDING_TIME = 20.0
"""s: what leans a little more every second has fallen by then."""
FORWARD, SIDEWAYS = 60.0, 50.0
"""N·s of the pushes along and across: 5 more than is asked of the shipped policy, where nearly all stand."""
PHASES = 8


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
    hard = _steep_fields() if bounds.bump else _pushes() + _clipped_torques()
    return ValidationSet(_measured(), hard, [Trial(draw(bounds, rng), 2.6) for _ in range(DRAWS)])


def _measured() -> list[Trial]:
    commands = ((0.0, 0.0, 0.0), (0.8, 0.0, 0.0), (-0.4, 0.0, 0.0), (1.6, 0.0, 0.0), (0.0, 0.3, 0.0), (0.5, 0.0, 0.5))
    walks = [Trial(Conditions(_noisy(0), command), 5.0) for command in commands]
    return [*walks, Trial(Conditions(_noisy(0), (0.0, 0.0, 0.0), standing=True), STANDING_TIME)]


def _pushes() -> list[Trial]:
    return [
        Trial(Conditions(_noisy(phase, pushes=(_push(phase, direction, impulse),)), (0.4, 0.0, 0.0)), 3.5)
        for phase in range(PHASES)
        for direction, impulse in ((0.0, FORWARD), (pi / 2, SIDEWAYS), (pi, FORWARD), (-pi / 2, SIDEWAYS))
    ]


def _push(phase: int, direction: float, impulse: float) -> Push:
    force = impulse / 0.1
    return Push(1.6 + CYCLE * phase / PHASES, 0.1, (force * cos(direction), force * sin(direction), 0.0))


def _clipped_torques() -> list[Trial]:
    return [
        Trial(Conditions(_noisy(seed, motor_strength=CLIPPED), HARD_COMMANDS[seed % len(HARD_COMMANDS)]), 5.0)
        for seed in range(16)
    ]


def _steep_fields() -> list[Trial]:
    grounds = [HeightField(0.08, 0.10, VALIDATION_SEED + seed, extent=24.0) for seed in range(16)]
    return [Trial(Conditions(_noisy(0, terrain=ground), (0.5, 0.0, 0.0)), 12.0) for ground in grounds]


def _noisy(seed: int, **changes: object) -> Scenario:
    return Scenario(seed=VALIDATION_SEED + seed, noise=SENSORS, **changes)  # type: ignore[arg-type]
