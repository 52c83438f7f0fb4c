"""The control cycle over the wire twin in lock-step: the real drivers, emulated servos and IMU, the world's time alone.

What it shows does not depend on how busy the computer is.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from math import atan2, cos, sin

import numpy as np

from drivers.bus import InProcessBus
from drivers.errors import NotConnected
from drivers.hardware import HardwareRobot
from drivers.motors import Motors
from drivers.mounting import Mounting
from drivers.mtdata2 import Data, SampleDecoder
from drivers.robot import Array, ImuSample, JointCommand, Measurement, damp_command
from drivers.xbus import Message, Output, XbusParser, encode, encode_outputs
from runtime import config
from runtime.control.records import VelocityCommand
from runtime.cycle import Cycle
from runtime.messages.mode import Mode, Request
from runtime.policies import find_policy, load
from runtime.tick_record import Wake
from sim.build import Build, lab_build
from sim.scenario import Scenario
from sim.twin import RATE_HZ, REAL_NOISE, TwinBody, TwinSetup
from sim.world import World
from sim.xbus_emulator import Product, XbusEmulator

REST = 0.6
"""s that the loop runs before it is asked for anything: the arming list wants to see it."""
STANDING_UP = 6.0
"""s within which it stands, or does not."""


class LockstepImu:
    """The emulated device's bytes through the real parser, without a port; its stamps are simulated time."""

    def __init__(self, mount: tuple[float, float, float, float]) -> None:
        self.emulator = XbusEmulator("MTI-630", 921600)
        wanted = [Output(kind, 0xFFFF) for kind in (Data.PACKET_COUNTER, Data.SAMPLE_TIME_FINE, Data.STATUS_WORD)]
        wanted += [Output(kind, 400) for kind in (Data.QUATERNION, Data.ACCELERATION, Data.RATE_OF_TURN)]
        for message, data in ((Message.GO_TO_CONFIG, b""), (Message.SET_OUTPUT_CONFIGURATION, encode_outputs(wanted))):
            self.emulator.feed(encode(message, data))
        self.emulator.feed(encode(Message.GO_TO_MEASUREMENT))
        self._parser, self._decoder, self._mounting = XbusParser(), SampleDecoder(), Mounting(mount)
        self._sample: ImuSample | None = None

    def take(self, now: float, felt: tuple[Array, Array, Array]) -> None:
        """One sample at ``now`` s: orientation, rate of turn and acceleration in the sensor's frame."""
        for _, data in self._parser.feed(self.emulator.measure(now, *felt)):
            sample, mounting = self._decoder.decode(data), self._mounting
            self._sample = ImuSample(
                now,
                mounting.orientation(np.array(sample.orientation)),
                mounting.vector(np.array(sample.rate)),
                mounting.vector(np.array(sample.acceleration)),
            )

    async def connect(self) -> None:
        """Nothing to open."""

    def troubles(self) -> dict[str, int]:
        """None: its bytes cannot be lost."""
        return {}

    def latest(self) -> ImuSample:
        """The newest sample.

        Raises:
            NotConnected: there is none yet.
        """
        if self._sample is None:
            raise NotConnected("the IMU has not given a sample")
        return self._sample

    async def close(self) -> None:
        """Nothing to close."""


class TwinWalk:
    """Stoch3 on the twin, from damp to wherever the script leads it."""

    def __init__(
        self,
        changes: Mapping[str, object] | None = None,
        scenario: Scenario | None = None,
        build: Build | None = None,
        product: Product = "MTI-630",
    ) -> None:
        """Put it together and connect it; it lies folded.

        Args:
            changes: what its configuration says other than the shipped one's, by dotted key.
            scenario: noisy sensors, if not given.
            build: how the body is really put together; the lab's way, if not given.
            product: of the IMU.
        """
        self.config = config.override(config.load(config.find_robot("stoch3")), "lock-step", dict(changes or {}))
        assert self.config.motors is not None
        control = self.config.control
        self.world = World(self.config.robot, RATE_HZ, control.gait.walking_height)
        self.cycle = Cycle(self.config, load(find_policy(control.policy), self.config.robot.name))
        scenario = scenario or Scenario(noise=REAL_NOISE, joint_position=self.cycle.sources.posture.folded_joints)
        self.setup = TwinSetup(build or lab_build(), self.config.motors, scenario, product)
        self.steps = round(RATE_HZ / control.rate_hz)
        self.index = 0
        self.after_step: Callable[[], None] = lambda: None
        """Called after each step of the world."""
        self.connect()
        self.command = damp_command(self.config.damp.kd)
        self.measurement: Measurement = self.exchange(self.command)
        self.cycle.warm_up(self.measurement)

    def connect(self) -> None:
        """Put body and drivers together."""
        assert self.config.motors is not None
        self.twin = TwinBody(self.world, self.setup)
        self.lockstep_imu = LockstepImu((1.0, 0.0, 0.0, 0.0))
        self.motors = Motors(self.config.motors, InProcessBus(self.twin.wire.answer), 0.003, clock=self.clock)
        self.robot = HardwareRobot(self.config.robot, self.motors, self.lockstep_imu, clock=self.clock)
        self.live()
        asyncio.run(self.robot.connect())

    @property
    def now(self) -> float:
        """The drivers' time, s."""
        return 100.0 + self.world.time

    def clock(self) -> float:
        """The drivers' clock."""
        return self.now

    def live(self) -> None:
        """One tick of the body."""
        for _ in range(self.steps):
            felt = self.twin.felt(self.twin.step().imu)
            self.lockstep_imu.take(self.now, felt)
            self.after_step()

    def exchange(self, command: JointCommand) -> Measurement:
        """One round of the wires, then one tick of the body."""
        measurement = asyncio.run(self.robot.exchange(command))
        self.live()
        return measurement

    def run(
        self, seconds: float, velocity: tuple[float, float, float] | None = None, each: Callable[[], None] | None = None
    ) -> None:
        """Tick for ``seconds`` under a velocity command, if any; ``each`` is called before every tick."""
        rate = self.config.control.rate_hz
        for _ in range(round(seconds * rate)):
            if each is not None:
                each()
            self.tick(velocity)

    def tick(self, velocity: tuple[float, float, float] | None = None) -> None:
        """One tick."""
        self.index += 1
        stamp = self.now
        if velocity is not None:
            self.cycle.command_velocity(VelocityCommand(stamp - 0.001, np.array(velocity[:2]), velocity[2]))
        wake = Wake(self.index, stamp, 1 / self.config.control.rate_hz, 5e-5, 0)
        try:
            self.measurement = self.exchange(self.command)
        except TimeoutError as error:
            self.command = self.cycle.silent(wake, str(error))
            self.live()
        else:
            self.command = self.cycle.step(wake, self.measurement)

    def ask(self, *wishes: Request) -> None:
        """Requests between two ticks.

        Raises:
            RuntimeError: one was refused.
        """
        for wish in wishes:
            answer, words = self.cycle.request(wish, self.measurement)
            if not answer.accepted:
                raise RuntimeError(f"{wish.value} refused: {words}")

    def stand(self) -> None:
        """From damp to standing.

        Raises:
            RuntimeError: it was refused, or did not get there.
        """
        self.run(REST)
        self.ask(Request.ARM, Request.STAND)
        end = self.now + STANDING_UP
        while self.cycle.state.mode is not Mode.STAND:
            self.run(0.1)
            if self.now > end:
                raise RuntimeError(f"not standing after {STANDING_UP:g} s: {self.cycle.state}")

    def ticks_to_leave(self, mode: Mode, velocity: tuple[float, float, float], limit: int = 60) -> int:
        """Ticks until the mode is another than ``mode``; the limit where it stays."""
        for ticks in range(1, limit + 1):
            self.tick(velocity if self.cycle.state.mode is Mode.WALK else None)
            if self.cycle.state.mode is not mode:
                return ticks
        return limit

    def ticks_to_damp(self, limit: int = 60, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> int:
        """Ticks until the mode is DAMP; the limit where it does not get there."""
        for ticks in range(1, limit + 1):
            self.tick(velocity if self.cycle.state.mode is Mode.WALK else None)
            if self.cycle.state.mode is Mode.DAMP:
                return ticks
        return limit

    @property
    def velocity(self) -> Array:
        """The world's truth: vx, vy in the heading frame, m/s, and the yaw rate, rad/s. Shape (3,)."""
        truth = self.world.truth
        yaw = atan2(truth.rotation_body_to_world[1, 0], truth.rotation_body_to_world[0, 0])
        x, y, _ = truth.linear_velocity
        return np.array([x * cos(yaw) + y * sin(yaw), y * cos(yaw) - x * sin(yaw), truth.angular_velocity[2]])

    def mean_velocity(self, seconds: float, velocity: tuple[float, float, float]) -> Array:
        """What it walks at on average over ``seconds`` under a command. Shape (3,)."""
        seen: list[Array] = []
        self.run(seconds, velocity, lambda: seen.append(self.velocity))
        mean: Array = np.mean(seen, axis=0)
        return mean

    @property
    def faults(self) -> list[str]:
        """What went wrong so far, in the daemon's words."""
        return [event.text for event in self.cycle.events if event.kind == "fault"]
