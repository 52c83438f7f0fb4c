"""Long walks without a fault: random commands, random pushes of a size that must be borne, stops and starts."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable

import msgspec
import numpy as np

from drivers.robot import motor_torque
from faults.rig import Rig
from faults.watch import COMMAND_FIELDS
from runtime.messages.mode import Mode, Request
from sim.sensing import VELOCITY

LINEAR, YAW_RATE = ((-0.4, 0.8), (-0.3, 0.3)), 0.8
"""m/s forward and sideways, rad/s: what is asked for, at most one of them whole at a time."""
PUSH = (10.0, 6.0)
"""N·s forward and sideways that a robot must bear anywhere in its walk: 0.4 and 0.24 m/s of its mass."""
PUSH_TIME = (0.05, 0.2)
HOLD = (1.0, 4.0)
"""s that one command lasts."""
PAUSE = (3.0, 10.0)
"""s between two pushes."""
REMEMBERED = 6


class Wandering(msgspec.Struct, kw_only=True):
    """One episode."""

    seed: int
    seconds: float
    """Simulated."""
    distance: float = 0.0
    """Along the ground, m."""
    commands: int = 0
    pushes: int = 0
    sits: int = 0
    falls: list[str] = []
    """What had happened before each."""
    faults: dict[str, int] = {}
    """Ends in damp that were no fall, by what the daemon said."""
    not_finite: int = 0
    over_limit: int = 0
    """Commands past the torque limit."""
    torque: float = 0.0
    """Largest commanded, N·m."""


class Wanderer:
    """One robot and its dice."""

    def __init__(self, seed: int, seconds: float) -> None:
        self.result = Wandering(seed=seed, seconds=seconds, falls=[], faults={})
        self.dice = np.random.default_rng((77, seed))
        self.rig = Rig("sim", seed)
        self.rig.stand()
        self.lately: deque[str] = deque(maxlen=REMEMBERED)
        self.faults: Counter[str] = Counter()
        self._peak = np.array(self.rig.config.robot.joints.peak_torque) * (1 + 1e-9)

    def wander(self) -> Wandering:
        """Until the time is over, or the robot fell."""
        rig, dice, result = self.rig, self.dice, self.result
        end, push_at = rig.now + result.seconds, rig.now + dice.uniform(*PAUSE)
        while rig.now < end and not result.falls:
            self._choose()
            until = rig.now + dice.uniform(*HOLD)
            while rig.now < until and rig.mode in (Mode.WALK, Mode.STAND) and not result.falls:
                if rig.now >= push_at and rig.mode is Mode.WALK:
                    self._push()
                    push_at = rig.now + dice.uniform(*PAUSE)
                self._tick()
            if rig.mode is Mode.DAMP and not result.falls:
                self._recover()
        result.faults = dict(self.faults)
        return result

    def _choose(self) -> None:
        rig, dice, result = self.rig, self.dice, self.result
        if dice.random() < 0.05:
            self._sit_and_rise()
        elif dice.random() < 0.1 and rig.mode is Mode.WALK:
            rig.ask(Request.STAND)
            rig.velocity = None
            self.lately.append(f"{rig.now:.2f} s stand")
            return
        if rig.mode is Mode.STAND:
            rig.ask(Request.WALK)
        share = dice.uniform(-1.0, 1.0, 3)
        share /= max(1.0, np.abs(share).sum())
        linear = [high * s if s > 0 else -low * s for s, (low, high) in zip(share, LINEAR, strict=False)]
        rig.velocity = (round(float(linear[0]), 3), round(float(linear[1]), 3), round(YAW_RATE * float(share[2]), 3))
        result.commands += 1
        self.lately.append(f"{rig.now:.2f} s command {rig.velocity}")

    def _sit_and_rise(self) -> None:
        rig = self.rig
        if rig.mode is Mode.WALK:
            rig.ask(Request.STAND)
        rig.velocity = (0.0, 0.0, 0.0)
        self._until(lambda: bool(rig.cycle.tick["stance"][0].all()), 3.0)
        for _ in range(200):  # all four feet down, as the operator would wait for
            if rig.mode is Mode.STAND and rig.cycle.request(Request.SIT, rig.last)[0].accepted:
                break
            self._tick()
        self._until(lambda: rig.mode is Mode.DAMP, 8.0)
        self._rise()
        self.result.sits += 1
        self.lately.append(f"{rig.now:.2f} s sat and rose")

    def _rise(self) -> None:
        rig = self.rig
        self._until(lambda: False, 0.3)
        rig.ask(Request.ARM, Request.STAND)
        self._until(lambda: rig.mode is Mode.STAND, 8.0)

    def _recover(self) -> None:
        """It damped and did not fall: say why, and go on."""
        self.faults[self.rig.cycle.state.fault.name] += 1
        self.lately.append(f"{self.rig.now:.2f} s {self.rig.cycle.evidence}")
        self.rig.velocity = (0.0, 0.0, 0.0)
        self._until(lambda: False, 2.0)
        self.rig.ask(Request.CLEAR)
        self._rise()

    def _until(self, reached: Callable[[], bool], seconds: float) -> None:
        end = self.rig.now + seconds
        while self.rig.now < end and not reached() and not self.result.falls:
            self._tick()

    def _push(self) -> None:
        rig, dice, result = self.rig, self.dice, self.result
        angle, seconds = dice.uniform(0.0, 2.0 * math.pi), float(dice.uniform(*PUSH_TIME))
        size = float(dice.uniform(0.0, 1.0))
        forward, left = size * PUSH[0] * math.cos(angle) / seconds, size * PUSH[1] * math.sin(angle) / seconds
        rotation = rig.world.truth.rotation_body_to_world
        yaw = math.atan2(rotation[1, 0], rotation[0, 0])
        c, s = math.cos(yaw), math.sin(yaw)
        rig.world.push((c * forward - s * left, s * forward + c * left, 0.0), seconds)
        result.pushes += 1
        self.lately.append(f"{rig.now:.2f} s push {forward:.0f}, {left:.0f} N for {seconds:.2f} s")

    def _tick(self) -> None:
        rig, result = self.rig, self.result
        command = rig.tick()
        if not all(np.isfinite(getattr(command, name)).all() for name in COMMAND_FIELDS):
            result.not_finite += 1
        elif rig.mode is not Mode.DAMP and rig.measurement is not None:
            foreseen = np.abs(motor_torque(command, rig.measurement.joints))
            result.torque = max(result.torque, float(foreseen.max()))
            result.over_limit += bool((foreseen > self._peak).any())
        velocity = rig.world.body[VELOCITY]
        result.distance += math.hypot(velocity[0], velocity[1]) * rig.period
        if rig.mode in (Mode.WALK, Mode.STAND) and rig.world.fallen():
            self.lately.append(f"{rig.now:.2f} s fell in {rig.mode.name}")
            result.falls.append("; ".join(self.lately))
        rig.cycle.events.clear()


def wander(item: tuple[int, float], tell: Callable[[Wandering], None]) -> None:
    """One episode of ``item``: its seed and how long it lasts, s simulated."""
    wanderer = Wanderer(*item)
    try:
        tell(wanderer.wander())
    except Exception as error:
        wanderer.result.falls.append(f"{type(error).__name__}: {error}; {'; '.join(wanderer.lately)}")
        tell(wanderer.result)
    finally:
        wanderer.rig.world.close()
