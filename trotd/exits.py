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
    """Leave with one line and a code where robot, link, disk or what was given say no; a fault of ours is raised.

    A report of several lines, one for each wire, stays what it is.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise typer.Exit(INTERRUPTED) from None
    except Exception as error:
        code = _code(error)
        if code is None:
            raise
        typer.echo(f"trotd: {error}", err=True)
        raise typer.Exit(code) from error


def _code(error: Exception) -> int | None:
    """Configurations, policies, recordings and runs that cannot be used are ValueErrors."""
    from drivers.errors import DriverError
    from runtime.link import LinkError
    from runtime.realtime import RealtimeError
    from runtime.replay import ReplayError
    from runtime.state import LockError
    from station.session import StationError

    if isinstance(error, DriverError | StationError | ReplayError | OSError):
        return FAILED
    if isinstance(error, ValueError | LinkError | LockError | RealtimeError | ImportError):
        return BAD_INPUT
    return None
