"""The service manager's notifications: readiness, watchdog, stopping. A datagram each, nothing without a manager."""

from __future__ import annotations

import contextlib
import os
import socket


class Notifier:
    """Speaks to systemd's NOTIFY_SOCKET if there is one. Never blocks, never raises."""

    def __init__(self) -> None:
        self.watchdog_period = int(os.environ.get("WATCHDOG_USEC", "0") or 0) / 2e6
        """How often the watchdog wants to be fed, s; 0 for never."""
        self._socket: socket.socket | None = None
        address = os.environ.get("NOTIFY_SOCKET", "")
        if address:
            self._address = "\0" + address[1:] if address.startswith("@") else address
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)

    def tell(self, text: str) -> None:
        """Send ``READY=1``, ``WATCHDOG=1``, ``STOPPING=1`` or ``STATUS=…``."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(text.encode(), self._address)

    def close(self) -> None:
        """Let go of the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
