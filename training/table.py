"""The test table: named tests, each a set of trials and what is read off their outcomes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import cos, pi, radians, sin

import numpy as np

from sim.scenario import Noise, Push, Scenario
from sim.terrain import HeightField, Slope, Steps, Terrain
from training.contest import Contender, Contest, Outcome, Trial
from training.randomize import SENSORS, TASK, Conditions, draw

Command = tuple[float, float, float]
Cells = dict[str, float]
"""What a test says of a contender: column → number."""
Test = Callable[[Contest, Contender], Cells]

GRID: tuple[Command, ...] = (
    (0.0, 0.0, 0.0), (0.4, 0.0, 0.0), (-0.4, 0.0, 0.0), (0.8, 0.0, 0.0), (1.2, 0.0, 0.0), (1.6, 0.0, 0.0),
    (0.0, 0.3, 0.0), (0.0, -0.3, 0.0), (0.0, 0.0, 0.8), (0.0, 0.0, -0.8), (0.5, 0.0, 0.5),
)  # fmt: skip
ADULT_SEED = 10_000
"""Test seeds start here: no training iteration draws from them."""
CYCLE = 0.4
"""s; pushes come at eight phases of it."""
CLIPPED = 18.0 / 40.0
"""Strength of motors whose torque is clipped at 18 of their 40 N·m."""
HARD_COMMANDS: tuple[Command, ...] = ((0.5, 0.0, 0.0), (0.0, 0.2, 0.0), (0.3, 0.0, 0.4), (0.0, 0.0, 0.0))
"""Of walks with less than the robot should have, in turn."""


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
        "forward 2.0 m/s": lambda contest, who: _survive(contest, who, _same(_noisy(0), (2.0, 0.0, 0.0), size.walk)),
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
        return lambda contest, who: _survive(contest, who, [_on(ground, 20.0) for ground in grounds])

    def slopes(direction: float) -> Test:
        ground = Slope(radians(12.0), direction)
        return lambda contest, who: _survive(contest, who, [_on(ground, 10.0, seed) for seed in range(size.seeds)])

    return {
        "±5 cm, 0.10 m": fields(0.05, 0.10),
        "±8 cm, 0.25 m": fields(0.08, 0.25),
        "±8 cm, 0.10 m": fields(0.08, 0.10),
        "12° up": slopes(0.0),
        "12° down": slopes(pi),
        "12° across": slopes(pi / 2),
        "steps of 6 cm": lambda contest, who: _survive(
            contest, who, [_on(Steps(0.06, depth=0.35, count=3), 12.0, seed) for seed in range(size.seeds)]
        ),
    }


def _noisy(seed: int, **changes: object) -> Scenario:
    return Scenario(seed=ADULT_SEED + seed, noise=SENSORS, **changes)  # type: ignore[arg-type]


def _same(scenario: Scenario, command: Command, seconds: float) -> list[Trial]:
    return [Trial(Conditions(scenario, command), seconds)]


def _on(terrain: Terrain, seconds: float, seed: int = 0) -> Trial:
    return Trial(Conditions(_noisy(seed, terrain=terrain), (0.5, 0.0, 0.0)), seconds)


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
    standing = [Conditions(_noisy(seed), (0.0, 0.0, 0.0), standing=True) for seed in range(size.seeds)]
    outcomes = contest.play(who, [Trial(conditions, 20.0) for conditions in standing])
    errors = np.array([outcome.height for outcome in outcomes]) - contest.walking_height
    return {"height error mm": 1e3 * float(np.abs(errors).max()), "falls": float(sum(o.fell for o in outcomes))}


def _survive(contest: Contest, who: Contender, trials: list[Trial]) -> Cells:
    outcomes = contest.play(who, trials)
    return {"stood": float(sum(not outcome.fell for outcome in outcomes)), "of": float(len(trials))}


def _hard(contest: Contest, who: Contender, size: Size, **changes: object) -> Cells:
    trials = [
        Trial(Conditions(_noisy(seed, **changes), HARD_COMMANDS[seed % len(HARD_COMMANDS)]), 5.0)
        for seed in range(size.seeds)
    ]
    return _survive(contest, who, trials)


def _tilted(size: Size) -> list[Trial]:
    pitch, roll = radians(20.0), radians(15.0)
    corners = [(r * roll, p * pitch, 0.0) for r in (-1, 1) for p in (-1, 1)]
    corners += [(roll, 0.0, 0.0), (-roll, 0.0, 0.0), (0.0, pitch, 0.0), (0.0, -pitch, 0.0)]
    return [
        Trial(Conditions(_noisy(seed, rpy=corners[seed % len(corners)]), (0.3, 0.0, 0.0)), 4.0)
        for seed in range(size.seeds)
    ]


def _thrown(size: Size) -> list[Trial]:
    rng = np.random.default_rng(ADULT_SEED)
    angles = rng.uniform(0.0, pi / 6, (size.seeds, 3)).tolist()
    return [Trial(Conditions(_noisy(seed, rpy=tuple(rpy)), (0.3, 0.0, 0.0)), 4.0) for seed, rpy in enumerate(angles)]


def _push(contest: Contest, who: Contender, size: Size, direction: float) -> Cells:
    """Largest impulse that every phase and both signs survive, by bisection on a grid of ``push_step``."""
    low, high = 0, round(100.0 / size.push_step)
    while high - low > 1:
        middle = (low + high) // 2
        outcomes = contest.play(who, _pushes(size, direction, middle * size.push_step))
        low, high = (low, middle) if any(outcome.fell for outcome in outcomes) else (middle, high)
    return {"N·s": low * size.push_step}


def _pushes(size: Size, direction: float, impulse: float) -> list[Trial]:
    trials = []
    for phase in range(size.phases):
        for sign in (1.0, -1.0):
            force = sign * impulse / 0.1
            push = Push(2.0 + CYCLE * phase / size.phases, 0.1, (force * cos(direction), force * sin(direction), 0.0))
            trials.append(Trial(Conditions(_noisy(phase, pushes=(push,)), (0.4, 0.0, 0.0)), 4.5))
    return trials


def _draws(contest: Contest, who: Contender, size: Size) -> Cells:
    rng = np.random.default_rng(ADULT_SEED)
    outcomes: list[Outcome] = contest.play(who, [Trial(draw(TASK, rng), 2.6) for _ in range(size.draws)])
    return {
        "return": float(np.mean([outcome.task_return for outcome in outcomes])),
        "falls %": 100.0 * float(np.mean([outcome.fell for outcome in outcomes])),
    }
