"""Faults of the computer, its clock, its policies and its solvers; and what happens to the robot from outside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from drivers.robot import Array
from faults.rig import Fault, Rig
from runtime import policies
from runtime.control.grf import GrfProblem
from runtime.control.policy import Policy
from runtime.messages.mode import Request


@dataclass
class Stall(Fault):
    """The loop does not run for a while, once."""

    seconds: float

    def start(self, rig: Rig) -> None:
        self._missed = max(1, round(self.seconds / rig.period))

    def stall(self, rig: Rig) -> int:
        missed, self._missed = self._missed, 0
        return missed


@dataclass
class ClockStep(Fault):
    """The clock that stamps everything jumps."""

    seconds: float

    def start(self, rig: Rig) -> None:
        rig.clock.step += self.seconds


@dataclass
class SpoiltPolicy(Fault):
    """Numbers of the active policy's memory become something else: what no file can bring, a broken bit could."""

    places: Sequence[tuple[int, int]]
    value: float

    def start(self, rig: Rig) -> None:
        matrix = rig.cycle.controller.policy_record["matrix"][0]
        for observation, action in self.places:
            matrix[observation, action] = self.value


@dataclass
class WildPolicy(Fault):
    """A policy that the door lets in, with numbers as large as a file may hold, takes over."""

    scale: float
    seed: int

    def start(self, rig: Rig) -> None:
        policy = rig.cycle.policy
        draw = np.random.default_rng(self.seed).uniform(-self.scale, self.scale, (18, 28))
        wild: Policy = msgspec.structs.replace(
            policy, name="wild", matrix=tuple(tuple(row) for row in draw.tolist()), action_scale=(1e3,) * 18
        )
        policies.verify(wild, rig.config.robot.name, "candidate")
        rig.cycle.swap_policy(wild)


@dataclass
class RefusedPolicy(Fault):
    """A policy file that must not get in: of another robot, or with a number that is none."""

    spoilt: tuple[str, str]
    """What is replaced in the active policy's file, by what."""

    def start(self, rig: Rig) -> None:
        from runtime.control.policy import encode_policy

        data = encode_policy(rig.cycle.policy).decode()
        assert self.spoilt[0] in data
        try:
            policy = policies.decode(data.replace(*self.spoilt, 1).encode(), rig.config.robot.name, "candidate")
        except policies.PolicyError:
            return
        rig.cycle.swap_policy(policy)
        raise AssertionError("the door let it in")


@dataclass
class EmergencyStop(Fault):
    """The operator asks for damp."""

    def start(self, rig: Rig) -> None:
        rig.ask(Request.DAMP)


@dataclass
class LostOperator(Fault):
    """No velocity command comes any more."""

    def start(self, rig: Rig) -> None:
        rig.velocity = None


@dataclass
class Push(Fault):
    """Somebody pushes the body: N in the world frame, s."""

    force: tuple[float, float, float]
    seconds: float

    def start(self, rig: Rig) -> None:
        rig.world.push(self.force, self.seconds)


@dataclass
class PolicyWhileFalling(Fault):
    """The robot is knocked over, and on its way down another policy takes over."""

    push: Push
    after: float
    policy: Fault

    def start(self, rig: Rig) -> None:
        self.push.start(rig)
        self._at: float | None = rig.now + self.after

    def stall(self, rig: Rig) -> int:
        if self._at is not None and rig.now >= self._at:
            self._at = None
            self.policy.start(rig)
        return 0


class BadSolver:
    """Answers as ``kind`` says: ``none``, ``nan``, ``raise``, ``garbage`` or, after asking a good one, ``off``."""

    def __init__(self, kind: str, good: Any, seed: int) -> None:
        self.kind, self.good = kind, good
        self.asked = 0
        self._random = np.random.default_rng(seed)

    def solve(self, problem: GrfProblem) -> Array | None:
        self.asked += 1
        size = len(problem.gradient)
        match self.kind:
            case "none":
                return None
            case "nan":
                return np.full(size, np.nan)
            case "raise":
                raise ArithmeticError("injected")
            case "garbage":
                return self._random.uniform(-1e4, 1e4, size)
            case "off":
                force = self.good.solve(problem)
                return None if force is None else force + self._random.normal(0.0, 30.0, size)
        raise AssertionError(self.kind)


@dataclass
class SolverFault(Fault):
    """The first solver, or both, give up, lie, or raise."""

    first: str
    second: str | None
    seed: int

    def start(self, rig: Rig) -> None:
        ladder = rig.cycle.controller.ladder
        ladder.first = BadSolver(self.first, ladder.first, self.seed)
        self._bad = [ladder.first]
        if self.second is not None:
            ladder.second = BadSolver(self.second, ladder.second, self.seed)
            self._bad.append(ladder.second)

    def happened(self) -> bool:
        return all(solver.asked for solver in self._bad)


@dataclass
class Infeasible(Fault):
    """No force can be: each leg must press harder than it may."""

    def start(self, rig: Rig) -> None:
        controller = rig.cycle.controller
        controller.parameters["min_force"] = 2.0 * controller.parameters["max_force"]
        controller.problems = [problem._replace(min_force=2.0 * problem.max_force) for problem in controller.problems]


@dataclass
class SpoiltProblem(Fault):
    """The robot's mass is not a number from one tick to the next, and with it the force problem."""

    name: str

    def start(self, rig: Rig) -> None:
        rig.cycle.controller.parameters[self.name] = np.nan


@dataclass
class SlowSolver(Fault):
    """Each solution takes some ticks, for a while: the loop misses as many deadlines."""

    ticks: int
    seconds: float

    def start(self, rig: Rig) -> None:
        self._end = rig.body.now + self.seconds

    def stall(self, rig: Rig) -> int:
        return self.ticks if rig.body.now < self._end else 0
