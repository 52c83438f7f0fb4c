"""``trotd joystick``: a pad or the keyboard drives the robot.

It speaks fifty times a second while the robot walks and holds a liveliness token: when the process, the machine or
the cable goes, the robot's side hears it and stands. It never waits for an answer, so a slow link cannot hold up the
sticks.
"""

from __future__ import annotations

import json
import os
import select
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

import msgspec
import zenoh

from runtime.messages.mode import Mode, Request
from runtime.messages.motion import PoseMessage
from runtime.messages.status import Status
from runtime.messages.tuning import TuningReply, TuningRequest
from station.driving import STILL, Driving
from station.pad import SourceLost, Sticks
from station.session import Station

PERIOD = 0.02
"""Between two velocity commands, s."""
DEAF_SECONDS = 0.5
"""Without a status for so long the robot counts as lost."""
PING_SECONDS = 0.5


class Source(Protocol):
    """Sticks and buttons on a file descriptor."""

    def fileno(self) -> int: ...  # noqa: D102
    def read(self) -> list[str]: ...  # noqa: D102
    @property
    def sticks(self) -> Sticks | None: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102


class Joystick:
    """One driver at one robot."""

    def __init__(self, station: Station, driving: Driving) -> None:
        self.driving = driving
        self.status: Status | None = None
        self.latency: float | None = None
        """Round trip of the last question, s."""
        self.words = ""
        """The robot's last answer to a button."""
        self.refusal = ""
        """What it refused last, and why."""
        self._station = station
        self._heard = -DEAF_SECONDS
        self._pinged = 0.0
        self._inbox: deque[Callable[[], None]] = deque(maxlen=256)
        session = station.session
        drop = zenoh.CongestionControl.DROP
        self._velocity: Any = session.declare_publisher(station.keys.velocity, congestion_control=drop, express=True)
        self._token: Any = session.liveliness().declare_token(f"{station.keys.operator}/{os.getpid()}")
        self._subscriber: Any = session.declare_subscriber(station.keys.status, self._hear_status)

    def run(
        self, open_source: Callable[[], Source], show: Callable[[Joystick], None], more: Callable[[], bool]
    ) -> None:
        """Drive until ``more`` says no; a source that is lost is opened again as soon as it is back."""
        source: Source | None = None
        try:
            while more():
                source = self._turn(source, open_source)
                show(self)
        finally:
            if source is not None:
                source.close()
            self._stop()

    def _turn(self, source: Source | None, open_source: Callable[[], Source]) -> Source | None:
        if source is None:
            try:
                source = open_source()
                self.words = "ready"
            except SourceLost as error:
                self.words = str(error)
                time.sleep(0.2)
        try:
            if source is not None and select.select([source], [], [], PERIOD)[0]:
                for button in source.read():
                    self._press(button, source.sticks)
        except SourceLost as error:
            self.words = str(error)
            assert source is not None
            source.close()
            source = None
            self._lose_source()
        self.step(None if source is None else source.sticks)
        return source

    def step(self, sticks: Sticks | None) -> None:
        """Say what the sticks ask for now."""
        while self._inbox:
            self._inbox.popleft()()
        now = time.monotonic()
        deaf = now - self._heard > DEAF_SECONDS
        mode = None if deaf or self.status is None else Mode[self.status.mode]
        velocity = self.driving.velocity(sticks, mode)
        if velocity is not None:
            self._say(velocity)
        pose = self.driving.pose(sticks, mode)
        if pose is not None:
            self._say_pose(pose)
        if now - self._pinged > PING_SECONDS:
            self._pinged = now
            self._ping(now)

    @property
    def deaf(self) -> bool:
        """The robot has not been heard for a while."""
        return time.monotonic() - self._heard > DEAF_SECONDS

    def _say(self, velocity: tuple[float, float, float]) -> None:
        forward, left, turn = velocity
        self._velocity.put(json.dumps({"linear": [forward, left], "yaw_rate": turn, "sticks": True}))

    def _say_pose(self, pose: PoseMessage) -> None:
        self._station.session.put(
            self._station.keys.pose, msgspec.json.encode(pose), congestion_control=zenoh.CongestionControl.DROP
        )

    def _press(self, button: str, sticks: Sticks | None) -> None:
        if button == "pose":
            mode = None if self.status is None else Mode[self.status.mode]
            pose = self.driving.toggle_pose(mode)
            self.words = "the sticks drive" if mode is Mode.STAND else "pose: only while standing"
            if self.driving.posing:
                self.words = "the sticks move the body"
            if pose is not None:
                self._say_pose(pose)
            return
        if button == "gait":
            change = TuningRequest("gait", self.driving.next_gait())
            self._query(f"gait {change.value}", self._station.keys.change_tuning, msgspec.json.encode(change))
            return
        armed = self.status is not None and self.status.armed
        for wish in self.driving.requests(button, sticks, armed):
            self._ask(wish)

    def _ask(self, wish: Request) -> None:
        self._query(wish.value, self._station.keys.mode, wish.value.encode())

    def _query(self, what: str, key: str, payload: bytes) -> None:
        """Ask without waiting; the answer arrives on one of zenoh's threads."""

        def answered(reply: zenoh.Reply) -> None:
            accepted, words = False, "no answer, or this certificate may not drive"
            if reply.ok is not None:
                answer = msgspec.json.decode(reply.ok.payload.to_bytes(), type=TuningReply)
                accepted, words = answer.accepted, answer.reason
            self._inbox.append(lambda: self._take_answer(what, accepted, words))

        self._station.session.get(key, answered, payload=payload, timeout=2.0)

    def _take_answer(self, what: str, accepted: bool, words: str) -> None:
        self.words = f"{what}: {words}" if accepted else f"{what}: refused: {words}"
        if not accepted:
            self.refusal = f"{what}: {words}"

    def _ping(self, sent: float) -> None:
        def answered(_reply: zenoh.Reply) -> None:
            trip = time.monotonic() - sent
            self._inbox.append(lambda: setattr(self, "latency", trip))

        self._station.session.get(self._station.keys.tick_schema, answered, timeout=2.0)

    def _hear_status(self, sample: zenoh.Sample) -> None:
        status = msgspec.json.decode(sample.payload.to_bytes(), type=Status)

        def take() -> None:
            self.status, self._heard = status, time.monotonic()

        self._inbox.append(take)

    def _lose_source(self) -> None:
        """The pad is gone: stop, and stand."""
        self.driving.lose()
        if self.status is not None and self.status.mode == Mode.WALK.name:
            self._say(STILL)
            self._ask(Request.STAND)

    def _stop(self) -> None:
        self._lose_source()
        self._subscriber.undeclare()
        self._token.undeclare()
        self._velocity.undeclare()
