"""A serial port that speaks Xbus, on the event loop: questions awaited, measurements handed on, loss noticed."""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections import Counter
from collections.abc import Callable
from typing import Any, Protocol

from drivers import xbus
from drivers.errors import DriverError
from drivers.xbus import ERRORS, Message, XbusParser

REPLY_TIME = 0.4
"""s that a question may take, with its repetitions."""
_TRIES = 3
_READ_SIZE = 4096


class Port(Protocol):
    """A serial port, raw and non-blocking."""

    def fileno(self) -> int:
        """To wait on."""
        ...

    def write(self, data: bytes, /) -> Any:
        """Send."""

    def close(self) -> None:
        """Release."""


def open_port(path: str, baud: int) -> Port:
    """Open a serial port for us alone.

    Raises:
        DriverError: says what to do about it.
    """
    import serial

    try:
        port: Port = serial.Serial(path, baud, timeout=0, write_timeout=0, exclusive=True)
    except (OSError, ValueError) as error:
        raise DriverError(
            f"IMU port {path}: {error}; plugged in? rights? (deploy/udev names it and opens it)"
        ) from error
    with contextlib.suppress(OSError, ValueError, NotImplementedError, AttributeError):
        port.set_low_latency_mode(True)  # type: ignore[attr-defined]  # FTDI otherwise holds bytes back for 16 ms
    return port


class XbusLink:
    """One port, opened and closed as often as it takes.

    Args:
        path: of the port.
        measured: takes the data of each MTData2.
        lost: called when the port is gone or the device started over.
    """

    def __init__(
        self,
        path: str,
        measured: Callable[[bytes], None],
        lost: Callable[[], None],
        open_port: Callable[[str, int], Port] = open_port,
    ) -> None:
        self.path = path
        self.corrupt = 0
        """Candidates for packets whose checksum or length was wrong."""
        self.errors: Counter[int] = Counter()
        """Error messages by code."""
        self._measured, self._lost, self._open_port = measured, lost, open_port
        self._port: Port | None = None
        self._parser = XbusParser()
        self._waiting: dict[int, asyncio.Future[bytes]] = {}

    def open(self, baud: int) -> None:
        """Open the port, closing it first where it is open.

        Raises:
            DriverError: it cannot be opened.
        """
        self.close()
        self._port = self._open_port(self.path, baud)
        self._parser = XbusParser()
        asyncio.get_running_loop().add_reader(self._port.fileno(), self._readable)

    def close(self) -> None:
        """Release the port. Never raises."""
        port, self._port = self._port, None
        if port is not None:
            with contextlib.suppress(OSError, ValueError):
                asyncio.get_running_loop().remove_reader(port.fileno())
            with contextlib.suppress(OSError):
                port.close()
        for future in self._waiting.values():
            future.cancel()

    async def request(self, message: Message, data: bytes = b"") -> bytes:
        """Send until answered; the answer's data.

        Raises:
            DriverError: no answer, or an error message instead.
        """
        waiting = self._waiting
        for _ in range(_TRIES):
            future: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
            waiting[message + 1] = future
            self._write(xbus.encode(message, data))
            try:
                async with asyncio.timeout(REPLY_TIME / _TRIES):
                    return await future
            except TimeoutError:
                continue
            except asyncio.CancelledError:
                if future.cancelled() and self._port is None:
                    raise DriverError(f"IMU on {self.path}: gone") from None
                raise
            finally:
                waiting.pop(message + 1, None)
        raise DriverError(f"IMU on {self.path}: no answer to {message.name}")

    def _write(self, data: bytes) -> None:
        if self._port is None:
            raise DriverError(f"IMU on {self.path}: gone")
        try:
            self._port.write(data)
        except OSError as error:
            raise DriverError(f"IMU on {self.path}: {error}") from error

    def _readable(self) -> None:
        assert self._port is not None
        try:
            data = os.read(self._port.fileno(), _READ_SIZE)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self.close()
            self._lost()
            return
        for message, content in self._parser.feed(data):
            if message == Message.MTDATA2:
                self._measured(content)
            else:
                self._answer(message, content)
        self.corrupt += self._parser.corrupt
        self._parser.corrupt = 0

    def _answer(self, message: int, data: bytes) -> None:
        if message == Message.ERROR:
            code = data[0] if data else 0
            self.errors[code] += 1
            for future in self._waiting.values():
                if not future.done():
                    future.set_exception(DriverError(f"IMU: error {code}: {ERRORS.get(code, 'unknown')}"))
        elif message == Message.WAKE_UP:
            with contextlib.suppress(DriverError):
                self._write(xbus.encode(Message.WAKE_UP_ACK))
            self._lost()
        elif (waiting := self._waiting.get(message)) is not None and not waiting.done():
            waiting.set_result(data)
