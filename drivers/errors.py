"""What can go wrong with a body.

The tree::

    DriverError
    ├── NotConnected      used before connect() or after close()
    ├── BusTimeout        a deadline passed without the reply (also a TimeoutError)
    ├── CorruptFrame      bytes that do not decode (also a ValueError)
    └── MotorFault        a motor says that it is in a fault
"""

from __future__ import annotations


class DriverError(Exception):
    """Root of everything a driver raises."""


class NotConnected(DriverError):
    """The body was used before ``connect`` or after ``close``."""


class BusTimeout(DriverError, TimeoutError):
    """A reply did not arrive before its deadline."""


class CorruptFrame(DriverError, ValueError):
    """Bytes from the wire do not decode."""


class MotorFault(DriverError):
    """A motor reports a fault of its own."""
