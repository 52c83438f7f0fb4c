"""The zenoh doors with a real session on each side and a stand-in for the daemon behind them."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zenoh
from daemons import PATIENCE, free_endpoint, make_config, make_policy

from runtime.audition import Outcome
from runtime.config import Config
from runtime.control.policy import encode_policy
from runtime.control.records import VelocityCommand
from runtime.doors.answers import Channel, Doors
from runtime.link import Link, LinkError
from runtime.messages.decoding import MessageError
from runtime.messages.event import Event
from runtime.messages.fault import FaultRecord
from runtime.messages.mode import ModeReply, Request
from runtime.messages.motion import PoseMessage
from runtime.messages.policy import PolicyEntry, PolicyReply
from runtime.messages.recording import RecordingEntry, RecordingReply
from runtime.messages.status import Status
from runtime.messages.tick import TICK_DTYPE
from runtime.messages.tuning import TuningEntry, TuningReply, TuningRequest
from runtime.policies import PolicyError
from runtime.shelf import PolicyFile
from station.session import Station, StationError, connected

STATUS = Status(
    robot="r", mode="DAMP", armed=False, fault="", reason="", policy="p", rate_hz=200.0, ticks=1, overruns=0,
    velocity_command=(0, 0, 0), velocity=(0, 0, 0), height=0.5, rpy=(0, 0, 0), voltage=48.0, max_temperature=20.0,
    tick_p50=0.0, tick_p99=0.0, clamps={}, solver={},
)  # fmt: skip


class Desk:
    """Stands in for the daemon: notes what came through, and on which thread every door was opened."""

    def __init__(self, robot: str) -> None:
        self.velocities: list[VelocityCommand] = []
        self.requests: list[Request] = []
        self.refused: list[tuple[str, str]] = []
        self.threads: set[int] = set()
        self.lost = 0
        self.poses: list[PoseMessage] = []
        policy = make_policy(robot)
        self.file = PolicyFile(policy, encode_policy(policy))
        for name in (name for name in vars(Doors) if not name.startswith("_")):
            setattr(self, name, self._noting(getattr(self, name)))

    def _noting(self, door: Callable[..., Any]) -> Callable[..., Any]:
        def noting(*args: Any) -> Any:
            self.threads.add(threading.get_ident())
            return door(*args)

        return noting

    def take_velocity(self, command: VelocityCommand) -> None:
        self.velocities.append(command)

    def take_request(self, wish: Request) -> ModeReply:
        self.requests.append(wish)
        return ModeReply(wish is not Request.WALK, "DAMP", "because")

    def lose_operator(self) -> None:
        self.lost += 1

    def take_pose(self, pose: PoseMessage) -> None:
        self.poses.append(pose)

    def take_tuning(self, change: TuningRequest, done: Future[TuningReply]) -> None:
        done.set_result(TuningReply(change.name == "swing_time", change.name))

    def list_tuning(self) -> list[TuningEntry]:
        return [TuningEntry("swing_time", "s", 0.2, 0.2, 0.2, 0.1, 0.5, None)]

    def offer_policy(self, file: PolicyFile, immediate: bool, done: Future[Outcome]) -> None:
        self.file = file
        asyncio.get_running_loop().call_later(0.05, done.set_result, Outcome(True, f"immediate: {immediate}", {"a": 1}))

    def roll_back(self, done: Future[Outcome]) -> None:
        raise PolicyError("nothing before")

    def list_policies(self) -> Callable[[], list[PolicyEntry]]:
        return lambda: [PolicyEntry("active", "p", "0", "by hand")]

    def refuse(self, door: str, why: str) -> None:
        self.refused.append((door, why))

    def active_policy(self) -> PolicyFile:
        return self.file

    def fault_history(self) -> list[FaultRecord]:
        return []

    def record_now(self, reason: str, done: Future[Path]) -> None:
        done.set_result(Path("/there"))

    def status(self) -> Status:
        return STATUS


class Open:
    """A link on a loop of the test's, and calls to it from a client thread."""

    def __init__(self, tmp_path: Path, channels: Any = ()) -> None:
        self.config: Config = make_config()
        self.desk = Desk(self.config.robot.name)
        self.link = Link(
            self.config,
            self.desk,
            tmp_path,
            [Channel(f"trotd/{self.config.robot.name}/{c.key}", c.produce, c.accept) for c in channels],
        )

    def run(self, act: Callable[[Station], Any], meanwhile: Callable[[], None] = lambda: None) -> Any:
        def client() -> Any:
            with connected(self.config.robot.name, self.config.link.listen[0], PATIENCE) as station:
                return act(station)

        async def main() -> Any:
            self.link.open()
            sender = asyncio.get_running_loop().create_task(self.link.run())
            acting = asyncio.get_running_loop().create_task(asyncio.to_thread(client))
            try:
                while not acting.done():
                    meanwhile()
                    await asyncio.sleep(0.005)
                assert self.desk.threads <= {threading.get_ident()}, "the daemon was touched from another thread"
                return acting.result()
            finally:
                sender.cancel()
                await asyncio.gather(sender, return_exceptions=True)
                self.link.close()

        return asyncio.run(main())


@pytest.fixture
def opened(tmp_path: Path) -> Open:
    return Open(tmp_path)


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_velocities_come_in_and_what_is_wrong_is_refused_with_its_reason(opened: Open) -> None:
    def act(station: Station) -> None:
        put = station.session.put
        put(station.keys.velocity, b'{"linear": [0.4, -0.1], "yaw_rate": 0.2}')
        until(lambda: len(opened.desk.velocities) == 1)
        put(station.keys.velocity, b'{"linear": [9, 0], "yaw_rate": 0}')
        until(lambda: len(opened.desk.refused) == 1)
        for _ in range(20):
            put(station.keys.velocity, b"\xff")  # a flood of nonsense makes one event a second, not twenty

    opened.run(act)
    command = opened.desk.velocities[0]
    np.testing.assert_array_equal(command.linear, [0.4, -0.1])
    assert command.yaw_rate == 0.2
    assert 0.0 <= time.monotonic() - command.stamp < 60.0
    assert opened.desk.refused[0][1] == "linear[0] = 9.0: must be within ±2"
    assert len(opened.desk.velocities) == 1
    assert len(opened.desk.refused) <= 3


def test_a_mode_request_is_answered_with_its_reason(opened: Open) -> None:
    def act(station: Station) -> list[ModeReply]:
        return [station.ask_for(ModeReply, station.keys.mode, word) for word in (b"stand", b"walk", b"fly", b"\xff\0")]

    stand, walk, fly, noise = opened.run(act)
    assert stand == ModeReply(True, "DAMP", "because")
    assert walk == ModeReply(False, "DAMP", "because")
    assert not fly.accepted and "must be one of" in fly.reason
    assert not noise.accepted
    assert opened.desk.requests == [Request.STAND, Request.WALK]


def test_a_policy_is_fetched_swapped_kept_and_a_bad_one_refused(opened: Open) -> None:
    name = opened.config.robot.name
    candidate = encode_policy(msgspec.structs.replace(make_policy(name), name="candidate"))
    broken = candidate.replace(b'"robot": "' + name.encode(), b'"robot": "other')

    def act(station: Station) -> Any:
        active = station.ask(station.keys.policy)
        good = station.ask_for(PolicyReply, station.keys.policy, candidate)
        bad = [station.ask_for(PolicyReply, station.keys.policy, data) for data in (b"{}", b"\xff", broken)]
        return active, good, bad

    active, good, bad = opened.run(act)
    assert active == encode_policy(make_policy(name))
    assert good.accepted and good.name == "candidate" and good.reason == "immediate: False" and good.report == {"a": 1}
    assert opened.desk.file.data == candidate
    for reply in bad:
        assert not reply.accepted and reply.reason and reply.name == "candidate"
    assert "this robot is" in bad[2].reason


def test_recordings_are_listed_fetched_and_written(opened: Open, tmp_path: Path) -> None:
    (tmp_path / "a.trotd").write_bytes(b"content")
    (tmp_path / "secret").write_bytes(b"not this")

    def act(station: Station) -> Any:
        key = station.keys.recording
        entries = station.ask_for(list[RecordingEntry], key)
        content = station.ask(key, parameters="name=a.trotd")
        written = station.ask_for(RecordingReply, key, parameters="write")
        for name in ("secret", "../a.trotd", "nothing"):
            with pytest.raises(StationError, match="no such recording"):
                station.ask(key, parameters=f"name={name}")
        return entries, content, written

    entries, content, written = opened.run(act)
    assert entries == [RecordingEntry("a.trotd", str(tmp_path / "a.trotd"), 7)]
    assert content == b"content"
    assert written == RecordingReply(True, "/there", "written")


def test_ticks_go_out_in_batches_and_none_is_missing_or_torn(opened: Open) -> None:
    arrived: list[np.ndarray] = []
    row = np.zeros(1, TICK_DTYPE)
    listening = threading.Event()

    def meanwhile() -> None:
        if listening.is_set():
            row["index"] += 1
            row["joint_position"] = row["index"]
            opened.link.offer(row)

    def act(station: Station) -> None:
        subscriber = station.session.declare_subscriber(
            station.keys.tick, lambda sample: arrived.append(np.frombuffer(sample.payload.to_bytes(), TICK_DTYPE))
        )
        until(lambda: opened.link._ticks.heard)
        listening.set()
        until(lambda: len(arrived) >= 8)
        subscriber.undeclare()

    opened.run(act, meanwhile)
    assert all(len(batch) == opened.config.link.batch for batch in arrived)
    ticks = np.concatenate(arrived)
    assert (np.diff(ticks["index"].astype(int)) == 1).all()
    np.testing.assert_array_equal(ticks["joint_position"][:, 2, 1], ticks["index"].astype(float))


def test_events_come_in_order_and_stay_to_be_asked_for(opened: Open) -> None:
    arrived: list[Event] = []
    sent = [Event(stamp=0.0, tick=n, kind="mode", text=f"event {n}") for n in range(50)]
    listening = threading.Event()

    def meanwhile() -> None:
        if listening.is_set():
            listening.clear()
            for event in sent:
                opened.link.tell(event)

    def act(station: Station) -> list[Event]:
        subscriber = station.session.declare_subscriber(
            station.keys.event, lambda s: arrived.append(msgspec.json.decode(s.payload.to_bytes(), type=Event))
        )
        until(lambda: opened.link._event.heard)
        listening.set()
        until(lambda: len(arrived) == len(sent))
        subscriber.undeclare()
        return station.ask_for(list[Event], station.keys.event)

    assert opened.run(act, meanwhile) == sent == arrived


def test_schema_alive_token_and_channels(tmp_path: Path) -> None:
    heard: list[bytes] = []

    def accept(data: bytes) -> None:
        if data == b"bad":
            raise MessageError("force = bad")
        heard.append(data)

    opened = Open(tmp_path, [Channel("sim/push", accept=accept)])

    def act(station: Station) -> Any:
        replies = station.session.liveliness().get(station.keys.alive, timeout=PATIENCE)
        alive = [str(reply.ok.key_expr) for reply in replies if reply.ok]
        for data in (b"good", b"bad"):
            station.session.put(station.keys.sim_push, data)
        until(lambda: len(heard) == 1 and len(opened.desk.refused) == 1)
        return alive, json.loads(station.ask(station.keys.tick_schema))["itemsize"]

    alive, itemsize = opened.run(act)
    assert alive == [opened.link.keys.alive]
    assert itemsize == TICK_DTYPE.itemsize
    assert heard == [b"good"] and opened.desk.refused[0][1] == "force = bad"


def test_a_port_in_use_is_one_line(tmp_path: Path) -> None:
    first, second = Open(tmp_path), Open(tmp_path)
    endpoint = first.config.link.listen[0]
    second.link._config = first.config.link

    async def main() -> str:
        first.link.open()
        try:
            with pytest.raises(LinkError) as caught:
                second.link.open()
            return str(caught.value)
        finally:
            first.link.close()

    assert asyncio.run(main()) == f"link endpoint {endpoint!r}: address already in use"


def test_a_second_daemon_of_the_robot_is_found_over_the_network(tmp_path: Path) -> None:
    first, second = Open(tmp_path), Open(tmp_path)
    second.link._config = msgspec.structs.replace(
        second.config.link, listen=(free_endpoint(),), connect=first.config.link.listen
    )
    second.link._robot, second.link.keys = first.link._robot, first.link.keys

    async def main() -> None:
        first.link.open()
        try:
            with pytest.raises(LinkError, match="another daemon holds"):
                second.link.open()
        finally:
            second.link.close()
            first.link.close()

    asyncio.run(main())


def test_nothing_is_found_by_scouting(opened: Open) -> None:
    def act(_station: Station) -> list[Any]:
        config = zenoh.Config()
        config.insert_json5("scouting/multicast/enabled", "true")
        with zenoh.scout(what="peer|router", config=config) as scout:
            time.sleep(0.3)
            found = []
            while (hello := scout.handler.try_recv()) is not None:
                found += [str(locator) for locator in hello.locators]
            return found

    port = opened.config.link.listen[0].rpartition(":")[2]
    assert not any(locator.endswith(port) for locator in opened.run(act))
