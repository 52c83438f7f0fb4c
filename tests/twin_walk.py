"""The lock-step walk with real channels and a real pseudo-terminal between drivers and emulators."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import msgspec

from drivers.can_bus import PythonCanBus
from drivers.hardware import HardwareRobot
from drivers.motors import Motors
from drivers.robot import JointCommand, Measurement
from drivers.wiring import BusConfig
from drivers.xsens import Xsens
from sim.twin import WireTwin
from trotd.lockstep import TwinWalk
from trotd.twin import free_ports

QUICK: dict[str, object] = {
    "posture.soft_start": 0.2,
    "posture.fold_time": 0.3,
    "posture.rise_time": 0.6,
    "posture.settle_time": 0.1,
}
"""Up in a second, for tests of what comes after."""


class WireWalk(TwinWalk):
    """One robot over UDP multicast and a pseudo-terminal, in one event loop. A context manager around them."""

    def __init__(self, folder: Path, **options: Any) -> None:
        self.path = folder / "imu"
        self.loop = asyncio.new_event_loop()
        super().__init__(QUICK, **options)

    def connect(self) -> None:
        assert self.config.motors is not None and self.config.imu is not None
        groups = tuple(f"239.74.163.{number}" for number in range(2, 6))
        bus = BusConfig(
            backend="udp_multicast", channels=groups, port=free_ports(4), reply_timeout=0.05, reopen_interval=0.05
        )
        self.wires = WireTwin(self.world, self.setup, self.path, self.clock)
        self.twin = self.wires.body
        imu = msgspec.structs.replace(self.config.imu, port=str(self.path), reopen_interval=0.05)
        self.imu = Xsens(imu, clock=self.clock)
        self.motors = Motors(
            self.config.motors, PythonCanBus(bus, fd=self.setup.motors.protocol == "moteus"), 0.05, clock=self.clock
        )
        self.robot = HardwareRobot(self.config.robot, self.motors, self.imu, clock=self.clock)
        self.do(self._start(bus))

    async def _start(self, bus: BusConfig) -> None:
        self.wires.open(bus)
        living = asyncio.get_running_loop().create_task(self.wires.run(1 / self.config.control.rate_hz, 0.0))
        try:
            await self.robot.connect()
        finally:
            living.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await living

    def do(self, work: Coroutine[Any, Any, Any]) -> Any:
        return self.loop.run_until_complete(work)

    def exchange(self, command: JointCommand) -> Measurement:
        measurement: Measurement = self.do(self.robot.exchange(command))
        self.live()
        return measurement

    def live(self) -> None:
        self.do(self._live())

    async def _live(self) -> None:
        """One tick of the body; its IMU's bytes are waited for, as the kernel takes its time with them."""
        before = self.imu.counters.samples + self.imu.link.corrupt
        self.wires.live(self.steps)
        for _ in range(50):
            await asyncio.sleep(0.0005)
            if self.imu.counters.samples + self.imu.link.corrupt > before:
                return

    def unplug(self) -> None:
        """Pull the IMU's cable."""
        self.do(self._in_loop(self.wires.imu.unplug))

    def plug_in(self) -> None:
        """Put it back."""
        self.do(self._in_loop(self.wires.imu.plug_in))

    @staticmethod
    async def _in_loop(act: Callable[[], None]) -> None:
        act()

    def __enter__(self) -> WireWalk:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the wires."""
        self.do(self.robot.close())
        self.do(self._in_loop(self.wires.close))
        self.loop.close()
        self.world.close()
