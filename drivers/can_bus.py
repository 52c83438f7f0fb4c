"""CAN buses on the event loop: one cycle a tick over all of a robot's channels."""

from __future__ import annotations

import asyncio
import errno
import time
from collections.abc import Callable, Sequence

from drivers.bus import BusCounters, Frame, Receive, nobody
from drivers.can_channels import Channel, open_channel
from drivers.errors import DriverError
from drivers.wiring import BusConfig


class PythonCanBus:
    """Up to sixteen channels on the event loop. A channel that fails is closed and opened anew at intervals."""

    def __init__(
        self,
        config: BusConfig,
        *,
        fd: bool,
        open_channel: Callable[[BusConfig, int, BusCounters, bool], Channel] = open_channel,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.counters = BusCounters()
        self._config, self._fd, self._open_channel, self._clock = config, fd, open_channel, clock
        self._channels: list[Channel | None] = [None] * len(config.channels)
        self._retry_at = [0.0] * len(config.channels)
        self._receive: Receive = nobody
        self._complete = asyncio.Event()

    async def open(self, receive: Receive) -> None:
        """See ``Bus.open``."""
        self._receive = receive
        failures = []
        for index in range(len(self._channels)):
            try:
                self._attach(index)
            except DriverError as error:
                failures.append(str(error))
        if failures:
            await self.close()
            raise DriverError("\n".join(failures))

    async def cycle(self, frames: Sequence[Frame], reply_time: float) -> None:
        """See ``Bus.cycle``."""
        for index in range(len(self._channels)):
            self._reopen(index)
            self._read(index)
        self._complete.clear()
        self._send(frames)
        deadline = asyncio.get_running_loop().time() + reply_time
        polled = [i for i, channel in enumerate(self._channels) if channel is not None and channel.fileno() < 0]
        try:
            async with asyncio.timeout_at(deadline):
                while polled and not self._complete.is_set():
                    for index in polled:
                        self._read(index)
                    await asyncio.sleep(_POLL_INTERVAL)
                await self._complete.wait()
        except TimeoutError:
            return

    async def close(self) -> None:
        """See ``Bus.close``."""
        for index in range(len(self._channels)):
            self._detach(index)
        self._receive = nobody

    def _attach(self, index: int) -> None:
        channel = self._open_channel(self._config, index, self.counters, self._fd)
        self._channels[index] = channel
        if channel.fileno() >= 0:
            asyncio.get_running_loop().add_reader(channel.fileno(), self._read, index)

    def _detach(self, index: int) -> None:
        channel, self._channels[index] = self._channels[index], None
        if channel is not None:
            if channel.fileno() >= 0:
                asyncio.get_running_loop().remove_reader(channel.fileno())
            channel.close()

    def _lose(self, index: int) -> None:
        self._detach(index)
        self._retry_at[index] = self._clock() + self._config.reopen_interval

    def _reopen(self, index: int) -> None:
        if self._channels[index] is not None or self._clock() < self._retry_at[index]:
            return
        try:
            self._attach(index)
        except DriverError:
            self._retry_at[index] = self._clock() + self._config.reopen_interval
        else:
            self.counters.reopened += 1

    def _send(self, frames: Sequence[Frame]) -> None:
        for bus, identifier, data in frames:
            channel = self._channels[bus]
            if channel is None:
                self.counters.send_failures += 1
                continue
            try:
                channel.send(identifier, data)
                self.counters.sent += 1
            except OSError as error:
                self.counters.send_failures += 1
                if error.errno in _GONE:
                    self._lose(bus)

    def _read(self, index: int) -> None:
        channel = self._channels[index]
        if channel is None:
            return
        try:
            frames = channel.read()
        except OSError:
            self._lose(index)
            return
        self.counters.received += len(frames)
        for identifier, data in frames:
            if self._receive(index, identifier, data):
                self._complete.set()


_POLL_INTERVAL = 1e-4
_GONE = (errno.ENETDOWN, errno.ENODEV, errno.ENXIO, errno.EBADF)
