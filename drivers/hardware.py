"""The real robot: twelve motors and an IMU behind the ``Robot`` protocol.

Connecting opens everything at once, energises nothing, and reports all that is wrong in one go. An exchange returns at
its deadline with what there is; ages tell what is old, and the guard damps on them.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from typing import Protocol

import numpy as np

from drivers.bus import Bus
from drivers.can_bus import PythonCanBus
from drivers.description import RobotDescription
from drivers.errors import BusTimeout, DriverError, NotConnected
from drivers.motor_codec import build_codec
from drivers.motor_faults import RESTARTED, SILENT
from drivers.motors import Motors
from drivers.pi3hat import Pi3HatBus
from drivers.robot import JOINTS, LEGS, Array, ImuSample, JointCommand, Measurement
from drivers.wiring import BusConfig, MotorsConfig

ANSWER_TIME = 0.5
"""s that a motor may take to answer at the start."""
RANGE_MARGIN = 0.35
"""rad beyond its range where a joint's zero is no longer believed."""
CLEAR_INTERVAL = 0.2
"""s between attempts to bring back motors that latched, while the robot damps."""
_NOT_CLEARABLE = (0, RESTARTED, SILENT)
_QUESTIONS, _MORE_QUESTIONS = 20, 3
_STOPS = 3


class Imu(Protocol):
    """What the robot wants of its IMU; ``Xsens`` is one."""

    async def connect(self) -> None:
        """Returns with the first sample."""

    def latest(self) -> ImuSample:
        """The newest sample."""
        ...

    async def close(self) -> None:
        """Never raises."""

    def troubles(self) -> dict[str, int]:
        """What went wrong since ``connect``, counted, by its name."""
        ...


def build_bus(bus: BusConfig, motors: MotorsConfig) -> Bus:
    """The back-end that ``bus`` names.

    Raises:
        ValueError: the two do not fit.
    """
    highest = max(number for leg in motors.bus for number in leg)
    if highest > len(bus.channels):
        raise ValueError(f"motors.bus has bus {highest}, bus.channels names {len(bus.channels)}")
    fd = build_codec(motors).fd
    return Pi3HatBus(bus, fd=fd) if bus.backend == "pi3hat" else PythonCanBus(bus, fd=fd)


class HardwareRobot:
    """Motors and IMU as one body.

    Args:
        description: whose ranges a joint must be in at the start.
        observe: ask, never command: no motor is energised, whatever ``exchange`` is given.
    """

    def __init__(
        self,
        description: RobotDescription,
        motors: Motors,
        imu: Imu,
        *,
        observe: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.motors, self.imu, self.observe = motors, imu, observe
        self.cleared = 0
        """How often latched motors were stopped and started anew."""
        self._range = np.array(description.joints.lower), np.array(description.joints.upper)
        self._clock = clock
        self._connected = False
        self._clear_at = -np.inf
        self._faulty = False

    async def connect(self) -> None:
        """See ``Robot.connect``."""
        await self.close()
        results = await asyncio.gather(self._connect_motors(), self.imu.connect(), return_exceptions=True)
        fatal = [
            result for result in results if isinstance(result, BaseException) and not isinstance(result, DriverError)
        ]
        report = [str(result) for result in results if isinstance(result, DriverError)]
        if fatal or report:
            await self._release()
        if fatal:
            raise fatal[0]
        if report:
            raise DriverError("\n".join(report))
        self._connected = True

    async def exchange(self, command: JointCommand) -> Measurement:
        """See ``Robot.exchange``.

        Raises:
            BusTimeout: not one motor answered for longer than is coasted over.
            ValueError: a number in ``command`` is not finite; nothing was sent.
        """
        if not self._connected:
            raise NotConnected("the robot is not connected")
        stamp = self._clock()
        if self.observe:
            await self.motors.query()
        elif self._wants_clearing(command):
            await self.motors.stop()
        else:
            await self.motors.command(command)
        joints = self.motors.joint_state()
        if self.motors.all_silent:
            raise BusTimeout(f"no motor answered for {joints.age.min() * 1e3:.0f} ms: supply? emergency stop? bus?")
        self._faulty = bool((~np.isin(joints.fault, _NOT_CLEARABLE)).any())
        return Measurement(stamp, self.imu.latest(), joints, self.motors.voltage)

    @property
    def troubles(self) -> dict[str, int]:
        """See ``Robot.troubles``: of the motors' replies, of the buses and of the IMU."""
        counted = self.motors.counters.troubles() | self.motors.bus.counters.troubles() | self.imu.troubles()
        return {name: count for name, count in counted.items() if count}

    async def close(self) -> None:
        """See ``Robot.close``."""
        if self._connected and not self.observe:
            for _ in range(_STOPS):
                await self.motors.stop()
        await self._release()

    async def _release(self) -> None:
        self._connected = False
        await asyncio.gather(self.motors.close(), self.imu.close())

    async def _connect_motors(self) -> None:
        motors = self.motors
        motors.reset()
        await motors.open()
        await self._ask_until_all_answered(motors.query)
        for _ in range(_MORE_QUESTIONS):
            await motors.query()
        silent = motors.silent(ANSWER_TIME)
        problems = [f"{motors.name(index)} does not answer: supply, cable, id?" for index in silent]
        problems += [
            f"{motors.name(index)}: two motors share this id; give one another (the maker's tool)"
            for index in motors.doubled()
        ]
        problems += self._faults()
        if not problems and not self.observe:
            await self._ask_until_all_answered(motors.stop)
            problems = self._faults()
        problems += self._outside(motors.joint_state().position)
        if problems:
            raise DriverError("\n".join(problems))

    async def _ask_until_all_answered(self, ask: Callable[[], Awaitable[None]]) -> None:
        start = self._clock()
        for _ in range(_QUESTIONS):
            await ask()
            if not self.motors.silent(self._clock() - start):
                return
            await asyncio.sleep(ANSWER_TIME / _QUESTIONS)

    def _faults(self) -> list[str]:
        motors, faults = self.motors, self.motors.joint_state().fault.ravel()
        return [
            f"{motors.name(index)}: {motors.describe_fault(code)}; switch it off and on when the cause is gone"
            for index, code in enumerate(faults.tolist())
            if code and code not in motors.codec.latches
        ]

    def _outside(self, position: Array) -> list[str]:
        lower, upper = self._range
        outside = (position < lower - RANGE_MARGIN) | (position > upper + RANGE_MARGIN)
        return [
            f"{LEGS[leg]} {JOINTS[joint]} reads {position[leg, joint]:.2f} rad, its range is {lower[leg, joint]:g} to "
            f"{upper[leg, joint]:g}: fold the legs and power up again, or trotd commission"
            for leg, joint in np.argwhere(outside)
        ]

    def _wants_clearing(self, command: JointCommand) -> bool:
        """Latched motors are stopped and start anew only while nothing but damping is asked, and not all the time."""
        if not self._faulty or command.kp.any() or command.torque.any() or self._clock() < self._clear_at:
            return False
        self._clear_at = self._clock() + CLEAR_INTERVAL
        self.cleared += 1
        return True
