"""The flight recorder: a ring of every tick, written out on fault, on request and at stop."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np

from runtime.control.records import Records
from runtime.keyframe import KEYFRAME_DTYPE
from runtime.messages.event import Event
from runtime.messages.tick import TICK_DTYPE
from runtime.recording import SUFFIX, Header, prune, save
from runtime.ring import Kind, create

CHUNK = 256
"""Records written at a time."""
MARGIN_SECONDS = 2.0
"""Extra ring beyond what is kept, so that a writer is never overtaken by the ticks."""
KEYFRAME_SECONDS = 1.0
KEYFRAMES = 3
"""That a recording takes along: the oldest few."""
EVENTS = 1000
EVENT_DTYPE = np.dtype("S512")
"""An event as JSON, for the next process."""


class Recorder:
    """The ring. What begins with ``keep`` belongs to the tick; ``write`` may run on any other thread at that time."""

    def __init__(
        self, folder: Path, rate_hz: float, seconds: float, max_files: int, max_bytes: int, ring: Path | None = None
    ) -> None:
        """With ``ring``, the ticks are kept in that new file and outlive the process.

        Raises:
            OSError: no room for the ring.
        """
        self.folder = folder
        self.events: deque[Event] = deque(maxlen=EVENTS)
        """What happened lately."""
        self.keyframe_every = max(1, round(rate_hz * KEYFRAME_SECONDS))
        """Ticks between two keyframes; the first tick has one."""
        self._wanted = max(1, round(rate_hz * seconds))
        held = 2 + self._wanted // self.keyframe_every
        self._keyframes: deque[tuple[int, Records]] = deque(maxlen=held)
        kinds = [
            Kind(TICK_DTYPE, self._wanted + round(rate_hz * MARGIN_SECONDS) + CHUNK),
            Kind(KEYFRAME_DTYPE, held + 2),
            Kind(EVENT_DTYPE, EVENTS),
        ]
        self._ticks, self._keyframes_left, self._events_left = create(kinds, ring)
        self._max_files, self._max_bytes = max_files, max_bytes

    @property
    def count(self) -> int:
        """Ticks kept since the start."""
        return self._ticks.count

    def keep(self, tick: Records) -> None:
        """Copy the record of one tick (1,) into the ring."""
        self._ticks.put(tick)

    def keep_keyframe(self, keyframe: Records) -> None:
        """Take what was remembered after the tick that was kept last."""
        self._keyframes.append((self.count - 1, keyframe))
        self._keyframes_left.put(keyframe)

    def keep_event(self, event: Event) -> None:
        """Note what happened."""
        self.events.append(event)
        self._events_left.put(event_row(event))

    def keyframes(self) -> list[bytes]:
        """The oldest few that belong to ticks which a file written now would hold."""
        first = self.count - self._wanted
        return [keyframe.tobytes() for count, keyframe in tuple(self._keyframes) if count >= first][:KEYFRAMES]

    def write(self, header: Header, stem: str) -> Path:
        """Write what the ring holds to ``<folder>/<stem>.trotd``: whole or not at all. Blocks; not for the loop.

        Raises:
            OSError: the disk refused.
        """
        path = self.folder / f"{stem}{SUFFIX}"
        save(path, header, self._chunks())
        prune(self.folder, path, self._max_files, self._max_bytes)
        return path

    def _chunks(self) -> Iterator[memoryview]:
        rows = self._ticks.rows
        size, count = len(rows), self.count
        for first in range(max(0, count - self._wanted), count, CHUNK):
            last = min(first + CHUNK, count)
            if self.count - first >= size:
                continue  # overtaken by the ticks on a very slow disk: the oldest are the ones to lose
            begin, end = first % size, (last - 1) % size + 1
            for part in [rows[begin:end]] if begin < end else [rows[begin:], rows[:end]]:
                yield part.view(np.uint8).data


def event_row(event: Event) -> np.ndarray:
    """An event as JSON in the room that the ring has for it, its text cut if it must be. Shape (1,)."""
    data = msgspec.json.encode(event)
    if len(data) > EVENT_DTYPE.itemsize:
        room = EVENT_DTYPE.itemsize - len(msgspec.json.encode(msgspec.structs.replace(event, text="")))
        text = event.text.encode("ascii", "replace").decode().translate(_PLAIN)[:room]
        data = msgspec.json.encode(msgspec.structs.replace(event, text=text))
    return np.array([data], EVENT_DTYPE)


_PLAIN = dict.fromkeys((*range(32), 127, ord('"'), ord("\\")), "?")
"""What JSON would write as more than one byte."""
