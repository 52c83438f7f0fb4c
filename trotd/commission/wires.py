"""What commissioning reads over real wires, between two questions to a person."""

from __future__ import annotations

import asyncio

import msgspec
import numpy as np

from drivers.commissioning import MotorPlace
from drivers.errors import DriverError
from drivers.hardware import build_bus
from drivers.robot import Array
from drivers.survey import FoundMotor, build_question, survey
from drivers.wiggle import wiggle
from drivers.xsens import Xsens
from trotd.wire import Wires

LISTENING_TIME = 0.5
"""s over which the accelerometer is averaged."""
_UNMOUNTED = (1.0, 0.0, 0.0, 0.0)


class CommissionWires:
    """The buses and the IMU of one robot, opened for each reading alone. A context manager around their loop."""

    def __init__(self, wires: Wires) -> None:
        self._wires = wires
        self._question = build_question(wires.motors)
        self._runner = asyncio.Runner()
        self._ids: list[int] = []

    def __enter__(self) -> CommissionWires:
        return self

    def __exit__(self, *_: object) -> None:
        self._runner.close()

    def scan(self) -> list[FoundMotor]:
        """Every motor that answers; the first time all ids are tried.

        Raises:
            DriverError: a bus cannot be opened, nobody answers, a motor has a fault, or two share an id.
        """
        buses = range(1, len(self._wires.bus.channels) + 1)
        bus = build_bus(self._wires.bus, self._wires.motors)
        found = self._runner.run(survey(bus, buses, self._question, self._ids or None))
        if not found:
            raise DriverError(f"no motor answers on bus {', '.join(map(str, buses))}: supply? emergency stop? plugs?")
        doubled = [f"id {motor.id} on bus {motor.bus}" for motor in found if motor.replies > 1]
        if doubled:
            raise DriverError(f"two motors share {', '.join(doubled)}: give one another id (the maker's tool)")
        self._ids = sorted({motor.id for motor in found})
        return found

    def motors(self) -> dict[MotorPlace, float]:
        """See ``Readings.motors``; errors as ``scan``."""
        return {(motor.bus, motor.id): motor.position for motor in self.scan()}

    def wiggle(self, place: MotorPlace) -> float:
        """See ``Readings.wiggle``.

        Raises:
            DriverError: it does not answer, has a fault, or does not turn.
        """
        return self._runner.run(wiggle(build_bus(self._wires.bus, self._wires.motors), self._wires.motors, place))

    def force(self) -> Array:
        """See ``Readings.force``: the mean over a while.

        Raises:
            DriverError: the IMU cannot be reached.
        """
        return self._runner.run(self._listen())

    async def _listen(self) -> Array:
        imu = Xsens(msgspec.structs.replace(self._wires.imu, mount=_UNMOUNTED))
        await imu.connect()
        try:
            samples = []
            for _ in range(50):
                await asyncio.sleep(LISTENING_TIME / 50)
                samples.append(imu.latest().linear_acceleration)
        finally:
            await imu.close()
        mean: Array = np.mean(samples, axis=0)
        return mean
