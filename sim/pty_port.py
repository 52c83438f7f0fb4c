"""A serial device on a pseudo-terminal: bytes both ways, its baud rate checked, the cable pulled and put back."""

from __future__ import annotations

import asyncio
import contextlib
import os
import termios
import tty
from collections.abc import Callable
from pathlib import Path

_SPEEDS = {
    getattr(termios, f"B{baud}"): baud
    for baud in (9600, 115200, 230400, 460800, 921600, 2000000, 3500000, 4000000)
    if hasattr(termios, f"B{baud}")
}


class PtyPort:
    """The device's end. ``path`` is a link that always leads to the host's end."""

    def __init__(self, path: Path, heard: Callable[[bytes], None]) -> None:
        """``heard`` takes the host's bytes. A process that dies leaves the link behind; the next one replaces it."""
        self.path = path
        self._heard = heard
        self._device = self._host = -1
        self.dropped = 0
        """Bytes that nobody fetched."""

    @property
    def plugged_in(self) -> bool:
        """Whether the cable is in."""
        return self._device >= 0

    @property
    def host_baud(self) -> int:
        """What speed the host set its end to; 0 where it is none that the device has."""
        return _SPEEDS.get(termios.tcgetattr(self._device)[4], 0) if self.plugged_in else 0

    def plug_in(self) -> None:
        """Make the pair and the link."""
        self._device, self._host = os.openpty()
        tty.setraw(self._host)
        os.set_blocking(self._device, False)
        with contextlib.suppress(FileNotFoundError):
            self.path.unlink()
        self.path.symlink_to(os.ttyname(self._host))
        asyncio.get_running_loop().add_reader(self._device, self._readable)

    def unplug(self) -> None:
        """Pull the cable: the host's reads end. Harmless when repeated."""
        if not self.plugged_in:
            return
        asyncio.get_running_loop().remove_reader(self._device)
        for end in (self._device, self._host):
            os.close(end)
        self._device = self._host = -1
        with contextlib.suppress(FileNotFoundError):
            self.path.unlink()

    def write(self, data: bytes) -> None:
        """To the host; what does not fit is dropped, as a real line would."""
        if not self.plugged_in or not data:
            return
        try:
            written = os.write(self._device, data)
        except OSError:
            written = 0
        self.dropped += len(data) - written

    def _readable(self) -> None:
        try:
            data = os.read(self._device, 4096)
        except OSError:
            return
        self._heard(data)
