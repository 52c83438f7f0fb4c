"""A training tick against the physics steps and PyBullet calls that it contains: what all else costs.

An episode is played with all its calls through PyBullet's module. They are written down, then made once more with
nothing around them: the same torques from the same start, so the same physics. What is measured against them does the
like from compiled code (``sim.bullet.native``) where it can. All times are the processor's.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from trotd.bench.report import Figure, Finding, shown

if TYPE_CHECKING:
    from runtime.control.controller import Controller
    from training.rollout import Stage, Task

Call = tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any]]
TICKS = 400
BOUND = 1.4
PARTS = (
    "physics with the motors' law",
    "commands in, sensors and noise out",
    "the controller without its solver",
    "the solver",
    "reward, contacts and loop",
)


class Listening:
    """The engine's module, with every function call that goes through it written down."""

    def __init__(self, engine: Any) -> None:
        self.calls: list[Call] = []
        self._engine = engine

    def __getattr__(self, name: str) -> Any:
        """A constant as it is, a function with a pen in its hand."""
        target = getattr(self._engine, name)
        if not callable(target):
            return target

        def noted(*args: Any, **kwargs: Any) -> Any:
            self.calls.append((target, args, kwargs))
            return target(*args, **kwargs)

        return noted


def measure(quick: bool) -> Iterator[Finding]:
    """Both rewards, whole episodes and their bare calls in turns; then where a tick's time goes."""
    rounds = 6 if quick else 30
    for reward in ("table", "task"):
        times, parts = _compare(reward, rounds)
        whole, bare, steps = times
        name = f"{reward} reward"
        yield Figure("training", f"{name}: a tick", 1e6 * whole, "µs")
        yield Figure("training", f"{name}: its physics steps and calls alone", 1e6 * bare, "µs")
        yield Figure("training", f"{name}: its physics steps alone", 1e6 * steps, "µs")
        yield Figure("training", f"{name}: tick over bare calls", whole / bare, "x", BOUND)
        for part, taken in zip(PARTS, parts, strict=True):
            yield Figure("training", f"{name}: of a tick, {part}", 1e6 * taken, "µs")


def _compare(reward: str, rounds: int) -> tuple[list[float], list[float]]:
    """Medians of s a tick: whole, bare calls, bare physics steps; and the ``PARTS`` of the whole."""
    from runtime import config
    from runtime.control.policy import balance_policy
    from sim.scenario import Scenario
    from training.plan import PHYSICS_RATE_HZ
    from training.randomize import SENSORS, Conditions
    from training.reference import make_reference
    from training.reward import TableReward, TaskReward
    from training.rollout import Setup, Stage, Task

    known = config.load(config.find_robot("stoch3"))
    policy = balance_policy(known.robot, known.control.gait.walking_height)
    features, commands = make_reference(known).resampled(known.control.rate_hz, TICKS)
    wanted = None if reward == "table" else (0.5, 0.0, 0.0)
    setup = Setup(
        known,
        policy,
        TableReward() if reward == "table" else TaskReward(),
        TICKS,
        features,
        commands,
        physics_rate_hz=PHYSICS_RATE_HZ,
    )
    stage = Stage(setup)
    task = Task(policy.parameters, Conditions(Scenario(noise=SENSORS), wanted))
    calls = _listen(stage, task)
    times, parts = [], []
    for _ in shown(range(rounds), reward, rounds):
        times.append((_play(stage, task), _replay(calls), _time_steps(calls)))
        parts.append(_time_parts(stage, task))
    stage.close()
    return (np.median(times, axis=0) / TICKS).tolist(), (np.median(parts, axis=0) / TICKS).tolist()


def _play(stage: Stage, task: Task) -> float:
    began = time.process_time()
    episode = stage.rollout(task)
    taken = time.process_time() - began
    if episode.steps < TICKS:
        raise RuntimeError(f"the hand-built matrix fell after {episode.steps} ticks")
    return taken


def _listen(stage: Stage, task: Task) -> list[Call]:
    """Every call of an episode, its reset too; the first episode only compiles."""
    _play(stage, task)
    world: Any = stage.world
    bullet = world._engine.bullet
    direct = world._robot.direct
    world._robot.direct = False
    world._engine.bullet = world._robot.bullet = listening = Listening(bullet)
    _play(stage, task)
    world._engine.bullet = world._robot.bullet = bullet
    world._robot.direct = direct
    return listening.calls


def _replay(calls: list[Call]) -> float:
    began = time.process_time()
    for function, args, kwargs in calls:
        function(*args, **kwargs)
    return time.process_time() - began


def _time_steps(calls: list[Call]) -> float:
    total = 0.0
    for function, args, kwargs in calls:
        began = time.process_time()
        function(*args, **kwargs)
        if function.__name__ == "stepSimulation":
            total += time.process_time() - began
    return total


def _time_parts(stage: Stage, task: Task) -> list[float]:
    """An episode's s by ``PARTS``; looking at the clock so often makes it some 5 µs a tick longer."""
    world, walker = stage.world, cast("Controller", stage._walker)
    physics, stepped = _Timed(world, "_physics_steps"), _Timed(world, "step")
    controlled, solved = _Timed(walker, "step"), _Timed(walker.ladder, "ask_first")
    whole = _play(stage, task)
    for part in (physics, stepped, controlled, solved):
        part.release()
    rest = whole - stepped.total - controlled.total
    return [physics.total, stepped.total - physics.total, controlled.total - solved.total, solved.total, rest]


class _Timed:
    """A method of one object, with the time that all its calls take."""

    def __init__(self, owner: Any, name: str) -> None:
        self.total = 0.0
        self._owner, self._name = owner, name
        method = getattr(owner, name)

        def timed(*args: Any) -> Any:
            began = time.process_time()
            result = method(*args)
            self.total += time.process_time() - began
            return result

        setattr(owner, name, timed)

    def release(self) -> None:
        """Give the method back."""
        delattr(self._owner, self._name)
