"""The test table: named tests, each a set of trials and what is read off their outcomes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import pi, radians

import numpy as np

from sim.scenario import Noise, Scenario
from sim.terrain import HeightField, Slope, Steps
from training.contest import Contender, Contest, Outcome, Trial
from training.randomize import SENSORS, TASK, Conditions, draw
from training.walks import CLIPPED, Command, Walks

Cells = dict[str, float]
"""What a test says of a contender: column → number."""
Test = Callable[[Contest, Contender], Cells]

GRID: tuple[Command, ...] = (
    (0.0, 0.0, 0.0), (0.4, 0.0, 0.0), (-0.4, 0.0, 0.0), (0.8, 0.0, 0.0), (1.2, 0.0, 0.0), (1.6, 0.0, 0.0),
    (0.0, 0.3, 0.0), (0.0, -0.3, 0.0), (0.0, 0.0, 0.8), (0.0, 0.0, -0.8), (0.5, 0.0, 0.5),
)  # fmt: skip
ADULT_SEED = 10_000
"""Test seeds start here: no training iteration draws from them."""
WALKS = Walks(ADULT_SEED)


@dataclass(frozen=True, slots=True)
class Size:
    """How much is tested."""

    seeds: int = 20
    walk: float = 60.0
    """s of each velocity of the grid."""
    draws: int = 200
    phases: int = 8
    push_step: float = 2.5
    """N·s: how finely the push is searched."""


QUICK = Size(seeds=4, walk=6.0, draws=24, phases=4, push_step=5.0)
FULL = Size()


def make_tests(size: Size) -> dict[str, Test]:
    """Every test by name, in the order of the report."""
    return {
        "velocity, noisy": lambda contest, who: _grid(contest, who, size, SENSORS),
        "velocity, clean": lambda contest, who: _grid(contest, who, size, Noise()),
        "standing": lambda contest, who: _stand(contest, who, size),
        "forward 2.0 m/s": lambda contest, who: _survive(contest, who, [WALKS.follow((2.0, 0.0, 0.0), size.walk)]),
        "push sideways": lambda contest, who: _push(contest, who, size, pi / 2),
        "push forward": lambda contest, who: _push(contest, who, size, 0.0),
        "start ±20° pitch, ±15° roll": lambda contest, who: _survive(contest, who, _tilted(size)),
        "start at U[0, π/6]": lambda contest, who: _survive(contest, who, _thrown(size)),
        "18 N·m": lambda contest, who: _hard(contest, who, size, motor_strength=CLIPPED),
        "10 ms later": lambda contest, who: _hard(contest, who, size, extra_delay=0.010),
        "+5 kg": lambda contest, who: _hard(contest, who, size, payload=5.0),
        "friction 0.3": lambda contest, who: _hard(contest, who, size, friction=0.3),
        "motors at 80 %": lambda contest, who: _hard(contest, who, size, motor_strength=0.8),
        "task draws": lambda contest, who: _draws(contest, who, size),
    }


def make_rough_tests(size: Size) -> dict[str, Test]:
    """What the ground does."""

    def fields(amplitude: float, spacing: float) -> Test:
        seeds = range(ADULT_SEED, ADULT_SEED + size.seeds)
        grounds = [HeightField(amplitude, spacing, seed, extent=24.0) for seed in seeds]
        return lambda contest, who: _survive(contest, who, [WALKS.cross(ground, 20.0) for ground in grounds])

    def slopes(direction: float) -> Test:
        ground = Slope(radians(12.0), direction)
        return lambda contest, who: _survive(
            contest, who, [WALKS.cross(ground, 10.0, seed) for seed in range(size.seeds)]
        )

    return {
        "±5 cm, 0.10 m": fields(0.05, 0.10),
        "±8 cm, 0.25 m": fields(0.08, 0.25),
        "±8 cm, 0.10 m": fields(0.08, 0.10),
        "12° up": slopes(0.0),
        "12° down": slopes(pi),
        "12° across": slopes(pi / 2),
        "steps of 6 cm": lambda contest, who: _survive(
            contest, who, [WALKS.cross(Steps(0.06, depth=0.35, count=3), 12.0, seed) for seed in range(size.seeds)]
        ),
    }


def _grid(contest: Contest, who: Contender, size: Size, noise: Noise) -> Cells:
    trials = [Trial(Conditions(Scenario(seed=ADULT_SEED, noise=noise), command), size.walk) for command in GRID]
    outcomes = contest.play(who, trials)
    errors = np.abs(np.array([outcome.velocity for outcome in outcomes]) - np.array(GRID))
    return {
        "vx error m/s": float(errors[:, 0].mean()),
        "vy error m/s": float(errors[:, 1].mean()),
        "worst m/s": float(errors[:, :2].max()),
        "turn error rad/s": float(errors[:, 2].mean()),
        "falls": float(sum(outcome.fell for outcome in outcomes)),
        "step µs": float(np.median([outcome.compute for outcome in outcomes])) * 1e6,
    }


def _stand(contest: Contest, who: Contender, size: Size) -> Cells:
    outcomes = contest.play(who, [WALKS.stand(seed) for seed in range(size.seeds)])
    errors = np.array([outcome.height for outcome in outcomes]) - contest.walking_height
    return {"height error mm": 1e3 * float(np.abs(errors).max()), "falls": float(sum(o.fell for o in outcomes))}


def _survive(contest: Contest, who: Contender, trials: list[Trial]) -> Cells:
    outcomes = contest.play(who, trials)
    return {"stood": float(sum(not outcome.fell for outcome in outcomes)), "of": float(len(trials))}


def _hard(contest: Contest, who: Contender, size: Size, **changes: object) -> Cells:
    return _survive(contest, who, WALKS.hard(size.seeds, **changes))


def _tilted(size: Size) -> list[Trial]:
    pitch, roll = radians(20.0), radians(15.0)
    corners = [(r * roll, p * pitch, 0.0) for r in (-1, 1) for p in (-1, 1)]
    corners += [(roll, 0.0, 0.0), (-roll, 0.0, 0.0), (0.0, pitch, 0.0), (0.0, -pitch, 0.0)]
    return [
        Trial(Conditions(WALKS.scenario(seed, rpy=corners[seed % len(corners)]), (0.3, 0.0, 0.0)), 4.0)
        for seed in range(size.seeds)
    ]


def _thrown(size: Size) -> list[Trial]:
    rng = np.random.default_rng(ADULT_SEED)
    angles = rng.uniform(0.0, pi / 6, (size.seeds, 3)).tolist()
    return [
        Trial(Conditions(WALKS.scenario(seed, rpy=tuple(rpy)), (0.3, 0.0, 0.0)), 4.0) for seed, rpy in enumerate(angles)
    ]


def _push(contest: Contest, who: Contender, size: Size, direction: float) -> Cells:
    """Largest impulse that every phase and both signs survive, by bisection on a grid of ``push_step``."""
    low, high = 0, round(100.0 / size.push_step)
    while high - low > 1:
        middle = (low + high) // 2
        outcomes = contest.play(who, WALKS.pushed(direction, middle * size.push_step, size.phases))
        low, high = (low, middle) if any(outcome.fell for outcome in outcomes) else (middle, high)
    return {"N·s": low * size.push_step}


def _draws(contest: Contest, who: Contender, size: Size) -> Cells:
    rng = np.random.default_rng(ADULT_SEED)
    outcomes: list[Outcome] = contest.play(who, [Trial(draw(TASK, rng), 2.6) for _ in range(size.draws)])
    return {
        "return": float(np.mean([outcome.task_return for outcome in outcomes])),
        "falls %": 100.0 * float(np.mean([outcome.fell for outcome in outcomes])),
    }
