"""The zenoh session: newest command in, ticks, status and events out, requests answered.

zenoh calls back on threads of its own. There they only decode and refuse; whatever touches the daemon goes through
``Link._cross``, the one place where threads are crossed. Sending happens on the loop, right after a tick, from ``run``.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import re
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import msgspec
import numpy as np
import zenoh

from runtime import messages, policies
from runtime.access import AccessError, control_access, use_certificates
from runtime.control.parameters import BoundsConfig
from runtime.control.policy import Policy
from runtime.control.records import Records, VelocityCommand
from runtime.messages import (
    TICK_DTYPE,
    Event,
    Keys,
    MessageError,
    ModeReply,
    PolicyReply,
    RecordingEntry,
    RecordingReply,
    Request,
    Status,
)
from runtime.parameters import LinkConfig
from runtime.recording import list_recordings

HISTORY = 200
"""Events that a query on ``event`` brings back."""
ANSWER_TIMEOUT = 30.0
"""How long one of zenoh's threads waits for the loop, s."""
REPEAT_TIME = 1.0
"""The same refusal of a velocity command becomes an event at most once in this time, s."""
Result = TypeVar("Result")


class LinkError(RuntimeError):
    """The session cannot be opened: the message names the endpoint and why."""


class Doors(Protocol):
    """What the daemon answers, always on the loop's thread."""

    def take_velocity(self, command: VelocityCommand) -> None: ...  # noqa: D102
    def take_request(self, wish: Request) -> ModeReply: ...  # noqa: D102
    def lose_operator(self) -> None: ...  # noqa: D102
    def take_policy(self, policy: Policy, data: bytes) -> None: ...  # noqa: D102
    def refuse(self, door: str, why: str) -> None: ...  # noqa: D102
    def active_policy(self) -> tuple[str, bytes]: ...  # noqa: D102
    def previous_policy(self) -> bytes: ...  # noqa: D102
    def keep_policy(self, data: bytes) -> None: ...  # noqa: D102
    def record_now(self, reason: str, done: Future[Path]) -> None: ...  # noqa: D102
    def status(self) -> Status: ...  # noqa: D102


@dataclass(frozen=True, slots=True)
class Channel:
    """A key beyond the robot's own, for bodies that know or can do more (the simulator)."""

    key: str
    produce: Callable[[], bytes] | None = None
    """Called on the loop with every batch of ticks."""
    accept: Callable[[bytes], None] | None = None
    """Called on the loop with every payload; raises MessageError to refuse it."""


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


class Link:
    """One robot's keys on one session."""

    def __init__(
        self,
        config: LinkConfig,
        bounds: BoundsConfig,
        robot: str,
        rate_hz: float,
        doors: Doors,
        recordings: Path,
        channels: Sequence[Channel] = (),
    ) -> None:
        self.keys = Keys(robot)
        self.history: deque[Event] = deque(maxlen=HISTORY)
        """Events that were sent."""
        self._config, self._bounds, self._robot = config, bounds, robot
        self._doors, self._recordings, self._channels = doors, recordings, channels
        self._status_every = max(1, round(rate_hz / config.status_hz / config.batch))
        self._batches = 0
        self._rows = np.zeros((2, config.batch), TICK_DTYPE)
        self._filling, self._filled = 0, 0
        self._full: int | None = None
        self._events: deque[Event] = deque()
        self._changed = False
        self._refusals: dict[str, float] = {}
        self._session: zenoh.Session | None = None
        self._declared: list[Any] = []

    def open(self) -> None:
        """Open the session and every door; needs the running loop.

        Raises:
            LinkError: an endpoint cannot be had, or another daemon of this robot is alive.
        """
        self._loop = asyncio.get_running_loop()
        self._wake = asyncio.Event()
        config = self._config
        settings = session_config("peer", config.listen, config.connect)
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
        self._status = session.declare_publisher(self.keys.status, congestion_control=drop)
        self._ticks = session.declare_publisher(self.keys.tick, congestion_control=drop)
        self._event = session.declare_publisher(self.keys.event, congestion_control=zenoh.CongestionControl.BLOCK)
        self._declare(session)

    def close(self) -> None:
        """Leave the network. Never raises."""
        session, self._session = self._session, None
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]

    def offer(self, tick: Records) -> None:
        """Put the record of one tick (1,) into the batch; returns at once."""
        self._rows[self._filling, self._filled] = tick[0]
        self._filled += 1
        if self._filled == self._config.batch:
            self._full, self._filling, self._filled = self._filling, 1 - self._filling, 0
            self._wake.set()

    def tell(self, event: Event) -> None:
        """Queue an event; none is ever dropped. A status follows it at once."""
        self._events.append(event)
        self._changed = True
        self._wake.set()

    async def run(self) -> None:
        """Send for ever."""
        while True:
            await self._wake.wait()
            self._wake.clear()
            self._send_batch()
            while self._events:
                event = self._events.popleft()
                self.history.append(event)
                if _heard(self._event):
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
            if _heard(self._ticks):
                self._ticks.put(self._rows[full].tobytes())
            for channel, publisher in self._produced:
                assert channel.produce is not None
                if _heard(publisher):
                    publisher.put(channel.produce())
        if self._changed or (full is not None and self._batches % self._status_every == 0):
            self._changed = False
            if _heard(self._status):
                self._status.put(msgspec.json.encode(self._doors.status()))

    def _declare(self, session: zenoh.Session) -> None:
        keys = self.keys
        self._produced = [
            (channel, session.declare_publisher(channel.key, congestion_control=zenoh.CongestionControl.DROP))
            for channel in self._channels
            if channel.produce is not None
        ]
        self._declared = [
            session.declare_subscriber(keys.velocity, self._hear_velocity),
            *(
                session.declare_subscriber(channel.key, self._hearer(channel))
                for channel in self._channels
                if channel.accept is not None
            ),
            *(
                session.declare_queryable(key, self._guarded(key, answer))
                for key, answer in (
                    (keys.mode, self._answer_mode),
                    (keys.policy, self._answer_policy),
                    (keys.recording, self._answer_recording),
                    (keys.tick_schema, lambda _query: messages.tick_schema()),
                    (keys.event, lambda _query: msgspec.json.encode(list(self.history))),
                )
            ),
            session.liveliness().declare_subscriber(f"{keys.operator}/*", self._hear_operator),
            session.liveliness().declare_token(keys.alive),
        ]

    # From here on: zenoh's threads. ------------------------------------------------------------------------------

    def _cross(self, act: Callable[[], Result]) -> Future[Result]:
        """Run ``act`` on the loop's thread, between two callbacks of the loop. The only crossing."""
        done: Future[Result] = Future()

        def run() -> None:
            try:
                done.set_result(act())
            except Exception as error:
                done.set_exception(error)

        try:
            self._loop.call_soon_threadsafe(run)
        except RuntimeError as error:
            done.set_exception(error)  # the loop is closed: the daemon is gone
        return done

    def _hear_velocity(self, sample: zenoh.Sample) -> None:
        stamp = time.monotonic()
        try:
            message = messages.decode_velocity(
                sample.payload.to_bytes(), self._bounds.linear_velocity, self._bounds.yaw_rate
            )
        except MessageError as error:
            self._refuse(self.keys.velocity, str(error))
            return
        command = VelocityCommand(stamp, np.array(message.linear), message.yaw_rate)
        self._cross(lambda: self._doors.take_velocity(command))

    def _hear_operator(self, sample: zenoh.Sample) -> None:
        """A driver came or went; one that went, for whatever cause, stops the walk at once."""
        if sample.kind == zenoh.SampleKind.DELETE:
            self._cross(self._doors.lose_operator)

    def _hearer(self, channel: Channel) -> Callable[[zenoh.Sample], None]:
        accept = channel.accept
        assert accept is not None

        def hear(sample: zenoh.Sample) -> None:
            data = sample.payload.to_bytes()
            error = self._cross(lambda: accept(data)).exception(ANSWER_TIMEOUT)
            if error is not None:
                self._refuse(channel.key, str(error))

        return hear

    def _refuse(self, key: str, why: str) -> None:
        now = time.monotonic()
        if now - self._refusals.get(key, -REPEAT_TIME) >= REPEAT_TIME:
            self._refusals[key] = now
            self._cross(lambda: self._doors.refuse(key, why))

    def _guarded(self, key: str, answer: Callable[[zenoh.Query], bytes]) -> Callable[[zenoh.Query], None]:
        """A queryable's callback: always one reply, an error where there is no answer."""

        def handle(query: zenoh.Query) -> None:
            with query:
                try:
                    query.reply(key, answer(query))
                except Exception as error:
                    self._refuse(key, str(error))
                    query.reply_err(str(error).encode())

        return handle

    def _answer_mode(self, query: zenoh.Query) -> bytes:
        try:
            wish = messages.decode_request(_payload(query))
        except MessageError as error:
            why = str(error)
            self._refuse(self.keys.mode, why)
            mode = self._cross(self._doors.status).result(ANSWER_TIMEOUT).mode
            return msgspec.json.encode(ModeReply(False, mode, why))
        return msgspec.json.encode(self._cross(lambda: self._doors.take_request(wish)).result(ANSWER_TIMEOUT))

    def _answer_policy(self, query: zenoh.Query) -> bytes:
        data = _payload(query)
        rollback = "rollback" in query.parameters
        if not data and not rollback:
            return self._cross(self._doors.active_policy).result(ANSWER_TIMEOUT)[1]
        accepted, why = True, "active"
        try:
            if rollback:
                data = self._cross(self._doors.previous_policy).result(ANSWER_TIMEOUT)
            policy = policies.decode(data, self._robot, "candidate")
            self._cross(lambda: self._doors.take_policy(policy, data)).result(ANSWER_TIMEOUT)
            self._doors.keep_policy(data)
        except policies.PolicyError as error:
            accepted, why = False, str(error)
            self._refuse(self.keys.policy, why)
        name, active = self._cross(self._doors.active_policy).result(ANSWER_TIMEOUT)
        return msgspec.json.encode(PolicyReply(accepted, name, hashlib.sha256(active).hexdigest(), why))

    def _answer_recording(self, query: zenoh.Query) -> bytes:
        parameters = query.parameters
        if "write" in parameters:
            done: Future[Path] = Future()
            self._cross(lambda: self._doors.record_now("asked for", done))
            try:
                return msgspec.json.encode(RecordingReply(True, str(done.result(ANSWER_TIMEOUT)), "written"))
            except OSError as error:
                return msgspec.json.encode(RecordingReply(False, "", str(error)))
        files = {path.name: path for path in list_recordings(self._recordings)}
        name = parameters.get("name")
        if name is None:
            return msgspec.json.encode([RecordingEntry(n, str(p), p.stat().st_size) for n, p in files.items()])
        if name not in files:
            raise MessageError(f"name = {name!r}: no such recording")
        return files[name].read_bytes()


def _heard(publisher: Any) -> bool:
    return bool(publisher.matching_status.matching)


def _payload(query: zenoh.Query) -> bytes:
    return b"" if query.payload is None else query.payload.to_bytes()


def _one_line(error: zenoh.ZError, config: LinkConfig) -> str:
    """zenoh's nested message down to endpoint and cause."""
    text = str(error)
    endpoint = next((e for e in (*config.listen, *config.connect) if e in text), "")
    where = f"link endpoint {endpoint!r}" if endpoint else f"link endpoints {[*config.listen, *config.connect]}"
    cause = re.search(r"([A-Z][\w' ]+) \(os error", text)
    return f"{where}: {cause[1].lower() if cause else text.splitlines()[0].split(' at /')[0]}"
