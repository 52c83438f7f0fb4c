"""The control cycle over the wire twin in lock-step: real driver, emulated servos and IMU, simulated time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import numpy as np

from drivers.bus import InProcessBus
from drivers.hardware import HardwareRobot
from drivers.motors import Motors
from drivers.mounting import Mounting
from drivers.mtdata2 import Data, SampleDecoder
from drivers.robot import ImuSample, JointCommand, Measurement, damp_command
from drivers.wiring import MotorsConfig
from drivers.xbus import Message, Output, XbusParser, encode, encode_outputs
from runtime import config
from runtime.control.records import VelocityCommand
from runtime.cycle import Cycle, Wake
from runtime.messages import Mode, Request
from runtime.policies import find_policy, load
from sim.build import lab_build
from sim.scenario import Scenario
from sim.twin import RATE_HZ, REAL_NOISE, TwinBody, TwinSetup
from sim.world import World
from sim.xbus_emulator import XbusEmulator

QUICK = {
    "posture.soft_start": 0.2,
    "posture.fold_time": 0.3,
    "posture.rise_time": 0.6,
    "posture.settle_time": 0.1,
}
"""Up in a second, for tests of what comes after."""


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

    def take(self, now: float, felt: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
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

    def latest(self) -> ImuSample:
        assert self._sample is not None
        return self._sample

    async def close(self) -> None:
        """Nothing to close."""


class TwinWalk:
    """One robot on the twin, from damp to wherever the script leads it."""

    def __init__(self, scenario: Scenario | None = None, quick: bool = False) -> None:
        self.config = config.override(config.load(config.find_robot("stoch3")), "test", QUICK if quick else {})
        assert self.config.motors is not None
        control = self.config.control
        self.now = 100.0
        self.world = World(self.config.robot, RATE_HZ, control.gait.walking_height)
        self.cycle = Cycle(self.config, load(find_policy(control.policy), self.config.robot.name))
        scenario = scenario or Scenario(noise=REAL_NOISE, joint_position=self.cycle.sources.posture.folded_joints)
        self.twin = TwinBody(self.world, TwinSetup(lab_build(), self.config.motors, scenario), self.clock)
        self.imu = LockstepImu((1.0, 0.0, 0.0, 0.0))
        self.motors = Motors(self.config.motors, InProcessBus(self.twin.wire.answer), 0.003, clock=self.clock)
        self.robot = HardwareRobot(self.config.robot, self.motors, self.imu, clock=self.clock)
        self.steps = round(RATE_HZ / control.rate_hz)
        self.index = 0
        self._live()
        asyncio.run(self.robot.connect())
        self.measurement: Measurement = self.exchange(damp_command(self.config.damp.kd))
        self.cycle.warm_up(self.measurement)
        self.command = damp_command(self.config.damp.kd)

    @staticmethod
    def wiring() -> MotorsConfig:
        motors = config.load(config.find_robot("stoch3")).motors
        assert motors is not None
        return motors

    def clock(self) -> float:
        return self.now

    def _live(self) -> None:
        for _ in range(self.steps):
            self.now += self.world.period
            self.imu.take(self.now, self.twin.felt(self.twin.step().imu))

    def exchange(self, command: JointCommand) -> Measurement:
        measurement = asyncio.run(self.robot.exchange(command))
        self._live()
        return measurement

    def run(
        self, seconds: float, velocity: tuple[float, float, float] | None = None, each: Callable[[], None] | None = None
    ) -> None:
        rate = self.config.control.rate_hz
        for _ in range(round(seconds * rate)):
            self.tick(velocity)
            if each is not None:
                each()

    def tick(self, velocity: tuple[float, float, float] | None = None) -> None:
        self.index += 1
        stamp = self.now
        if velocity is not None:
            self.cycle.command_velocity(VelocityCommand(stamp - 0.001, np.array(velocity[:2]), velocity[2]))
        wake = Wake(self.index, stamp, 1 / self.config.control.rate_hz, 5e-5, 0)
        try:
            self.measurement = self.exchange(self.command)
        except TimeoutError as error:
            self.command = self.cycle.silent(wake, str(error))
            self._live()
        else:
            self.command = self.cycle.step(wake, self.measurement)

    def ask(self, *wishes: Request) -> None:
        for wish in wishes:
            answer, words = self.cycle.request(wish, self.measurement)
            assert answer.accepted, words

    def stand(self) -> None:
        self.run(0.6)
        self.ask(Request.ARM, Request.STAND)
        for _ in range(60):
            self.run(0.1)
            if self.cycle.state.mode is Mode.STAND:
                return
        raise AssertionError(f"still {self.cycle.state}")

    def ticks_to_damp(self, limit: int = 60) -> int:
        """Ticks until the mode is DAMP; the limit where it does not get there."""
        for ticks in range(1, limit + 1):
            self.tick((0.0, 0.0, 0.0) if self.cycle.state.mode is Mode.WALK else None)
            if self.cycle.state.mode is Mode.DAMP:
                return ticks
        return limit
