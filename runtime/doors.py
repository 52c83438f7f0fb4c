"""What comes in over zenoh: decoded and refused on zenoh's threads, done on the loop's.

Whatever touches the daemon goes through ``Entrance._cross``, the one place where threads are crossed. What cannot be
taken is refused with a reason, and counted by its key.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import msgspec
import numpy as np
import zenoh

from runtime import policies
from runtime.config import Config
from runtime.control.records import VelocityCommand
from runtime.delays import Delays
from runtime.messages.decoding import LARGEST_MESSAGE, MessageError
from runtime.messages.fault import FaultRecord
from runtime.messages.keys import Keys
from runtime.messages.mode import ModeReply, Request, decode_request
from runtime.messages.motion import PoseMessage, VelocityMessage, decode_pose, decode_velocity
from runtime.messages.policy import PolicyEntry, PolicyReply
from runtime.messages.recording import RecordingEntry, RecordingReply
from runtime.messages.status import Status
from runtime.messages.tick import tick_schema
from runtime.messages.tuning import TuningEntry, TuningReply, TuningRequest, decode_tuning
from runtime.recording import list_recordings
from runtime.shelf import PolicyFile

ANSWER_TIMEOUT = 30.0
"""How long one of zenoh's threads waits for the loop, s."""
REPEAT_TIME = 1.0
"""The same refusal becomes an event at most once in this time, s; all are counted."""
SHED = "velocity superseded"
"""Under this name velocity commands are counted that a newer one overtook before a tick could take them."""
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a policy that was sent."""

    accepted: bool
    words: str
    report: dict[str, float]


class Doors(Protocol):
    """What the daemon answers, always on the loop's thread."""

    def take_velocity(self, command: VelocityCommand) -> None: ...  # noqa: D102
    def take_request(self, wish: Request) -> ModeReply: ...  # noqa: D102
    def take_pose(self, pose: PoseMessage) -> None: ...  # noqa: D102
    def take_tuning(self, change: TuningRequest, done: Future[TuningReply]) -> None: ...  # noqa: D102
    def list_tuning(self) -> list[TuningEntry]: ...  # noqa: D102
    def lose_operator(self) -> None: ...  # noqa: D102
    def offer_policy(self, file: PolicyFile, immediate: bool, done: Future[Outcome]) -> None: ...  # noqa: D102
    def roll_back(self, done: Future[Outcome]) -> None: ...  # noqa: D102
    def active_policy(self) -> PolicyFile: ...  # noqa: D102
    def list_policies(self) -> Callable[[], list[PolicyEntry]]: ...  # noqa: D102
    def refuse(self, door: str, why: str) -> None: ...  # noqa: D102
    def fault_history(self) -> list[FaultRecord]: ...  # noqa: D102
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


class Entrance:
    """One robot's incoming keys on one session."""

    def __init__(
        self, config: Config, keys: Keys, doors: Doors, recordings: Path, channels: Sequence[Channel] = ()
    ) -> None:
        self.refused: Counter[str] = Counter()
        """How much was refused or shed since the start, by key."""
        self._config, self._keys, self._doors, self._recordings = config, keys, doors, recordings
        self._channels = [channel for channel in channels if channel.accept is not None]
        self._told: dict[str, float] = {}
        self._newest: VelocityCommand | None = None
        self._heard = -math.inf
        self._locked = True
        """The sticks were not centred since commands came again."""
        self.drivers: set[str] = set()
        """Liveliness tokens of the drivers that are there."""
        self._delays = Delays()

    def declare(self, session: zenoh.Session) -> list[Any]:
        """Open every door; needs the running loop."""
        self._loop = asyncio.get_running_loop()
        keys = self._keys
        return [
            session.declare_subscriber(keys.velocity, self._hear_velocity),
            session.declare_subscriber(keys.pose, self._hear_pose),
            *(session.declare_subscriber(channel.key, self._hearer(channel)) for channel in self._channels),
            *(
                session.declare_queryable(key, self._guarded(key, answer))
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
            session.declare_queryable(keys.policy, self._answer_policy),
            session.liveliness().declare_subscriber(f"{keys.operator}/*", self._hear_operator),
        ]

    def guard(self, key: str, answer: Callable[[zenoh.Query], bytes]) -> Callable[[zenoh.Query], None]:
        """A queryable's callback for another room's answer."""
        return self._guarded(key, answer)

    # Zenoh's threads ---------------------------------------------------------------------------------------------

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

    def _wait(self, act: Callable[[], Result]) -> Result:
        return self._cross(act).result(ANSWER_TIMEOUT)

    def _hear_velocity(self, sample: zenoh.Sample) -> None:
        """The newest wins: one that the loop has not taken yet is replaced, so that a flood costs the loop nothing."""
        stamp = time.monotonic()
        bounds = self._config.control.bounds
        try:
            message = decode_velocity(_bytes(sample.payload), bounds.linear_velocity, bounds.yaw_rate)
        except MessageError as error:
            self._refuse(self._keys.velocity, str(error))
            return
        if message.sticks and not self._centred(stamp, message):
            message = VelocityMessage((0.0, 0.0), 0.0)
        self._heard = stamp
        sent = sample.timestamp
        if sent is not None:  # it counts from when it was sent: after a gap, what waited comes at once
            stamp -= self._delays.lateness(str(sent.get_id()), sent.get_time().timestamp(), stamp)
        waiting, self._newest = self._newest, VelocityCommand(stamp, np.array(message.linear), message.yaw_rate)
        if waiting is None:
            self._cross(self._take_newest)
        else:
            self.refused[SHED] += 1

    def _centred(self, stamp: float, message: VelocityMessage) -> bool:
        """Whether sticks may move the robot: since the last silence they have to have been in the middle once."""
        silence = stamp - self._heard
        if silence > self._config.command.expiry:
            self._locked = True
        if not any((*message.linear, message.yaw_rate)):
            self._locked = False
        if self._locked:
            self._refuse(self._keys.velocity, "centre the sticks: no command had come for a while")
        return not self._locked

    def _take_newest(self) -> None:
        newest, self._newest = self._newest, None
        if newest is not None:
            self._doors.take_velocity(newest)

    def _hear_pose(self, sample: zenoh.Sample) -> None:
        try:
            pose = decode_pose(_bytes(sample.payload))
            self._wait(lambda: self._doors.take_pose(pose))
        except ValueError as error:
            self._refuse(self._keys.pose, str(error))

    def _hear_operator(self, sample: zenoh.Sample) -> None:
        """A driver came or went; one that went, for whatever cause, stops the walk at once."""
        token = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.DELETE:
            self.drivers.discard(token)
            self._cross(self._doors.lose_operator)
        else:
            self.drivers.add(token)

    def _hearer(self, channel: Channel) -> Callable[[zenoh.Sample], None]:
        accept = channel.accept
        assert accept is not None

        def hear(sample: zenoh.Sample) -> None:
            try:
                data = _bytes(sample.payload)
                self._wait(lambda: accept(data))
            except Exception as error:
                self._refuse(channel.key, str(error))

        return hear

    def _refuse(self, key: str, why: str) -> None:
        self.refused[key.removeprefix(f"{self._keys.root}/")] += 1
        now = time.monotonic()
        if now - self._told.get(key, -REPEAT_TIME) >= REPEAT_TIME:
            self._told[key] = now
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
            wish = decode_request(_payload(query))
        except MessageError as error:
            why = str(error)
            self._refuse(self._keys.mode, why)
            return msgspec.json.encode(ModeReply(False, self._wait(self._doors.status).mode, why))
        return msgspec.json.encode(self._wait(lambda: self._doors.take_request(wish)))

    def _answer_tuning(self, _query: zenoh.Query) -> bytes:
        return msgspec.json.encode(self._wait(self._doors.list_tuning))

    def _answer_change(self, query: zenoh.Query) -> bytes:
        try:
            change = decode_tuning(_payload(query))
            done: Future[TuningReply] = Future()
            self._wait(lambda: self._doors.take_tuning(change, done))
            reply = done.result(ANSWER_TIMEOUT)
        except MessageError as error:
            reply = TuningReply(False, str(error))
        if not reply.accepted:
            self._refuse(self._keys.change_tuning, reply.reason)
        return msgspec.json.encode(reply)

    def _answer_policies(self, _query: zenoh.Query) -> bytes:
        return msgspec.json.encode(self._wait(self._doors.list_policies)())

    def _answer_policy(self, query: zenoh.Query) -> None:
        """What is active, at once; what became of a candidate, when it is known: nobody else waits for that."""
        data, rollback = _payload(query, policies.LARGEST_FILE + 1), "rollback" in query.parameters
        try:
            if not data and not rollback:
                with query:
                    query.reply(self._keys.policy, self._wait(self._doors.active_policy).data)
                return
            file = None if rollback else self._verified(data)
            immediate = "immediate" in query.parameters
            self._wait(lambda: self._offer(file, immediate, query))
        except policies.PolicyError as error:
            outcome = Outcome(False, str(error), {})
            self._wait(lambda: self._reply_policy(query, outcome))
        except Exception as error:
            with query:
                query.reply_err(str(error).encode())

    def _offer(self, file: PolicyFile | None, immediate: bool, query: zenoh.Query) -> None:
        """On the loop: hand the candidate over, or roll back; the answer leaves from the loop too, when it is known."""
        done: Future[Outcome] = Future()
        if file is None:
            self._doors.roll_back(done)
        else:
            self._doors.offer_policy(file, immediate, done)
        done.add_done_callback(lambda settled: self._reply_policy(query, settled.result()))

    def _verified(self, data: bytes) -> PolicyFile:
        policy = policies.decode(data, self._config.robot.name, "candidate")
        policies.check_manifest(
            policy, self._config.control.rate_hz, self._config.audition.max_norm, f"candidate {policy.name}"
        )
        return PolicyFile(policy, data)

    def _reply_policy(self, query: zenoh.Query, outcome: Outcome) -> None:
        if not outcome.accepted:
            self._refuse(self._keys.policy, outcome.words)
        active = self._doors.active_policy()
        reply = PolicyReply(outcome.accepted, active.policy.name, active.sha256, outcome.words, outcome.report)
        with query:
            query.reply(self._keys.policy, msgspec.json.encode(reply))

    def _answer_faults(self, _query: zenoh.Query) -> bytes:
        return msgspec.json.encode(self._wait(self._doors.fault_history))

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


def _bytes(payload: Any, bound: int = LARGEST_MESSAGE) -> bytes:
    """A payload, unless it is larger than what its key carries: then it is not even copied."""
    if len(payload) > bound:
        raise MessageError(f"{len(payload)} bytes; a message here has at most {bound}")
    return bytes(payload)


def _payload(query: zenoh.Query, bound: int = LARGEST_MESSAGE) -> bytes:
    return b"" if query.payload is None else _bytes(query.payload, bound)
