"""What a fault did: measured on the simulator's truth and on every command that left, and held against the bounds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from drivers.robot import JointCommand, Measurement, motor_torque
from faults.rig import Rig
from runtime import modes
from runtime.config import Config
from runtime.messages.mode import Mode

COMMAND_FIELDS = ("position", "velocity", "kp", "kd", "torque")
ANSWER_TICKS = 2
"""From the first evidence to damp, or to the degrade that the row names."""
UNNOTICED = 0.4
"""s that a robot may lie on the ground and not know it."""
GOING = (Mode.STAND_UP, Mode.STAND, Mode.WALK)


class Outcome(msgspec.Struct, kw_only=True):
    """One fault, from its injection to its end. Ticks are counted from the injection: the first tick after it is 1."""

    row: str
    gait: str
    seed: int
    body: str
    fault: str
    """With its drawn numbers."""
    ends: str = ""
    """Mode and reason at the end."""
    words: str = ""
    """What the daemon said of it."""
    evidence: int | None = None
    """Tick whose readings first broke a bound of the configuration."""
    noticed: int | None = None
    """Tick in which the daemon first said that something was wrong."""
    answered: int | None = None
    """Tick in which it left its mode, damped or sat down, or began to stop its walk."""
    torque: float = 0.0
    """Largest that a motor exerted after the fault, N·m."""
    speed: float = 0.0
    """Largest of a joint, rad/s."""
    impact: float | None = None
    """Speed of the body when it touched the ground, m/s."""
    fell: bool = False
    """It touched the ground, or leant past the bound, before the daemon answered."""
    violations: list[str] = []


def broken(measurement: Measurement, config: Config, overspeed: float = 1.0) -> str:
    """What in a measurement is past a bound of the configuration; empty for nothing. Says it without the guard.

    ``overspeed`` is how many times as fast as its bound a joint may be.
    """
    limits, joints, imu = config.limits, measurement.joints, measurement.imu
    fastest = np.array(config.robot.joints.max_velocity)
    numbers = [joints.position, joints.velocity, joints.torque, joints.temperature, joints.age]
    numbers += [imu.orientation, imu.angular_velocity, imu.linear_acceleration, np.array([measurement.voltage])]
    if not all(np.isfinite(part).all() for part in numbers):
        return "not finite"
    _, x, y, _ = imu.orientation / np.linalg.norm(imu.orientation)
    for what, wrong in (
        ("motor fault", joints.fault.any()),
        ("motor age", joints.age.max() > limits.max_age),
        ("imu age", measurement.stamp - imu.stamp > limits.max_age),
        ("imu norm", abs(np.linalg.norm(imu.orientation) - 1.0) > 0.05),
        ("turn rate", np.abs(imu.angular_velocity).max() > limits.max_angular_velocity),
        ("acceleration", np.abs(imu.linear_acceleration).max() > limits.max_acceleration),
        ("tilt", 1.0 - 2.0 * (x * x + y * y) < math.cos(limits.max_tilt) - 1e-9),
        ("joint speed", (np.abs(joints.velocity) > overspeed * fastest).any()),
        ("temperature", joints.temperature.max() > limits.max_temperature),
        ("voltage", measurement.voltage < limits.min_voltage),
    ):
        if wrong:
            return what
    return ""


class Watch:
    """Looks at every tick and every physics step from its making on."""

    def __init__(self, rig: Rig, outcome: Outcome) -> None:
        self.rig, self.outcome = rig, outcome
        self.ticks = 0
        self._mode = rig.mode
        self._peak = np.array(rig.config.robot.joints.peak_torque)
        self._down = 0.0
        self._speed = float(np.linalg.norm(rig.world.truth.linear_velocity))
        self._over = 0.0
        self._fast = 0.0
        rig.cycle.events.clear()
        self._look_at_every_step()

    def look(self) -> None:
        """After a tick."""
        rig, outcome = self.rig, self.outcome
        self.ticks += 1
        measurement = rig.measurement
        if outcome.evidence is None and (measurement is None or self._broken(measurement)):
            outcome.evidence = self.ticks
        if outcome.noticed is None and (rig.cycle.health or rig.cycle.state.fault):
            outcome.noticed = self.ticks
        stopping = rig.cycle.state.fault or modes.stopping(rig.cycle.state)
        if outcome.answered is None and (stopping or rig.mode is not self._mode):
            outcome.answered = self.ticks
        if rig.cycle.events and not outcome.words:
            said = [event.text for event in rig.cycle.events if event.kind == "fault"]
            outcome.words = said[0] if said else ""
        self._look_at_the_command(rig.command, measurement)
        self._look_at_the_body()

    def _broken(self, measurement: Measurement) -> str:
        """As ``broken``, but a walking robot's joint may be too fast for a moment: a foot slips off an edge."""
        config = self.rig.config
        fast = (np.abs(measurement.joints.velocity) > config.robot.joints.max_velocity).any()
        self._fast = self._fast + self.rig.period if fast else 0.0
        spared = self._mode is Mode.WALK and self._fast < config.limits.overspeed_time + 0.5 * self.rig.period
        return broken(measurement, config, config.limits.max_overspeed if spared else 1.0)

    @property
    def over(self) -> bool:
        """Nothing more will happen: it damped, and lies."""
        return self.outcome.answered is not None and self.outcome.impact is not None and self._over > 0.1

    def judge(self) -> None:
        """Hold the whole against the bounds that every fault has."""
        rig, outcome, state = self.rig, self.outcome, self.rig.cycle.state
        outcome.ends = f"{state.mode.name} {state.fault.name}" if state.fault else state.mode.name
        known = [tick for tick in (outcome.evidence, outcome.noticed) if tick is not None]
        if known and outcome.answered is None:
            self.violate(f"evidence in tick {min(known)}, no answer in {self.ticks}")
        elif known and outcome.answered is not None and outcome.answered - min(known) > ANSWER_TICKS:
            self.violate(f"answered {outcome.answered - min(known)} ticks after the evidence, bound {ANSWER_TICKS}")
        if self._down > UNNOTICED and rig.mode in GOING:
            self.violate(f"lay on the ground for {self._down:.1f} s in {rig.mode.name}")

    def violate(self, words: str) -> None:
        if words not in self.outcome.violations:
            self.outcome.violations.append(words)

    def _look_at_the_command(self, command: JointCommand, measurement: Measurement | None) -> None:
        for name in COMMAND_FIELDS:
            if not np.isfinite(getattr(command, name)).all():
                self.violate(f"command {name} not finite")
                return
        if (command.kp < 0).any() or (command.kd < 0).any():
            self.violate("a gain below zero")
        if self.rig.mode is Mode.DAMP and (command.kp.any() or command.torque.any() or not (command.kd > 0).all()):
            self.violate("damps with more than damping")
        if self.rig.mode in GOING and measurement is not None:
            foreseen = np.abs(motor_torque(command, measurement.joints))
            if (foreseen > self._peak * (1 + 1e-9)).any():
                self.violate(f"commanded torque {foreseen.max():.1f} N·m past the limit")

    def _look_at_the_body(self) -> None:
        rig, outcome, truth = self.rig, self.outcome, self.rig.world.truth
        touches = rig.world.fallen(math.pi)
        leans = truth.rotation_body_to_world[2, 2] < math.cos(rig.config.limits.max_tilt + 0.1)
        if touches and outcome.impact is None:
            outcome.impact = self._speed
        if outcome.impact is not None and outcome.answered is not None:
            self._over += rig.period
        if (touches or leans) and outcome.answered is None:
            outcome.fell = True
            self._down += rig.period
        elif not touches and not leans:
            self._down = 0.0
        self._speed = float(np.linalg.norm(truth.linear_velocity))

    def _look_at_every_step(self) -> None:
        motors, outcome = self.rig.world.motors, self.outcome
        drive, limit = motors.drive, float(self._peak.max()) * (1 + 1e-9)

        def watched(step: int, states: Sequence[Any]) -> list[float]:
            given = drive(step, states)
            torque = max(map(abs, motors.torque))
            if torque > outcome.torque:
                outcome.torque = torque
                if not torque <= limit:
                    self.violate(f"torque {torque:.2f} N·m past the limit")
            speed = max(abs(state[1]) for state in states)
            if speed > outcome.speed:
                outcome.speed = speed
            return given

        motors.watched = True
        motors.drive = watched  # type: ignore[method-assign]
