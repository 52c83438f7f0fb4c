"""Every incoming key of one robot, and the doors whose answer is one call to the daemon."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import msgspec
import zenoh

from runtime.config import Config
from runtime.doors.answers import Channel, Doors
from runtime.doors.crossing import ANSWER_TIMEOUT, Crossing, read, read_query
from runtime.doors.policy import PolicyDoor
from runtime.doors.velocity import VelocityDoor
from runtime.messages.decoding import MessageError
from runtime.messages.keys import Keys
from runtime.messages.mode import ModeReply, decode_request
from runtime.messages.motion import decode_pose
from runtime.messages.recording import RecordingEntry, RecordingReply
from runtime.messages.tick import tick_schema
from runtime.messages.tuning import TuningReply, decode_tuning
from runtime.recording import list_recordings


class Entrance:
    """One robot's incoming keys on one session."""

    def __init__(
        self, config: Config, keys: Keys, doors: Doors, recordings: Path, channels: Sequence[Channel] = ()
    ) -> None:
        self._keys, self._doors, self._recordings = keys, doors, recordings
        self._channels = [channel for channel in channels if channel.accept is not None]
        self._crossing = Crossing(keys.root, doors)
        self._velocity = VelocityDoor(config, keys.velocity, self._crossing, doors)
        self._policy = PolicyDoor(config, keys.policy, self._crossing, doors)
        self.drivers: set[str] = set()
        """Liveliness tokens of the drivers that are there."""

    @property
    def refused(self) -> Counter[str]:
        """How much was refused or shed since the start, by key."""
        return self._crossing.refused

    def declare(self, session: zenoh.Session) -> list[Any]:
        """Open every door; needs the running loop."""
        self._crossing.begin()
        keys = self._keys
        return [
            session.declare_subscriber(keys.velocity, self._velocity.hear),
            session.declare_subscriber(keys.pose, self._hear_pose),
            *(session.declare_subscriber(channel.key, self._hearer(channel)) for channel in self._channels),
            *(
                session.declare_queryable(key, self.guard(key, answer))
                for key, answer in (
                    (keys.mode, self._answer_mode),
                    (keys.policies, self._answer_policies),
                    (keys.tuning, self._answer_tuning),
                    (keys.change_tuning, self._answer_change),
                    (keys.recording, self._answer_recording),
                    (keys.faults, self._answer_faults),
                    (keys.tick_schema, lambda _query: tick_schema()),
                )
            ),
            session.declare_queryable(keys.policy, self._policy.answer),
            session.liveliness().declare_subscriber(f"{keys.operator}/*", self._hear_operator),
        ]

    def guard(self, key: str, answer: Callable[[zenoh.Query], bytes]) -> Callable[[zenoh.Query], None]:
        """A queryable's callback around an answer, another room's too."""
        return self._crossing.guarded(key, answer)

    # Zenoh's threads ---------------------------------------------------------------------------------------------

    def _hear_pose(self, sample: zenoh.Sample) -> None:
        try:
            pose = decode_pose(read(sample.payload))
            self._crossing.ask(lambda: self._doors.take_pose(pose))
        except ValueError as error:
            self._crossing.refuse(self._keys.pose, str(error))

    def _hear_operator(self, sample: zenoh.Sample) -> None:
        """A driver came or went; one that went, for whatever cause, stops the walk at once."""
        token = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.DELETE:
            self.drivers.discard(token)
            self._crossing.cross(self._doors.lose_operator)
        else:
            self.drivers.add(token)

    def _hearer(self, channel: Channel) -> Callable[[zenoh.Sample], None]:
        accept = channel.accept
        assert accept is not None

        def hear(sample: zenoh.Sample) -> None:
            try:
                data = read(sample.payload)
                self._crossing.ask(lambda: accept(data))
            except Exception as error:
                self._crossing.refuse(channel.key, str(error))

        return hear

    def _answer_mode(self, query: zenoh.Query) -> bytes:
        try:
            wish = decode_request(read_query(query))
        except MessageError as error:
            why = str(error)
            self._crossing.refuse(self._keys.mode, why)
            return msgspec.json.encode(ModeReply(False, self._crossing.ask(self._doors.status).mode, why))
        return msgspec.json.encode(self._crossing.ask(lambda: self._doors.take_request(wish)))

    def _answer_tuning(self, _query: zenoh.Query) -> bytes:
        return msgspec.json.encode(self._crossing.ask(self._doors.list_tuning))

    def _answer_change(self, query: zenoh.Query) -> bytes:
        try:
            change = decode_tuning(read_query(query))
            done: Future[TuningReply] = Future()
            self._crossing.ask(lambda: self._doors.take_tuning(change, done))
            reply = done.result(ANSWER_TIMEOUT)
        except MessageError as error:
            reply = TuningReply(False, str(error))
        if not reply.accepted:
            self._crossing.refuse(self._keys.change_tuning, reply.reason)
        return msgspec.json.encode(reply)

    def _answer_policies(self, _query: zenoh.Query) -> bytes:
        return msgspec.json.encode(self._crossing.ask(self._doors.list_policies)())

    def _answer_faults(self, _query: zenoh.Query) -> bytes:
        return msgspec.json.encode(self._crossing.ask(self._doors.fault_history))

    def _answer_recording(self, query: zenoh.Query) -> bytes:
        parameters = query.parameters
        if "write" in parameters:
            return msgspec.json.encode(self._write_recording())
        files = {path.name: path for path in list_recordings(self._recordings)}
        name = parameters.get("name")
        if name is None:
            return msgspec.json.encode([RecordingEntry(n, str(p), p.stat().st_size) for n, p in files.items()])
        if name not in files:
            raise MessageError(f"name = {name!r}: no such recording")
        return files[name].read_bytes()

    def _write_recording(self) -> RecordingReply:
        done: Future[Path] = Future()
        self._crossing.cross(lambda: self._doors.record_now("asked for", done))
        try:
            return RecordingReply(True, str(done.result(ANSWER_TIMEOUT)), "written")
        except OSError as error:
            return RecordingReply(False, "", str(error))
