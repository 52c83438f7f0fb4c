"""The mjbots pi3hat as a bus back-end: one C++ cycle a tick, in its own thread, without the interpreter's lock.

The library (``moteus-pi3hat``, Raspberry Pi 3 and 4 only) is optional and imported here alone. Its thread pokes SPI
through /dev/mem as root and busy-waits, so it wants a core of its own (``[bus] cpu``; see docs/operations.md).
"""

from __future__ import annotations

import asyncio
import importlib
from collections.abc import Sequence
from typing import Any

from drivers.bus import BusCounters, Frame, Receive
from drivers.errors import DriverError
from drivers.wiring import BusConfig

PORTS = {f"JC{port}": port for port in range(1, 6)}
SPI_SPEED_HZ = 10_000_000
MIN_TX_WAIT_NS = 200_000


def load_library() -> Any:
    """The native module of moteus-pi3hat.

    Raises:
        DriverError: not installed, or too old.
    """
    try:
        package = importlib.import_module("moteus_pi3hat.pi3hat_device")
        return package._pi3hat_device
    except (ImportError, AttributeError) as error:
        raise DriverError(f"pi3hat: {error}; on the Pi: pip install 'moteus-pi3hat>=1.1'") from error


class Pi3HatBus:
    """Frames on the JC connectors. ``channels`` of the config name them: ``JC1`` … ``JC5``."""

    def __init__(self, config: BusConfig, *, fd: bool, library: Any = None) -> None:
        unknown = [name for name in config.channels if name not in PORTS]
        if unknown:
            raise ValueError(f"pi3hat channels {unknown}: the connectors are {', '.join(PORTS)}")
        if not fd:
            raise ValueError("pi3hat: only CAN-FD motors (moteus) are supported")
        self.counters = BusCounters()
        self._config = config
        self._ports = [PORTS[name] for name in config.channels]
        self._bus_of_port = {port: bus for bus, port in enumerate(self._ports)}
        self._library, self._device = library, None
        self._receive: Receive | None = None
        self._busy: asyncio.Future[Any] | None = None

    async def open(self, receive: Receive) -> None:
        """See ``Bus.open``. Construction starts the native thread, which fails without /dev/mem."""
        library = self._library or load_library()
        options = library.Options()
        options.cpu, options.spi_speed_hz = self._config.cpu, SPI_SPEED_HZ
        try:
            self._device = library.Pi3HatDevice(options)
        except Exception as error:
            raise DriverError(f"pi3hat: {error}; it needs root, /dev/mem, and a Raspberry Pi 3 or 4") from error
        self._library, self._receive = library, receive

    async def cycle(self, frames: Sequence[Frame], reply_time: float) -> None:
        """See ``Bus.cycle``. Cancelled, it still lets the native cycle end: two at a time are forbidden."""
        if self._device is None or self._receive is None:
            self.counters.send_failures += len(frames)
            return
        await self._settle()
        loop = asyncio.get_running_loop()
        future: asyncio.Future[Any] = loop.create_future()
        self._busy = future
        self._device.cycle(
            self._input(frames, reply_time), lambda output: loop.call_soon_threadsafe(_finish, future, output)
        )
        self.counters.sent += len(frames)
        output = await asyncio.shield(future)
        for frame in output.rx_can:
            bus = self._bus_of_port.get(frame.bus)
            if bus is None:
                continue
            self.counters.received += 1
            self._receive(bus, frame.arbitration_id, bytes(frame.data))

    async def close(self) -> None:
        """See ``Bus.close``."""
        await self._settle()
        self._device = self._receive = None

    async def _settle(self) -> None:
        if self._busy is not None and not self._busy.done():
            await asyncio.shield(self._busy)
        self._busy = None

    def _input(self, frames: Sequence[Frame], reply_time: float) -> Any:
        cycle = self._library.Input()
        cycle.tx_can = [self._frame(*frame) for frame in frames]
        cycle.force_can_check = sum(1 << port for port in self._ports)
        cycle.max_rx = 2 * len(frames)
        cycle.min_tx_wait_ns = MIN_TX_WAIT_NS
        cycle.rx_baseline_wait_ns = int(reply_time * 1e9)
        return cycle

    def _frame(self, bus: int, identifier: int, data: bytes) -> Any:
        frame = self._library.SingleCan()
        frame.arbitration_id, frame.bus, frame.data = identifier, self._ports[bus], data
        frame.expect_reply = True
        return frame


def _finish(future: asyncio.Future[Any], output: Any) -> None:
    if not future.done():
        future.set_result(output)
