"""A robot and the daemon's core in lock step, as fast as they go, with places where a fault can reach in.

The order is the daemon's: the loop wakes, the last command leaves, the readings come back, the cycle steps. While the
loop is stalled the motors obey their last command until their own watchdog damps them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from twin_walk import QUICK

from drivers.errors import BusTimeout, CorruptFrame
from drivers.robot import JointCommand, Measurement, damp_command
from runtime import config
from runtime.config import Config
from runtime.control.records import VelocityCommand
from runtime.cycle import Cycle
from runtime.messages.mode import Mode, Request
from runtime.policies import find_policy, load
from runtime.tick_record import Wake
from sim.scenario import Scenario
from sim.twin import REAL_NOISE
from sim.world import World
from trotd.lockstep import TwinWalk

SETTINGS = QUICK | {"limits.min_voltage": 18.0}
"""Up in a second; and a battery whose end is known."""
WATCHDOG = 0.1
"""s that a servo obeys a command that is not renewed."""
WATCHDOG_DAMPING = 1.6
"""What it does then, N·m·s/rad."""
TIMED_OUT = 11
"""The mode that such a servo reports, which the driver hands on as its fault."""
WALKING_SPEED = 0.8
"""m/s."""


class Fault:
    """Something that breaks. Every method is a place where it may reach in; none of them does anything here."""

    def start(self, rig: Rig) -> None:
        """Happen, between two ticks."""

    def stall(self, rig: Rig) -> int:
        """Deadlines that the loop misses before this tick."""
        return 0

    def command(self, rig: Rig, command: JointCommand) -> JointCommand:
        """What arrives at the motors of what was sent."""
        return command

    def measurement(self, rig: Rig, measurement: Measurement) -> Measurement:
        """What arrives at the daemon of what was read.

        Raises:
            BusTimeout, CorruptFrame: nothing does.
        """
        return measurement

    def happened(self) -> bool:
        """Whether it reached in at all, at the end."""
        return True


class Body(Protocol):
    """What the rig wants of a body."""

    world: World

    @property
    def now(self) -> float: ...

    def exchange(self, command: JointCommand) -> Measurement: ...

    def live(self) -> None:
        """One period without anybody asking."""


class SimBody:
    """The simulated robot, with servos that have a watchdog."""

    def __init__(self, made: Config, folded: np.ndarray, seed: int) -> None:
        control = made.control
        self.world = World(made.robot, control.rate_hz, control.gait.walking_height)
        self.world.reset(Scenario(seed=seed, noise=REAL_NOISE, joint_position=folded))
        self.timed_out = False
        self._command = damp_command(made.damp.kd)
        self._unasked = 0.0

    @property
    def now(self) -> float:
        return self.world.time

    def exchange(self, command: JointCommand) -> Measurement:
        if self.timed_out and not command.kp.any():
            self.timed_out = False  # the driver stops such motors while nothing but damping is asked, and starts anew
        self._unasked, self._command = 0.0, command
        measurement = self.world.step(damp_command(WATCHDOG_DAMPING) if self.timed_out else command)
        if not self.timed_out:
            return measurement
        return replace(
            measurement, joints=replace(measurement.joints, fault=np.full((4, 3), TIMED_OUT, dtype=np.int32))
        )

    def live(self) -> None:
        self._unasked += self.world.period
        self.timed_out |= self._unasked > WATCHDOG
        self.world.step(damp_command(WATCHDOG_DAMPING) if self.timed_out else self._command)


class WireBody:
    """The wire twin behind the real driver."""

    def __init__(self, walk: TwinWalk) -> None:
        self.walk, self.world = walk, walk.world

    @property
    def now(self) -> float:
        return self.walk.now

    def exchange(self, command: JointCommand) -> Measurement:
        asked = self.walk.robot.exchange(command)
        try:
            asked.send(None)  # nothing in this process is ever waited for
        except StopIteration as done:
            measurement: Measurement = done.value
            return measurement
        finally:
            self.live()
        raise AssertionError("the in-process bus waited")

    def live(self) -> None:
        self.walk.live()


@dataclass
class Clock:
    """How far the host's clock was stepped, s."""

    step: float = 0.0


class Rig:
    """One robot from damp to wherever it is led."""

    def __init__(self, kind: str, base: int) -> None:
        """``kind`` is ``sim`` or ``wire``, ``base`` the seed of the sensors' noise."""
        if kind == "wire":
            self.config = config.override(config.load(config.find_robot("stoch3")), "test", SETTINGS)
            walk = TwinWalk(QUICK, Scenario(seed=base, noise=REAL_NOISE, joint_position=self._folded()))
            self.walk = walk
            self.config, self.cycle = walk.config, walk.cycle
            self.body: Body = WireBody(walk)
        else:
            self.config = config.override(config.load(config.find_robot("stoch3")), "test", SETTINGS)
            policy = load(find_policy(self.config.control.policy), self.config.robot.name)
            self.cycle = Cycle(self.config, policy)
            self.body = SimBody(self.config, self.cycle.sources.posture.folded_joints, base)
        self.world = self.body.world
        self.period = 1.0 / self.config.control.rate_hz
        self.faults: list[Fault] = []
        self.clock = Clock()
        self.index = self.overruns = 0
        self.velocity: tuple[float, float, float] | None = None
        self.command = self.sent = damp_command(self.config.damp.kd)
        self.measurement: Measurement | None = None
        """What the daemon saw last; None where the body did not answer."""
        self.last = self.body.exchange(self.command)
        """What came back last."""
        if kind == "sim":
            self.cycle.warm_up(self.last)

    def _folded(self) -> np.ndarray:
        from runtime.control.posture import Posture

        return Posture(self.config.robot, self.config.control, self.config.posture).folded_joints

    @property
    def now(self) -> float:
        """The host's monotonic clock, s."""
        return self.body.now + self.clock.step

    @property
    def mode(self) -> Mode:
        return self.cycle.state.mode

    def inject(self, fault: Fault) -> None:
        self.faults.append(fault)
        fault.start(self)

    def tick(self) -> JointCommand:
        """One wake of the loop, with the deadlines missed before it."""
        missed = sum(fault.stall(self) for fault in self.faults)
        for _ in range(missed):
            self.body.live()
        self.index += 1 + missed
        self.overruns += missed
        now = self.now
        wake = Wake(self.index, now, (1 + missed) * self.period, 5e-5, self.overruns)
        if self.velocity is not None:
            linear = np.array(self.velocity[:2])
            self.cycle.command_velocity(VelocityCommand(now - 0.001, linear, self.velocity[2]))
        sent = self.command
        for fault in self.faults:
            sent = fault.command(self, sent)
        self.sent = sent
        try:
            self.measurement = self._read(self.body.exchange(sent))
        except (BusTimeout, CorruptFrame) as error:
            self.measurement = None
            self.command = self.cycle.silent(wake, str(error))
        else:
            self.last = self.measurement
            self.command = self.cycle.step(wake, self.measurement)
        return self.command

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / self.period)):
            self.tick()

    def ask(self, *wishes: Request) -> None:
        for wish in wishes:
            answer, words = self.cycle.request(wish, self.last)
            assert answer.accepted, f"{wish.value}: {words}"

    def reach(self, mode: Mode, seconds: float = 6.0) -> None:
        while self.mode is not mode:
            self.tick()
            seconds -= self.period
            assert seconds > 0, f"still {self.cycle.state}: {[event.text for event in self.cycle.events]}"

    def stand(self) -> None:
        self.run(0.6)
        self.ask(Request.ARM, Request.STAND)
        self.reach(Mode.STAND)
        self.run(0.5)

    def walk_on(self) -> None:
        """Into a steady walk."""
        self.ask(Request.WALK)
        self.velocity = (WALKING_SPEED, 0.0, 0.0)
        self.run(1.5)

    def _read(self, measurement: Measurement) -> Measurement:
        step = self.clock.step
        if step:
            imu = replace(measurement.imu, stamp=measurement.imu.stamp + step)
            measurement = replace(measurement, stamp=measurement.stamp + step, imu=imu)
        for fault in self.faults:
            measurement = fault.measurement(self, measurement)
        return measurement
