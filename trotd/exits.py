"""How every command ends: its exit code, and its errors as one line."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import typer

FAILED = 1
"""It was refused, it fell, a bound was missed: what was asked could not be done."""
BAD_INPUT = 2
"""What was given cannot be: a file, a key, a number, options."""
INTERRUPTED = 130
"""By Ctrl-C, as a shell has it."""


class UsageError(ValueError):
    """Options that make no sense together: the message says which do."""


@contextlib.contextmanager
def one_line_errors() -> Iterator[None]:
    """Leave with one line and a code where robot, link, disk or what was given say no; anything else is raised.

    What the drivers gathered over all wires stays a report of several lines. Every ValueError counts as bad input: the
    doors' errors are ValueErrors.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise typer.Exit(INTERRUPTED) from None
    except Exception as error:
        code, words = _told(error)
        if code is None:
            raise
        typer.echo(f"trotd: {words}", err=True)
        raise typer.Exit(code) from error


def _told(error: Exception) -> tuple[int | None, str]:
    """Exit code, None for what no command expects, and what is printed."""
    from drivers.errors import DriverError
    from runtime.link import LinkError
    from runtime.realtime import RealtimeError
    from runtime.replay import ReplayError
    from runtime.state import LockError
    from station.session import StationError

    if isinstance(error, DriverError):
        return FAILED, str(error)
    words = " ".join(str(error).split())
    if isinstance(error, StationError | ReplayError | OSError):
        return FAILED, words
    if isinstance(error, ValueError | LinkError | LockError | RealtimeError | ImportError):
        return BAD_INPUT, words
    return None, words
