"""The walks that judge: what the test table and a run's validation set are made of, each under its own seeds."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin

from sim.scenario import Push, Scenario
from sim.terrain import Terrain
from training.contest import Trial
from training.randomize import SENSORS, Conditions

Command = tuple[float, float, float]

CYCLE = 0.4
"""s; pushes come at phases of it."""
CLIPPED = 18.0 / 40.0
"""Strength of motors whose torque is clipped at 18 of their 40 N·m."""
HARD_COMMANDS: tuple[Command, ...] = ((0.5, 0.0, 0.0), (0.0, 0.2, 0.0), (0.3, 0.0, 0.4), (0.0, 0.0, 0.0))
"""Of walks with less than the robot should have, in turn."""


@dataclass(frozen=True, slots=True)
class Walks:
    """Trials with the sensors' noise, whose seeds begin at ``first_seed``."""

    first_seed: int

    def scenario(self, seed: int = 0, **changes: object) -> Scenario:
        """The ``seed``-th of these seeds, otherwise as ``changes`` say."""
        return Scenario(seed=self.first_seed + seed, noise=SENSORS, **changes)  # type: ignore[arg-type]

    def follow(self, command: Command, seconds: float) -> Trial:
        """A velocity command (m/s, m/s, rad/s) on level ground."""
        return Trial(Conditions(self.scenario(), command), seconds)

    def stand(self, seed: int) -> Trial:
        """Twenty seconds at rest: what leans a little more every second has fallen by then."""
        return Trial(Conditions(self.scenario(seed), (0.0, 0.0, 0.0), standing=True), 20.0)

    def pushed(self, direction: float, impulse: float, phases: int) -> list[Trial]:
        """Pushes of ``impulse`` N·s in 0.1 s along ``direction`` (rad) and against it, at ``phases`` of the gait."""
        trials = []
        for phase in range(phases):
            for sign in (1.0, -1.0):
                force = sign * impulse / 0.1
                push = Push(2.0 + CYCLE * phase / phases, 0.1, (force * cos(direction), force * sin(direction), 0.0))
                trials.append(Trial(Conditions(self.scenario(phase, pushes=(push,)), (0.4, 0.0, 0.0)), 4.5))
        return trials

    def hard(self, count: int, **changes: object) -> list[Trial]:
        """The hard commands in turn, ``count`` walks, on a robot that has less than it should."""
        return [
            Trial(Conditions(self.scenario(seed, **changes), HARD_COMMANDS[seed % len(HARD_COMMANDS)]), 5.0)
            for seed in range(count)
        ]

    def cross(self, terrain: Terrain, seconds: float, seed: int = 0) -> Trial:
        """Over ``terrain`` at 0.5 m/s."""
        return Trial(Conditions(self.scenario(seed, terrain=terrain), (0.5, 0.0, 0.0)), seconds)
