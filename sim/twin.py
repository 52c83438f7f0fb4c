"""The wire twin: a body whose motors answer on a CAN bus and whose IMU talks on a serial line, moved by one World.

The real drivers run against it unchanged. What a joint is to a motor is in ``sim.build``, the twin's own table.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from drivers.mounting import Mounting
from drivers.robot import Array, ImuSample, JointCommand, Measurement
from drivers.wiring import BusConfig, MotorsConfig
from sim.build import Build
from sim.mit_emulator import MitEmulator
from sim.moteus_emulator import MoteusEmulator, MoteusSettings
from sim.scenario import Noise, Scenario
from sim.serial_imu import SerialImu
from sim.servo import Drive, ServoEmulator
from sim.servo_wire import ServoWire
from sim.world import World
from sim.xbus_emulator import Product

RATE_HZ = 400.0
"""How often the servos' sensors and the IMU are renewed: the IMU's base rate."""
REAL_NOISE = Noise(
    joint_velocity=0.03,
    joint_torque=0.3,
    orientation=0.002,
    angular_velocity=0.004,
    linear_acceleration=0.05,
    joint_torque_bias=0.1,
    orientation_bias=0.004,
    angular_velocity_bias=0.002,
    linear_acceleration_bias=0.02,
)
"""What servos and an MTi show; the encoders' steps are the emulators'."""
_BY_CLOCK = 4
"""Ticks that the twin lives at once while nobody talks to it."""


@dataclass(frozen=True, slots=True)
class TwinSetup:
    """What a twin is made of."""

    build: Build
    motors: MotorsConfig
    """Only for the protocol, its settings and nothing of the wiring."""
    scenario: Scenario = field(default_factory=lambda: Scenario(noise=REAL_NOISE))
    product: Product = "MTI-630"
    imu_baud: int = 115200


class TwinBody:
    """Servos and world in lock-step, without wires or pace; ``WireTwin`` adds both.

    The servos live in the world's time: a computer that stalls is none of their business, a daemon that does is.
    """

    def __init__(self, world: World, setup: TwinSetup, clock: Callable[[], float] | None = None) -> None:
        """``world`` must run at ``RATE_HZ``, or at whatever rate ``step`` will be called.

        Another ``clock`` than the world's is for whoever holds the world still between two frames.
        """
        self.world, self.setup = world, setup
        self.clock = clock or (lambda: world.time)
        """The time, s, that the servos' watchdogs run by."""
        build = setup.build
        self.servos = [_servo(setup.motors, int(motor)) for motor in build.id.ravel()]
        """In the order of the joints, FL abduction first."""
        members: dict[int, list[ServoEmulator]] = {}
        for bus, servo in zip(build.bus.ravel(), self.servos, strict=True):
            members.setdefault(int(bus) - 1, []).append(servo)
        self.wire = ServoWire(members, self.clock)
        self.overheating: dict[int, float] = {}
        """Knob: servo's place → °C on top of what the world says."""
        self._mounting = Mounting(_conjugate(build.mount))
        self._angle = build.direction * build.gear
        self.measurement = world.reset(setup.scenario)
        self._sense(self.measurement)

    def step(self) -> Measurement:
        """Let the world live for one of its periods under what the servos do; what they and the IMU feel after it."""
        now = self.clock()
        self.world.step(self._command([servo.step(now) for servo in self.servos]))
        self.measurement = self.world.measurement
        self._sense(self.measurement)
        return self.measurement

    def felt(self, imu: ImuSample) -> tuple[Array, Array, Array]:
        """Orientation, rate of turn and acceleration in the IMU's own frame."""
        mounting = self._mounting
        return (
            mounting.orientation(imu.orientation),
            mounting.vector(imu.angular_velocity),
            mounting.vector(imu.linear_acceleration),
        )

    def _command(self, drives: list[Drive]) -> JointCommand:
        position, velocity, torque, kp, kd = np.array(drives).T.reshape(5, 4, 3)
        angle = self._angle
        return JointCommand(
            position=position / angle - self.setup.build.offset,
            velocity=velocity / angle,
            torque=torque * angle,
            kp=kp * angle**2,
            kd=kd * angle**2,
        )

    def _sense(self, measurement: Measurement) -> None:
        joints, angle = measurement.joints, self._angle
        position = (angle * (joints.position + self.setup.build.offset)).ravel().tolist()
        velocity, torque = (angle * joints.velocity).ravel().tolist(), (joints.torque / angle).ravel().tolist()
        celsius = joints.temperature.ravel().tolist()
        for place, servo in enumerate(self.servos):
            heat = self.overheating.get(place, 0.0)
            servo.sense(position[place], velocity[place], torque[place], celsius[place] + heat)


class WireTwin:
    """A ``TwinBody`` on real channels and a real pseudo-terminal. Use inside a running loop."""

    def __init__(
        self, world: World, setup: TwinSetup, imu_path: Path, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """``clock`` is the IMU's; a real one knows nothing of the world's time."""
        self.body = TwinBody(world, setup)
        self.imu = SerialImu(imu_path, setup.product, setup.imu_baud)
        self._clock = clock

    def open(self, bus: BusConfig) -> None:
        """Listen on the buses, plug in the IMU.

        Raises:
            DriverError: a channel cannot be opened.
        """
        self.body.wire.open(bus, fd=self.body.setup.motors.protocol == "moteus")
        self.imu.plug_in()

    def close(self) -> None:
        """Leave the wires. Harmless when repeated."""
        self.body.wire.close()
        self.imu.unplug()

    async def run(self, tick: float, patience: float, after_step: Callable[[], None] = lambda: None) -> None:
        """Live until cancelled: one ``tick``, s, for each round of frames to all servos, or by the clock without any.

        A round that fails to come to servos that are energised stops the world for ``patience``, s: so long a computer
        that is too slow slows the twin's time, as it slows that of ``SimRobot``, and does not fell it. After that the
        daemon counts as dead: the world goes on by the clock, and the servos' watchdogs with it.
        """
        ticked, steps, short = self.body.wire.ticked, max(1, round(tick / self.body.world.period)), _BY_CLOCK * tick
        driven = False
        while True:
            try:
                waits = driven and any(servo.energised for servo in self.body.servos)
                async with asyncio.timeout(max(patience, short) if waits else short):
                    await ticked.wait()
            except TimeoutError:
                await asyncio.sleep(0)  # after a stall of this process the frames wait unread: they come first
                driven = ticked.is_set()
            else:
                driven = True
            ticked.clear()
            self.live(steps if driven else _BY_CLOCK * steps, after_step)

    def live(self, steps: int, after_step: Callable[[], None] = lambda: None) -> None:
        """So many steps of the world, each with its sample of the IMU."""
        for _ in range(steps):
            measurement = self.body.step()
            self.imu.measure(self._clock(), *self.body.felt(measurement.imu))
            after_step()


async def run_twin(
    twin: WireTwin, bus: BusConfig, tick: float, patience: float = 0.0, after_step: Callable[[], None] = lambda: None
) -> None:
    """Open, live until cancelled (see ``WireTwin.run``), close.

    Raises:
        DriverError: a channel cannot be opened.
    """
    twin.open(bus)
    try:
        await twin.run(tick, patience, after_step)
    finally:
        twin.close()


def _servo(motors: MotorsConfig, motor: int) -> ServoEmulator:
    protocol: Literal["moteus", "mit"] = motors.protocol
    if protocol == "mit":
        return MitEmulator(motor, motors.model)
    return MoteusEmulator(motor, MoteusSettings(kp=motors.servo_kp, kd=motors.servo_kd))


def _conjugate(quaternion: Array) -> tuple[float, float, float, float]:
    w, x, y, z = quaternion.tolist()
    return w, -x, -y, -z
