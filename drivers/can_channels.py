"""One CAN bus each, by python-can: socketcan on the robot, udp_multicast between processes, virtual within one.

python-can opens and configures every one of them. Where it makes two or three objects of each frame and asks the kernel
twice, frames go straight through its socket.
"""

from __future__ import annotations

import errno
import os
import socket
import struct
from typing import Any, Protocol

from drivers.bus import BusCounters
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
    """A python-can bus through its own interface: virtual."""

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


class MulticastChannel:
    """python-can's udp_multicast: a frame is a datagram, a msgpack map with the names of ``can.Message``.

    A host hears its own frames too.
    """

    def __init__(self, bus: Any, counters: BusCounters, fd: bool, group: str, port: int) -> None:
        import msgpack

        self.counters = counters
        self._bus, self._fd, self._to = bus, fd, (group, port)
        self._socket = socket.socket(fileno=os.dup(bus.fileno()))
        self._pack, self._unpack = msgpack.packb, msgpack.unpackb

    def send(self, identifier: int, data: bytes) -> None:
        """See ``Channel.send``."""
        fd = self._fd
        message = {
            "timestamp": 0.0, "arbitration_id": identifier, "is_extended_id": identifier > STANDARD_ID_MAX,
            "is_remote_frame": False, "is_error_frame": False, "channel": None, "dlc": len(data), "data": data,
            "is_fd": fd, "bitrate_switch": fd, "error_state_indicator": False,
        }  # fmt: skip
        self._socket.sendto(self._pack(message), socket.MSG_DONTWAIT, self._to)

    def read(self) -> list[tuple[int, bytes]]:
        """See ``Channel.read``."""
        frames: list[tuple[int, bytes]] = []
        receive, unpack = self._socket.recv, self._unpack
        while True:
            try:
                raw = receive(_DATAGRAM, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return frames
            try:
                message = unpack(raw)
                identifier, data = message["arbitration_id"], message["data"]
                whole = not message["is_error_frame"] and isinstance(identifier, int) and isinstance(data, bytes)
            except (ValueError, KeyError, TypeError, RecursionError):  # msgpack's own are ValueErrors
                whole = False
            if whole:
                frames.append((identifier, data))
            else:
                self.counters.error_frames += 1

    def fileno(self) -> int:
        """See ``Channel.fileno``."""
        return self._socket.fileno()

    def close(self) -> None:
        """See ``Channel.close``."""
        self._socket.close()
        self._bus.shutdown()


_DATAGRAM = 4096


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
    if config.backend == "socketcan":
        return SocketCanChannel(bus, counters, fd)
    if config.backend == "udp_multicast":
        return MulticastChannel(bus, counters, fd, name, config.port + index)
    return PythonCanChannel(bus, counters, fd)


def _advice(error: BaseException) -> str:
    number = getattr(error, "errno", None) or getattr(error, "error_code", None)
    return {
        errno.EPERM: "run with the rights to open it",
        errno.EACCES: "run with the rights to open it",
        errno.ENODEV: "is the adapter plugged in and its interface up? (ip link)",
        errno.EAFNOSUPPORT: "this kernel has no CAN: load can_raw, or use another back-end",
        errno.ENETDOWN: "set the interface up (deploy/networkd does it at boot)",
    }.get(number or 0, "see docs/robots.md")
