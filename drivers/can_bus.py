"""CAN buses by python-can: socketcan on the robot, udp_multicast between processes, virtual within one."""

from __future__ import annotations

import asyncio
import errno
import socket
import struct
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from drivers.bus import BusCounters, Frame, Receive, nobody
from drivers.errors import DriverError
from drivers.wiring import BusConfig

STANDARD_ID_MAX = 0x7FF


class Channel(Protocol):
    """One bus of the python-can family, non-blocking."""

    counters: BusCounters

    def send(self, identifier: int, data: bytes) -> None:
        """Hand one frame to the kernel.

        Raises:
            OSError: it did not take it.
        """

    def read(self) -> list[tuple[int, bytes]]:
        """All frames that are there now.

        Raises:
            OSError: the interface went away.
        """
        ...

    def fileno(self) -> int:
        """To wait on, or -1 where there is nothing to wait on."""
        ...

    def close(self) -> None:
        """Release it."""


class PythonCanChannel:
    """A python-can bus through its own interface: udp_multicast and virtual."""

    def __init__(self, bus: Any, counters: BusCounters, fd: bool) -> None:
        import can

        self.counters = counters
        self._bus, self._fd, self._message, self._error = bus, fd, can.Message, can.CanError

    def send(self, identifier: int, data: bytes) -> None:
        """See ``Channel.send``."""
        message = self._message(
            arbitration_id=identifier,
            is_extended_id=identifier > STANDARD_ID_MAX,
            data=data,
            is_fd=self._fd,
            bitrate_switch=self._fd,
        )
        try:
            self._bus.send(message, timeout=0)
        except self._error as error:
            raise OSError(errno.EIO, str(error)) from error

    def read(self) -> list[tuple[int, bytes]]:
        """See ``Channel.read``."""
        frames: list[tuple[int, bytes]] = []
        while True:
            try:
                message = self._bus.recv(0)
            except self._error:
                self.counters.error_frames += 1
                continue
            if message is None:
                return frames
            if message.is_error_frame:
                self.counters.error_frames += 1
            else:
                frames.append((message.arbitration_id, bytes(message.data)))

    def fileno(self) -> int:
        """See ``Channel.fileno``."""
        try:
            return int(self._bus.fileno())
        except NotImplementedError:
            return -1

    def close(self) -> None:
        """See ``Channel.close``."""
        self._bus.shutdown()


_EXTENDED, _ERROR_FLAG, _ID_MASK = 0x80000000, 0x20000000, 0x1FFFFFFF
_FD_FRAME, _CLASSIC_FRAME = struct.Struct("=IBBxx64s"), struct.Struct("=IBxxx8s")
_FD_FLAGS = 0x04 | 0x01
"""CANFD_FDF and CANFD_BRS."""
_ERROR_BUS_OFF = 0x40


class SocketCanChannel:
    """Linux SocketCAN: python-can opens and configures the socket, frames go straight through it.

    Saves the two objects that python-can makes per frame (linux/can.h: ``canfd_frame``, ``can_frame``).
    """

    def __init__(self, bus: Any, counters: BusCounters, fd: bool) -> None:
        self.counters = counters
        self._bus, self._fd, self._socket = bus, fd, bus.socket

    def send(self, identifier: int, data: bytes) -> None:
        """See ``Channel.send``."""
        flagged = identifier | _EXTENDED if identifier > STANDARD_ID_MAX else identifier
        if self._fd:
            frame = _FD_FRAME.pack(flagged, len(data), _FD_FLAGS, data)
        else:
            frame = _CLASSIC_FRAME.pack(flagged, len(data), data)
        self._socket.send(frame, socket.MSG_DONTWAIT)

    def read(self) -> list[tuple[int, bytes]]:
        """See ``Channel.read``."""
        frames: list[tuple[int, bytes]] = []
        receive = self._socket.recv
        while True:
            try:
                raw = receive(_FD_FRAME.size, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return frames
            if len(raw) == _FD_FRAME.size:
                flagged, length, _, data = _FD_FRAME.unpack(raw)
            elif len(raw) == _CLASSIC_FRAME.size:
                flagged, length, data = _CLASSIC_FRAME.unpack(raw)
            else:
                self.counters.error_frames += 1
                continue
            if flagged & _ERROR_FLAG:
                self.counters.error_frames += 1
                self.counters.bus_off += bool(flagged & _ERROR_BUS_OFF)
            else:
                frames.append((flagged & _ID_MASK, data[:length]))

    def fileno(self) -> int:
        """See ``Channel.fileno``."""
        return int(self._socket.fileno())

    def close(self) -> None:
        """See ``Channel.close``."""
        self._bus.shutdown()


def open_channel(config: BusConfig, index: int, counters: BusCounters, fd: bool) -> Channel:
    """Open bus ``index`` of ``config`` by python-can.

    Raises:
        DriverError: says what to do about it.
    """
    import can

    name = config.channels[index]
    extra: dict[str, Any] = {"port": config.port + index, "hop_limit": 0} if config.backend == "udp_multicast" else {}
    try:
        bus = can.Bus(interface=config.backend, channel=name, fd=fd, **extra)
    except (OSError, can.CanError, ValueError) as error:
        raise DriverError(f"bus {index + 1} ({config.backend} {name}): {error}; {_advice(error)}") from error
    return SocketCanChannel(bus, counters, fd) if config.backend == "socketcan" else PythonCanChannel(bus, counters, fd)


def _advice(error: BaseException) -> str:
    number = getattr(error, "errno", None) or getattr(error, "error_code", None)
    return {
        errno.EPERM: "run with the rights to open it",
        errno.EACCES: "run with the rights to open it",
        errno.ENODEV: "is the adapter plugged in and its interface up? (ip link)",
        errno.EAFNOSUPPORT: "this kernel has no CAN: load can_raw, or use another back-end",
        errno.ENETDOWN: "set the interface up (deploy/networkd does it at boot)",
    }.get(number or 0, "see docs/robots.md")


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
