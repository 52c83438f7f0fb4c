"""The zenoh session: ticks, status and events out; what comes in is ``runtime.doors``.

Sending happens on the loop, right after a tick, from ``run``.
"""

from __future__ import annotations

import asyncio
import json
import re
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import zenoh

from runtime.access import AccessError, control_access, use_certificates
from runtime.config import Config
from runtime.control.records import Records
from runtime.doors.answers import Channel, Doors
from runtime.doors.entrance import Entrance
from runtime.messages.event import Event
from runtime.messages.keys import Keys
from runtime.messages.tick import TICK_DTYPE
from runtime.parameters import LinkConfig

WAITING_EVENTS = 1000
"""Events that wait for a reader that does not read; it is cut off by the transport before there are so many."""
HISTORY = 200
"""Events that a query on ``event`` brings back."""
LARGEST_TRANSPORT = 8_388_608
"""Bytes; a larger message is dropped by the transport before it is whole in memory."""


class LinkError(RuntimeError):
    """The session cannot be opened: the message names the endpoint and why."""


def session_config(mode: str, listen: Sequence[str], connect: Sequence[str]) -> zenoh.Config:
    """A zenoh configuration without any scouting: only the endpoints that are named."""
    config = zenoh.Config()
    for key, value in (
        ("mode", mode),
        ("listen/endpoints", list(listen)),
        ("connect/endpoints", list(connect)),
        ("scouting/multicast/enabled", False),
        ("scouting/gossip/enabled", False),
        ("transport/shared_memory/enabled", False),  # gains nothing below 2 kB; a confined service may not have it
    ):
        config.insert_json5(key, json.dumps(value))
    return config


class Outlet:
    """One outgoing key, and whether anybody listens: asked once and told from then on, because asking costs 20 µs."""

    def __init__(self, session: zenoh.Session, key: str, congestion: zenoh.CongestionControl) -> None:
        self._publisher: Any = session.declare_publisher(key, congestion_control=congestion)
        self.heard: bool = True
        """Somebody subscribes to it."""
        self._listener = self._publisher.declare_matching_listener(self._match)
        self.heard = bool(cast(Any, self._publisher.matching_status).matching)
        self.put = self._publisher.put

    def _match(self, status: Any) -> None:
        self.heard = bool(status.matching)


class Link:
    """One robot's keys on one session."""

    def __init__(
        self,
        whole: Config,
        doors: Doors,
        recordings: Path,
        channels: Sequence[Channel] = (),
    ) -> None:
        config, robot = whole.link, whole.robot.name
        self.keys = Keys(robot)
        self.entrance = Entrance(whole, self.keys, doors, recordings, channels)
        self.history: deque[Event] = deque(maxlen=HISTORY)
        """Events that were sent."""
        self._config, self._robot = config, robot
        self._doors, self._channels = doors, channels
        self._status_every = max(1, round(whole.control.rate_hz / config.status_hz / config.batch))
        self._batches = 0
        self._bytes = np.zeros((2, config.batch, TICK_DTYPE.itemsize), np.uint8)
        self._filling, self._filled = 0, 0
        self._full: int | None = None
        self._events: deque[Event] = deque(maxlen=WAITING_EVENTS)
        self._changed = False
        self._session: zenoh.Session | None = None
        self._declared: list[Any] = []

    def open(self) -> None:
        """Open the session and every door; needs the running loop.

        Raises:
            LinkError: an endpoint cannot be had, or another daemon of this robot is alive.
        """
        self._wake, self._told = asyncio.Event(), asyncio.Event()
        config = self._config
        settings = session_config("peer", config.listen, config.connect)
        settings.insert_json5("transport/link/rx/max_message_size", str(LARGEST_TRANSPORT))
        for name in ("wait_before_drop", "max_wait_before_drop_fragments"):  # else a full queue holds up the loop
            settings.insert_json5(f"transport/link/tx/queue/congestion_control/drop/{name}", "0")
        try:
            if config.certificates:
                use_certificates(settings, Path(config.certificates))
                control_access(settings, self._robot)
            session = zenoh.open(settings)
        except AccessError as error:
            raise LinkError(f"link.certificates: {error}") from error
        except zenoh.ZError as error:
            raise LinkError(_one_line(error, config)) from error
        self._session = session
        if config.connect and any(reply.ok for reply in session.liveliness().get(self.keys.alive, timeout=0.5)):
            raise LinkError(f"robot {self._robot!r}: another daemon holds {self.keys.alive}")
        drop = zenoh.CongestionControl.DROP
        self._status = Outlet(session, self.keys.status, drop)
        self._ticks = Outlet(session, self.keys.tick, drop)
        self._event = Outlet(session, self.keys.event, zenoh.CongestionControl.BLOCK)
        self._declare(session)

    def close(self) -> None:
        """Leave the network. Never raises."""
        session, self._session = self._session, None
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]

    def offer(self, tick: Records) -> None:
        """Put the record of one tick (1,) into the batch; returns at once."""
        self._bytes[self._filling, self._filled] = tick.view(np.uint8)
        self._filled += 1
        if self._filled == self._config.batch:
            self._full, self._filling, self._filled = self._filling, 1 - self._filling, 0
            self._wake.set()

    def tell(self, event: Event) -> None:
        """Queue an event; none is ever dropped. A status follows it at once."""
        self._events.append(event)
        self._changed = True
        self._wake.set()
        self._told.set()

    async def run(self) -> None:
        """Send for ever; a reader that holds up the events does not hold up the ticks."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._send_events(), name="events")
            while True:
                await self._wake.wait()
                self._wake.clear()
                self._send_batch()

    async def _send_events(self) -> None:
        while True:
            await self._told.wait()
            self._told.clear()
            while self._events:
                event = self._events.popleft()
                self.history.append(event)
                if self._event.heard:
                    await asyncio.to_thread(self._event.put, msgspec.json.encode(event))

    def flush(self) -> None:
        """Send what is left, at the end of a run."""
        while self._events:
            event = self._events.popleft()
            self.history.append(event)
            self._event.put(msgspec.json.encode(event))
        self._status.put(msgspec.json.encode(self._doors.status()))

    def _send_batch(self) -> None:
        full, self._full = self._full, None
        if full is not None:
            self._batches += 1
            if self._ticks.heard:
                self._ticks.put(self._bytes[full].tobytes())
            for channel, outlet in self._produced:
                assert channel.produce is not None
                if outlet.heard:
                    outlet.put(channel.produce())
        if self._changed or (full is not None and self._batches % self._status_every == 0):
            self._changed = False
            if self._status.heard:
                self._status.put(msgspec.json.encode(self._doors.status()))

    def _declare(self, session: zenoh.Session) -> None:
        keys = self.keys
        self._produced = [
            (channel, Outlet(session, channel.key, zenoh.CongestionControl.DROP))
            for channel in self._channels
            if channel.produce is not None
        ]
        history = self.entrance.guard(keys.event, lambda _query: msgspec.json.encode(list(self.history)))
        self._declared = [
            *self.entrance.declare(session),
            session.declare_queryable(keys.event, history),
            session.liveliness().declare_token(keys.alive),
        ]


def _one_line(error: zenoh.ZError, config: LinkConfig) -> str:
    """zenoh's nested message down to endpoint and cause."""
    text = str(error)
    endpoint = next((e for e in (*config.listen, *config.connect) if e in text), "")
    where = f"link endpoint {endpoint!r}" if endpoint else f"link endpoints {[*config.listen, *config.connect]}"
    cause = re.search(r"([A-Z][\w' ]+) \(os error", text)
    return f"{where}: {cause[1].lower() if cause else text.splitlines()[0].split(' at /')[0]}"
