"""An Xsens MTi on a serial port, on the event loop: configured, measuring, its newest sample held with its time.

What the device cannot do is done here: one that gives no orientation gets ``drivers.attitude``; its time becomes ours
by ``drivers.device_clock``; the way it is mounted is turned out. A device that falls silent, resets or is unplugged is
started anew at intervals, and until then its last sample's age tells.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers import xbus
from drivers.attitude import AttitudeFilter
from drivers.device_clock import DeviceClock
from drivers.errors import CorruptFrame, DriverError, NotConnected
from drivers.mounting import Mounting
from drivers.mtdata2 import STATUS_CLIPPING, STATUS_SELF_TEST, Data, Sample, SampleDecoder
from drivers.robot import Array, ImuSample
from drivers.wiring import ImuConfig
from drivers.xbus import BAUD_CODES, ERRORS, Message, Output
from drivers.xbus_link import Port, XbusLink, open_port

WITH_EVERY_PACKET = 0xFFFF
SILENCE = 0.25
"""s without a sample after which the device is started anew."""
FIRST_SAMPLE_TIME = 0.5
_DATA_OVERFLOW = 41
_TICKS_PER_SECOND, _TICK_BITS = 10_000, 32


@dataclass(slots=True)
class ImuCounters:
    """What came, and what did not."""

    samples: int = 0
    lost: int = 0
    """By the packet counter."""
    corrupt: int = 0
    """Measurements that do not decode; ``link.corrupt`` counts the packets before."""
    clipped: int = 0
    self_test_failed: int = 0
    restarts: int = 0

    def troubles(self) -> dict[str, int]:
        """What of it should not be, by its name."""
        return {
            "IMU samples lost": self.lost, "IMU samples corrupt": self.corrupt, "IMU samples clipped": self.clipped,
            "IMU restarts": self.restarts,
        }  # fmt: skip


@dataclass(frozen=True, slots=True)
class ImuIdentity:
    """What the device says of itself."""

    product_code: str
    device_id: str
    firmware: str
    gives_orientation: bool


class Xsens:
    """One device."""

    def __init__(
        self,
        config: ImuConfig,
        *,
        clock: Callable[[], float] = time.monotonic,
        open_port: Callable[[str, int], Port] = open_port,
    ) -> None:
        if 400 % config.rate_hz:
            raise ValueError(f"imu.rate_hz = {config.rate_hz}: must divide 400")
        self.config, self.counters = config, ImuCounters()
        self.identity: ImuIdentity | None = None
        self.link = XbusLink(config.port, self._take, self._lose, open_port)
        self._clock, self._mounting = clock, Mounting(config.mount)
        self._decoder = SampleDecoder()
        self._device_clock = DeviceClock(_TICKS_PER_SECOND, _TICK_BITS)
        self._filter = AttitudeFilter(config.rate_hz)
        self._sample: Sample | None = None
        self._sampled = asyncio.Event()
        self._continues = False
        self._orientation: Array | tuple[float, ...] = ()
        self._stamp = -np.inf
        self._given: ImuSample | None = None
        self._lost = False
        self._keeper: asyncio.Task[None] | None = None

    async def connect(self) -> None:
        """Open, configure, measure; returns with the first sample.

        Raises:
            DriverError: what was found instead, and what to do.
        """
        await self.close()
        try:
            await self._start()
        except BaseException:
            self.link.close()
            raise
        self._keeper = asyncio.create_task(self._keep_alive(), name="imu")

    def troubles(self) -> dict[str, int]:
        """What went wrong since the start, counted, by its name."""
        return self.counters.troubles()

    def latest(self) -> ImuSample:
        """The newest sample, in the body's frame.

        Raises:
            NotConnected: there is none yet.
        """
        sample = self._sample
        if sample is None:
            raise NotConnected("the IMU has not given a sample")
        if self._given is None:
            self._given = ImuSample(
                self._stamp,
                self._mounting.orientation(np.array(self._orientation)),
                self._mounting.vector(np.array(sample.rate)),
                self._mounting.vector(np.array(sample.acceleration)),
            )
        return self._given

    async def close(self) -> None:
        """Release the port. Never raises."""
        keeper, self._keeper = self._keeper, None
        if keeper is not None:
            keeper.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await keeper
        self.link.close()

    # Starting ----------------------------------------------------------------------------------------------------

    async def _start(self) -> None:
        """From a closed port to the first sample."""
        await self._find()
        self.identity = await self._identify()
        await self._set_options()
        await self._configure_outputs()
        self._device_clock.reset()
        self._filter.reset()
        self._sampled.clear()
        self._continues = self._lost = False
        await self.link.request(Message.GO_TO_MEASUREMENT)
        await self._first_sample()

    async def _find(self) -> None:
        """Open at the wanted baud, or find the device at another one and move it."""
        config = self.config
        for baud in (config.baud, *(other for other in BAUD_CODES if other != config.baud)):
            self.link.open(baud)
            try:
                await self.link.request(Message.GO_TO_CONFIG)
            except DriverError:
                self.link.close()
                continue
            if baud != config.baud:
                await self._move_from(baud)
            return
        raise DriverError(
            f"IMU on {config.port}: no answer at any baud rate; is it an MTi, powered, and not in its bootloader? "
            "(unplug it and plug it in again)"
        )

    async def _move_from(self, baud: int) -> None:
        config = self.config
        await self.link.request(Message.SET_BAUD, bytes([BAUD_CODES[config.baud]]))
        await self.link.request(Message.RESET)
        self.link.open(config.baud)
        try:
            await self.link.request(Message.GO_TO_CONFIG)
        except DriverError as error:
            raise DriverError(
                f"IMU on {config.port} answers at {baud} baud and did not move to {config.baud}; "
                "set it with the maker's tool, or imu.baud"
            ) from error

    async def _identify(self) -> ImuIdentity:
        code = (await self.link.request(Message.REQUEST_PRODUCT_CODE)).decode("ascii", "replace").strip(" \0")
        device = (await self.link.request(Message.REQUEST_DEVICE_ID)).hex().upper()
        firmware = ".".join(str(byte) for byte in (await self.link.request(Message.REQUEST_FIRMWARE))[:3])
        return ImuIdentity(code, device, firmware, not re.match(r"MTI-6\d?1\d", code, re.IGNORECASE))

    async def _set_options(self) -> None:
        config = self.config
        if config.set_options or config.clear_options:
            await self.link.request(
                Message.SET_OPTION_FLAGS, struct.pack(">II", config.set_options, config.clear_options)
            )

    async def _configure_outputs(self) -> None:
        """Ask for orientation only where the device has one, and hold it to what it echoes."""
        assert self.identity is not None
        rate = self.config.rate_hz
        wanted = [Output(Data.PACKET_COUNTER, WITH_EVERY_PACKET), Output(Data.SAMPLE_TIME_FINE, WITH_EVERY_PACKET)]
        if self.identity.gives_orientation:
            wanted.append(Output(Data.QUATERNION, rate))
        wanted += [Output(Data.ACCELERATION, rate), Output(Data.RATE_OF_TURN, rate)]
        wanted.append(Output(Data.STATUS_WORD, WITH_EVERY_PACKET))
        answer = await self.link.request(Message.SET_OUTPUT_CONFIGURATION, xbus.encode_outputs(wanted))
        given = {output.identifier & 0xFFF0: output.rate_hz for output in xbus.decode_outputs(answer)}
        for output in wanted:
            rate_hz = given.get(output.identifier)
            if output.identifier == Data.QUATERNION and not rate_hz:
                self.identity = ImuIdentity(
                    self.identity.product_code, self.identity.device_id, self.identity.firmware, False
                )
            elif rate_hz is None or (output.rate_hz != WITH_EVERY_PACKET and rate_hz != output.rate_hz):
                raise DriverError(
                    f"IMU {self.identity.product_code}: output 0x{output.identifier:04x} at {output.rate_hz} Hz was "
                    f"asked, {rate_hz or 0} Hz is given; choose another imu.rate_hz"
                )

    async def _first_sample(self) -> None:
        errors_before = self.link.errors[_DATA_OVERFLOW]
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(FIRST_SAMPLE_TIME):
                await self._sampled.wait()
        if self.link.errors[_DATA_OVERFLOW] > errors_before:
            raise DriverError(f"IMU: {ERRORS[_DATA_OVERFLOW]}; raise imu.baud or lower imu.rate_hz")
        if not self._sampled.is_set():
            raise DriverError(f"IMU on {self.config.port}: no sample within {FIRST_SAMPLE_TIME} s of measuring")

    async def _keep_alive(self) -> None:
        """Silence is counted in wakes without a sample: after a stall of this process what came still waits unread."""
        silent, before = 0, -1
        while True:
            await asyncio.sleep(SILENCE / 4)
            silent = 0 if self.counters.samples != before else silent + 1
            before = self.counters.samples
            if not self._lost and silent < 4:
                continue
            self.counters.restarts += 1
            try:
                await self._start()
            except DriverError:
                self._lost = True
                self.link.close()
                await asyncio.sleep(self.config.reopen_interval)

    def _lose(self) -> None:
        self._lost = True

    def _take(self, data: bytes) -> None:
        counters = self.counters
        try:
            sample = self._decoder.decode(data)
        except CorruptFrame:
            counters.corrupt += 1
            return
        before, self._sample, self._given = self._sample, sample, None
        self._stamp = self._device_clock.stamp(sample.ticks, self._clock())
        elapsed = 0.0
        if self._continues and before is not None:
            counters.lost += max(0, (sample.counter - before.counter & 0xFFFF) - 1)
            elapsed = (sample.ticks - before.ticks & 0xFFFFFFFF) / _TICKS_PER_SECOND
        counters.samples += 1
        counters.clipped += bool(sample.status & STATUS_CLIPPING)
        counters.self_test_failed += not sample.status & STATUS_SELF_TEST
        self._orientation = sample.orientation or self._filter.update(
            np.array(sample.rate), np.array(sample.acceleration), elapsed
        )
        self._continues = True
        self._sampled.set()
