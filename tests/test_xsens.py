"""The IMU driver against an emulated device on a pseudo-terminal: start, signs, faults, unplug and replug."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest
from daemons import until

from drivers.errors import DriverError, NotConnected
from drivers.wiring import ImuConfig
from drivers.xsens import Xsens
from sim.serial_imu import SerialImu

STILL = (np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.array([0.0, 0.0, 9.81]))
ROLLED = np.array([math.cos(0.2), math.sin(0.2), 0.0, 0.0])


class Pace:
    """Feeds the device samples at its own rate; the test turns what it feels."""

    def __init__(self, imu: SerialImu) -> None:
        self.imu, self.feels, self.ticks = imu, STILL, 0

    async def run(self) -> None:
        while True:
            await asyncio.sleep(0.0025)
            self.ticks += 1
            self.imu.measure(self.ticks * 0.0025, *self.feels)


@contextlib.asynccontextmanager
async def device(path: Path, product: str = "MTI-630", baud: int = 921600) -> AsyncIterator[tuple[SerialImu, Pace]]:
    imu = SerialImu(path, product, baud)  # type: ignore[arg-type]
    pace = Pace(imu)
    imu.plug_in()
    task = asyncio.create_task(pace.run())
    try:
        yield imu, pace
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        imu.unplug()


@contextlib.asynccontextmanager
async def connected(config: ImuConfig) -> AsyncIterator[Xsens]:
    xsens = Xsens(config)
    await xsens.connect()
    try:
        yield xsens
    finally:
        await xsens.close()


@pytest.mark.parametrize(("product", "gives"), [("MTI-630", True), ("MTI-610", False)])
def test_both_kinds_give_orientation_in_the_bodys_frame(tmp_path, product, gives):
    mount = (0.0, 1.0, 0.0, 0.0)  # upside down: turned half about x

    async def go() -> None:
        path = tmp_path / "imu"
        async with device(path, product) as (_, pace):
            # the body rolled by 0.4 rad; the sensor hangs upside down in it
            up = np.array([0.0, math.sin(0.4), math.cos(0.4)]) * 9.81
            sensor = np.array([-ROLLED[1], ROLLED[0], -ROLLED[3], ROLLED[2]])  # rolled * half turn about x
            pace.feels = (sensor, np.array([0.1, -0.2, -0.3]) * 0, up * [1, -1, -1])
            async with connected(ImuConfig(port=str(path), mount=mount)) as xsens:
                await until(lambda: xsens.counters.samples > 20)
                assert xsens.identity is not None
                assert xsens.identity.gives_orientation is gives
                sample = xsens.latest()
                assert sample.linear_acceleration == pytest.approx(up, abs=1e-4)
                assert abs(float(sample.orientation @ ROLLED)) == pytest.approx(1.0, abs=1e-3)

    asyncio.run(go())


def test_a_device_at_another_baud_is_found_and_moved(tmp_path):
    async def go() -> None:
        path = tmp_path / "imu"
        async with device(path, baud=115200) as (imu, _), connected(ImuConfig(port=str(path))) as xsens:
            assert imu.emulator.baud == 921600
            await until(lambda: xsens.counters.samples > 5)
            assert xsens.latest().linear_acceleration[2] == pytest.approx(9.81, abs=1e-4)

    asyncio.run(go())


def test_a_rate_that_the_line_cannot_carry_is_refused(tmp_path):
    async def go() -> None:
        path = tmp_path / "imu"
        async with device(path, baud=115200):
            with pytest.raises(DriverError, match="baud rate is too low"):
                await Xsens(ImuConfig(port=str(path), baud=115200)).connect()

    asyncio.run(go())


def test_cable_faults_are_counted_and_survived(tmp_path):
    async def go() -> None:
        path = tmp_path / "imu"
        async with device(path) as (imu, _), connected(ImuConfig(port=str(path))) as xsens:
            await until(lambda: xsens.counters.samples > 10)
            imu.faults.corrupt, imu.faults.garbage, imu.faults.split = 1, 2, 3
            await until(lambda: imu.faults.split == 0)
            imu.faults.lose = 4
            imu.emulator.clipping = True
            await until(lambda: imu.faults.lose == 0)
            start = xsens.counters.samples
            await until(lambda: xsens.counters.samples > start + 5)
            assert xsens.counters.lost == 5
            assert xsens.link.corrupt >= 1
            assert xsens.counters.clipped > 0
            assert xsens.counters.restarts == 0

    asyncio.run(go())


def test_unplugged_it_grows_old_and_plugged_in_it_starts_anew(tmp_path):
    async def go() -> None:
        path = tmp_path / "imu"
        config = ImuConfig(port=str(path), reopen_interval=0.05)
        async with device(path) as (imu, _), connected(config) as xsens:
            await until(lambda: xsens.counters.samples > 5)
            imu.unplug()
            last = xsens.latest()
            await asyncio.sleep(0.3)
            assert xsens.latest().stamp == last.stamp
            imu.plug_in()
            await until(lambda: xsens.latest().stamp > last.stamp)
            assert xsens.counters.restarts >= 1

    asyncio.run(go())


def test_a_device_that_resets_by_itself_is_configured_again(tmp_path):
    async def go() -> None:
        path = tmp_path / "imu"
        async with device(path) as (imu, _), connected(ImuConfig(port=str(path))) as xsens:
            await until(lambda: xsens.counters.samples > 5)
            imu.emulator.outputs = imu.emulator.outputs[:1]
            imu.port.write(imu.emulator.wake_up())
            await until(lambda: xsens.counters.restarts == 1)
            seen = xsens.counters.samples
            await until(lambda: xsens.counters.samples > seen + 5)

    asyncio.run(go())


def test_bad_ports_say_what_was_found_and_what_to_do(tmp_path):
    async def go() -> None:
        with pytest.raises(DriverError, match="plugged in"):
            await Xsens(ImuConfig(port=str(tmp_path / "none"))).connect()
        path = tmp_path / "imu"
        async with device(path) as (imu, _):
            imu.emulator.silent = True
            with pytest.raises(DriverError, match="bootloader"):
                await Xsens(ImuConfig(port=str(path))).connect()

    asyncio.run(go())


def test_before_connect_there_is_no_sample():
    with pytest.raises(NotConnected):
        Xsens(ImuConfig()).latest()
    with pytest.raises(ValueError, match="divide 400"):
        Xsens(ImuConfig(rate_hz=300))


def test_stamps_are_on_our_clock_and_recent(tmp_path):
    import time

    async def go() -> None:
        path = tmp_path / "imu"
        async with device(path) as _, connected(ImuConfig(port=str(path))) as xsens:
            await until(lambda: xsens.counters.samples > 40)
            before, last = time.monotonic(), xsens.latest().stamp
            await until(lambda: xsens.latest().stamp > before)
            assert last <= before and xsens.latest().stamp <= time.monotonic()

    asyncio.run(go())
