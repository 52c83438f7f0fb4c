"""Tick records at the desk: the newest few of a live robot, or those of a recording.

What arrives faster than it is drawn is dropped here, oldest first, and counted by its index.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any

import msgspec
import numpy as np
import zenoh

from drivers.description import UNDECODABLE
from runtime.control.records import Records
from runtime.messages.event import Event
from runtime.messages.tick import TICK_DTYPE
from station.session import Station, StationError

WAITING_BATCHES = 64
"""Messages that wait for the desk at most."""


class Field(msgspec.Struct, frozen=True):
    """One row of the schema."""

    name: str
    type: str
    shape: tuple[int, ...]
    offset: int


class Schema(msgspec.Struct, frozen=True):
    """What ``tick/schema`` answers."""

    itemsize: int
    fields: tuple[Field, ...]


def read_schema(data: bytes) -> np.dtype[np.void]:
    """The numpy type of a robot's tick records, whatever version it runs.

    Raises:
        StationError: not a schema, or without the fields that this version draws.
    """
    try:
        schema = msgspec.json.decode(data, type=Schema)
        dtype = np.dtype(
            {
                "names": [field.name for field in schema.fields],
                "formats": [(field.type, field.shape) for field in schema.fields],
                "offsets": [field.offset for field in schema.fields],
                "itemsize": schema.itemsize,
            }
        )
    except (*UNDECODABLE, TypeError, ValueError) as error:
        raise StationError(f"tick schema: {error}") from error
    check_fields(dtype, "the robot's ticks")
    return dtype


def check_fields(dtype: np.dtype[np.void], place: str) -> None:
    """Whether records of ``dtype`` have all that this version knows, in the same shapes.

    Raises:
        StationError: naming the first field that is missing or differs.
    """
    for name in TICK_DTYPE.names or ():
        if name not in (dtype.names or ()):
            raise StationError(f"{place}: no field {name!r}: written by another version")
        if dtype[name] != TICK_DTYPE[name]:
            raise StationError(f"{place}: {name} is {dtype[name]}, this version has {TICK_DTYPE[name]}")


class TickStream:
    """The live ticks of one robot. A context manager; ``take`` never blocks."""

    def __init__(self, station: Station) -> None:
        self._station = station
        self.dtype = read_schema(station.ask(station.keys.tick_schema))
        self.lost = 0
        """Ticks that never came: dropped on the way or here."""
        self._next = 0
        self._ticks = self._declare(station.keys.tick, WAITING_BATCHES)
        self._events = self._declare(station.keys.event, 1000)

    def _declare(self, key: str, waiting: int) -> Any:
        return self._station.session.declare_subscriber(key, zenoh.handlers.RingChannel(waiting))

    def __enter__(self) -> TickStream:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ticks.undeclare()
        self._events.undeclare()

    def take(self) -> Records:
        """All that waits, oldest first. Shape (n,), n may be 0."""
        batches = [np.frombuffer(data, self.dtype) for data in self._payloads(self._ticks) if self._whole(data)]
        ticks = np.concatenate(batches) if batches else np.zeros(0, self.dtype)
        if len(ticks):
            index = ticks["index"]
            if self._next and index[0] >= self._next:
                self.lost += int(index[0]) - self._next
            self._next = int(index[-1]) + 1
        return ticks

    def take_events(self) -> list[Event]:
        """Events since the last call."""
        return [msgspec.json.decode(data, type=Event) for data in self._payloads(self._events)]

    def _whole(self, data: bytes) -> bool:
        return len(data) > 0 and len(data) % self.dtype.itemsize == 0

    @staticmethod
    def _payloads(subscriber: Any) -> Iterator[bytes]:
        while (sample := subscriber.handler.try_recv()) is not None:
            yield sample.payload.to_bytes()


@contextlib.contextmanager
def hearing(station: Station, tell: Callable[[Event], None]) -> Iterator[None]:
    """Have ``tell`` called with every event of the robot, on one of zenoh's threads."""

    def hear(sample: zenoh.Sample) -> None:
        with contextlib.suppress(msgspec.MsgspecError):
            tell(msgspec.json.decode(sample.payload.to_bytes(), type=Event))

    subscriber: Any = station.session.declare_subscriber(station.keys.event, hear)
    try:
        yield
    finally:
        subscriber.undeclare()
