"""Contenders in the same trials: same seeds, noise and latency, each on its own estimate; who falls, how far off."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import numpy as np

from drivers.robot import Array, JointCommand, Measurement
from runtime import policies
from runtime.config import Config
from runtime.control.controller import Controller
from runtime.control.policy import balance_policy
from runtime.control.records import Records, VelocityCommand
from runtime.policies import PolicyError
from sim.scenario import Scenario
from sim.world import World
from training.mpc_controller import MpcController
from training.randomize import Conditions
from training.reward import TASK_TERMS, TaskReward
from training.rollout import LOWEST, Walker, walk
from training.score import score_task
from training.variants import TERMS, Term, Variant, find_terms, make_policy, with_parameters, without_terms

BUILT_IN = ("mpc", "mpc-tuned", "zero", "balance")
SETTLE = 2.0
"""s at the start of a trial that velocity errors do not count."""
Kind = Literal["policy", "mpc", "mpc-tuned", "zero", "balance"]


@dataclass(frozen=True, slots=True)
class Contender:
    """Who walks: one of ``BUILT_IN``, or a policy file."""

    name: str
    kind: Kind
    path: str = ""
    without: tuple[Term, ...] = ()
    """Fixed terms of the policy file that are off."""

    def walker(self, config: Config) -> Walker:
        """Its controller, new."""
        height = config.control.gait.walking_height
        if self.kind in ("mpc", "mpc-tuned"):
            return MpcController(config, terms=self.kind == "mpc-tuned")
        if self.kind == "policy":
            policy = without_terms(policies.load(Path(self.path), config.robot.name), self.without)
        elif self.kind == "balance":
            policy = balance_policy(config.robot, height)
        else:
            template = make_policy(config.robot, height, Variant(), terms=False, name="zero")
            policy = with_parameters(template, np.zeros(504))
        return Controller(config.robot, config.control, policy)


def find_contender(name: str, beside: Path | None = None) -> Contender:
    """The contender that ``name`` means: a built-in one, a policy file or a shipped policy.

    Raises:
        PolicyError: none of these.
    """
    if name in BUILT_IN:
        return Contender(name, name)  # type: ignore[arg-type]
    path = policies.find_policy(name, beside)
    return Contender(path.stem, "policy", str(path))


def find_contenders(names: Sequence[str], beside: Path | None = None) -> list[Contender]:
    """Each name's contender once, in order; policies whose files are called alike go by what they were asked for by.

    Raises:
        PolicyError: one is none of those that ``find_contender`` knows.
    """
    found: dict[Contender, str] = {}
    for name in names:
        found.setdefault(find_contender(name, beside), name)
    count = Counter(contender.name for contender in found)
    return [replace(one, name=asked) if count[one.name] > 1 else one for one, asked in found.items()]


def ablated(contender: Contender, terms: Sequence[str]) -> list[Contender]:
    """The contender once without each of ``terms``; "all" stands for one column each and one without any.

    Raises:
        PolicyError: no such term, or the contender is no policy file.
    """
    if terms and contender.kind != "policy":
        raise PolicyError(f"{contender.name} is no policy file: only those have terms that can be off")
    each = TERMS if "all" in terms else find_terms(terms)
    alone = [replace(contender, name=f"no {name}", without=(name,)) for name in each]
    return [*alone, replace(contender, name="no term", without=TERMS)] if "all" in terms else alone


@dataclass(frozen=True, slots=True)
class Trial:
    """One walk under stated conditions."""

    conditions: Conditions
    seconds: float


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a trial."""

    fell: bool
    seconds: float
    """Until the end or the fall."""
    velocity: tuple[float, float, float]
    """Mean vx, vy, yaw rate after ``SETTLE``, heading frame."""
    height: float
    """Mean above the ground after ``SETTLE``, m."""
    peak_torque: float
    rms_torque: float
    """Largest of the twelve, N·m."""
    task_return: float
    """Of the second stage's reward."""
    compute: float
    """Median time of a controller's step, s."""


TRACE_COLUMNS = {
    "position": slice(0, 3), "rpy": slice(3, 6), "velocity": slice(6, 9), "angular_velocity": slice(9, 12),
    "joint_position": slice(12, 24), "joint_velocity": slice(24, 36), "joint_torque": slice(36, 48),
    "grf": slice(48, 60), "stance": slice(60, 64),
}  # fmt: skip
"""Where what stands in a row of a trace; world frame, forces in the heading frame."""


def run_trial(config: Config, world: World, walker: Walker, trial: Trial, trace: list[Array] | None = None) -> Outcome:
    """Walk it. ``trace`` collects a row (64,) each tick, as ``TRACE_COLUMNS`` says."""
    rate = config.control.rate_hz
    commands = np.tile(np.array(trial.conditions.command or (0.0, 0.0, 0.0)), (round(trial.seconds * rate), 1))
    tally = _Tally(config, world, walker, trial.conditions.scenario, trace)
    timed = _Timed(walker)
    steps, fell = walk(world, timed, trial.conditions, commands, tally.watch)
    return tally.outcome(steps / rate, fell, timed.median)


class _Timed:
    """A walker with a stopwatch."""

    def __init__(self, walker: Walker) -> None:
        self._walker, self._times = walker, [0.0]
        self.record: Records = walker.record
        self.geometry: Records = walker.geometry
        self.reset = walker.reset

    def step(self, measurement: Measurement, command: VelocityCommand, standing: bool = False) -> JointCommand:
        """One tick, timed."""
        began = time.perf_counter()
        answer = self._walker.step(measurement, command, standing)
        self._times.append(time.perf_counter() - began)
        return answer

    @property
    def median(self) -> float:
        """s a step."""
        return float(np.median(self._times))


class _Tally:
    """Sums over a trial."""

    def __init__(
        self, config: Config, world: World, walker: Walker, scenario: Scenario, trace: list[Array] | None
    ) -> None:
        self._world, self._walker, self._trace = world, walker, trace
        self._ground, self._table = scenario.terrain, TaskReward().table()
        self._height = config.control.gait.walking_height
        self._settle = round(SETTLE * config.control.rate_hz)
        self._geometry: Records = walker.geometry
        self._smoothed, self._sums = np.zeros(3), np.zeros(len(TASK_TERMS))
        self._velocity, self._above, self._count = np.zeros(3), 0.0, 0
        self._squares, self._peak = np.zeros((4, 3)), 0.0
        self._ticks = 0

    def watch(self, tick: int, command: Array) -> bool:
        """Add a tick."""
        truth = self._world.truth
        x, y, z = truth.position.tolist()
        above = z - self._ground.height_at(x, y)
        score_task(
            self._table, self._world.period, self._smoothed, command, above - self._height, self._world.body,
            self._world.joints, truth.foot_contacts, self._geometry, self._sums,
        )  # fmt: skip
        self._squares += truth.joint_torque**2
        self._peak = max(self._peak, float(np.abs(truth.joint_torque).max()))
        self._ticks += 1
        if tick >= self._settle:
            rotation = truth.rotation_body_to_world
            c, s = rotation[:2, 0] / np.hypot(rotation[0, 0], rotation[1, 0])
            vx, vy = truth.linear_velocity[:2]
            self._velocity += [c * vx + s * vy, -s * vx + c * vy, truth.angular_velocity[2]]
            self._above += above
            self._count += 1
        if self._trace is not None:
            self._trace.append(self._row())
        return bool(above > LOWEST * self._height)

    def _row(self) -> Array:
        truth, record = self._world.truth, self._walker.record[0]
        return np.concatenate([
            truth.position, record["rpy"], truth.linear_velocity, truth.angular_velocity,
            truth.joint_position.ravel(), truth.joint_velocity.ravel(), truth.joint_torque.ravel(),
            record["grf"].ravel(), record["stance"],
        ])  # fmt: skip

    def outcome(self, seconds: float, fell: bool, compute: float) -> Outcome:
        """All that was summed, as means."""
        count = max(self._count, 1)
        vx, vy, turn = (self._velocity / count).tolist()
        return Outcome(
            fell=fell,
            seconds=seconds,
            velocity=(vx, vy, turn),
            height=self._above / count,
            peak_torque=self._peak,
            rms_torque=float(np.sqrt(self._squares.max() / max(self._ticks, 1))),
            task_return=float(self._sums.sum()),
            compute=compute,
        )


@dataclass(slots=True)
class _Ring:
    """Where a worker process lets contenders walk."""

    config: Config
    world: World
    walkers: dict[Contender, Walker]


_ring: _Ring | None = None


def _enter(config: Config) -> None:
    global _ring
    control = config.control
    _ring = _Ring(config, World(config.robot, control.rate_hz, control.gait.walking_height), {})


def _play(contender: Contender, trial: Trial) -> Outcome:
    assert _ring is not None, "a worker starts with _enter"
    if contender not in _ring.walkers:
        _ring.walkers[contender] = contender.walker(_ring.config)
    return run_trial(_ring.config, _ring.world, _ring.walkers[contender], trial)


class Contest:
    """Worker processes that play (contender, trial) pairs; ``with`` lets them go."""

    def __init__(self, config: Config, workers: int) -> None:
        self.walking_height = config.control.gait.walking_height
        """What the body's height is judged by, m."""
        self._pool = ProcessPoolExecutor(workers, get_context("spawn"), _enter, (config,))

    def __enter__(self) -> Contest:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def play(self, contender: Contender, trials: Sequence[Trial]) -> list[Outcome]:
        """All trials of one contender, in order."""
        futures = [self._pool.submit(_play, contender, trial) for trial in trials]
        return [future.result() for future in futures]
