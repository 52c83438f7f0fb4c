"""The robot among ROS 2 nodes: names, hashes and bytes as rmw_zenoh has them, read by another implementation of CDR."""

from __future__ import annotations

import asyncio
import json
import math
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from daemons import CALM, PATIENCE, Served, free_endpoint, make_config, quick_robot, running, until
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Schema
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap_ros2.decoder import DecoderFactory

from runtime.messages.mode import Mode
from runtime.messages.tick import TICK_DTYPE
from station import cdr, ros_messages
from station.cdr import CdrError
from station.requests import set_off
from station.rmw_zenoh import Attachment, Node, Reliability, Role, Topic, decode_attachment, gid_of
from station.ros2 import COMMANDS, Bridge, Clock, open_router, topic
from station.session import StationError, connected

HASHES = {
    "sensor_msgs/msg/JointState": "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "tf2_msgs/msg/TFMessage": "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "geometry_msgs/msg/Twist": "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    "std_msgs/msg/String": "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
}
"""As ``ros2 topic info --verbose`` prints them."""
BUILDERS = {
    "sensor_msgs/msg/JointState": ros_messages.joint_state,
    "sensor_msgs/msg/Imu": ros_messages.imu,
    "nav_msgs/msg/Odometry": ros_messages.odometry,
    "tf2_msgs/msg/TFMessage": ros_messages.transforms,
    "geometry_msgs/msg/TwistStamped": ros_messages.twist,
}


@pytest.mark.parametrize(("kind", "known"), HASHES.items())
def test_type_hashes_are_those_of_ros(kind: str, known: str) -> None:
    assert cdr.type_hash(kind) == known


def test_keys_and_tokens_have_the_documented_layout() -> None:
    what = Topic("/joint_states", "sensor_msgs/msg/JointState", "RIHS01_a13ee3")
    node = Node(0, "abc", "joint_state_publisher")
    assert what.key(7) == "7/joint_states/sensor_msgs::msg::dds_::JointState_/RIHS01_a13ee3"
    assert node.token == "@ros2_lv/0/abc/0/0/NN/%/%/joint_state_publisher"
    assert node.token_of(11, Role.PUBLISHER, what) == (
        "@ros2_lv/0/abc/0/11/MP/%/%/joint_state_publisher/%joint_states/sensor_msgs::msg::dds_::JointState_/"
        "RIHS01_a13ee3/::,10:,:,:,,"
    )
    deep = Node(3, "abc", "n", "/robots/a")
    best = Topic("/robots/a/cmd_vel", COMMANDS[0], "RIHS01_x", 42, Reliability.BEST_EFFORT)
    assert deep.token_of(2, Role.SUBSCRIPTION, best).startswith(
        "@ros2_lv/3/abc/0/2/MS/%/%robots%a/n/%robots%a%cmd_vel/"
    )
    assert best.quality == "2::,:,:,:,,"
    for key in (what.key(7), node.token, deep.token_of(2, Role.SUBSCRIPTION, best)):
        assert str(zenoh.KeyExpr(key)) == key


def test_a_gid_is_the_hash_of_the_token() -> None:
    """XXH3's own test vector: 128 bits of no bytes."""
    low, high = 0x6001C324468D497F, 0x99AA06D3014798D8
    assert gid_of("") == struct.pack("<QQ", low, high)


@given(st.integers(0, 2**62), st.integers(0, 2**62), st.binary(min_size=16, max_size=16))
def test_an_attachment_comes_back(sequence: int, stamp: int, gid: bytes) -> None:
    made = Attachment(sequence, stamp, gid)
    data = made.encode()
    assert len(data) == 33 and decode_attachment(data) == made
    assert data == zenoh.ext.z_serialize((zenoh.ext.Int64(sequence), zenoh.ext.Int64(stamp), gid)).to_bytes()


@given(st.binary(max_size=40).filter(lambda data: len(data) != 33))
def test_no_attachment_is_a_value_error(data: bytes) -> None:
    with pytest.raises(ValueError, match="attachment"):
        decode_attachment(data)


def random_tick(seed: int) -> np.void:
    generator = np.random.default_rng(seed)
    tick = np.zeros(1, TICK_DTYPE)
    for name in TICK_DTYPE.names or ():
        if TICK_DTYPE[name].base.kind == "f":
            tick[name] = generator.normal(size=tick[name].shape)
    return tick[0]


def read_message(kind: str, data: bytes) -> Any:
    """As a reader of MCAP files would, from the definition in the file's schema."""
    schema = Schema(1, ros_messages.definition(kind).encode(), SchemaEncoding.ROS2, kind)
    decoder = DecoderFactory().decoder_for(MessageEncoding.CDR, schema)
    assert decoder is not None
    return decoder(data)


def plain(value: Any) -> Any:
    """A decoded message as dictionaries, lists and numbers."""
    if hasattr(value, "__slots__") and not isinstance(value, np.ndarray):
        names = [name for name in value.__slots__ if not name.startswith("_")]
        return {name: plain(getattr(value, name)) for name in names}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(part) for part in value]
    return value.item() if isinstance(value, np.generic) else value


@pytest.mark.parametrize("kind", BUILDERS)
def test_an_independent_reader_sees_what_was_meant(kind: str) -> None:
    message = BUILDERS[kind](random_tick(3), 1_700_000_000_123_456_789)
    data = cdr.encode(kind, message)
    assert data[:2] == b"\0\1"
    read = read_message(kind, data)
    assert plain(read) == json.loads(json.dumps(message))


@given(st.sampled_from(COMMANDS), st.binary(max_size=120))
def test_bytes_that_are_no_message_are_refused_by_name(kind: str, data: bytes) -> None:
    try:
        cdr.decode(kind, data)
    except CdrError as error:
        assert kind in str(error)


def test_stamps_do_not_jitter_and_survive_a_new_start_of_the_robot() -> None:
    clock, generator = Clock(), np.random.default_rng(0)
    made = [clock.of(10.0 + 0.02 * n, 1000.0 + 0.02 * n + 0.005 * generator.random()) for n in range(500)]
    steps = np.diff(made[100:])
    assert abs(steps - 20_000_000).max() < 1_500_000, "what came with up to 5 ms of jitter"
    assert abs(steps - 20_000_000).mean() < 200_000
    assert clock.of(1.0, 2000.0) == 2000 * ros_messages.NANOSECONDS


# A router, a robot and a ROS 2 node ----------------------------------------------------------------------------------


@contextmanager
def router() -> Iterator[tuple[Any, str]]:
    """What ``rmw_zenohd`` is: a zenoh router; its session stands for another node's."""
    endpoint = free_endpoint()
    config = zenoh.Config()
    for key, value in (("mode", "router"), ("listen/endpoints", [endpoint]), ("scouting/multicast/enabled", False)):
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield session, endpoint


@contextmanager
def bridged(served: Served, endpoint: str, daemon: str = "", **options: Any) -> Iterator[Bridge]:
    """The bridge on a thread of its own, as its process would run it; the daemon is where it listens, or ``daemon``."""
    made = served.config
    stop = threading.Event()
    with connected(made.robot.name, daemon or made.link.listen[0]) as station, open_router(endpoint) as ros:
        bridge = Bridge(station, ros, 5, made.control.bounds, **options)
        thread = threading.Thread(target=bridge.run, args=(100.0, lambda: not stop.is_set(), lambda _bridge: None))
        thread.start()
        try:
            yield bridge
        finally:
            stop.set()
            thread.join()


class Peer:
    """Another node: hears every topic, sends velocities as rclpy would."""

    def __init__(self, session: Any) -> None:
        self.session = session
        self.heard: dict[str, list[tuple[bytes, Attachment]]] = {}
        self.sequence = 0
        self.subscriber = session.declare_subscriber("5/**", self._hear)

    def _hear(self, sample: Any) -> None:
        if sample.attachment is not None and "/cmd_vel/" not in str(sample.key_expr):
            pair = (sample.payload.to_bytes(), decode_attachment(sample.attachment.to_bytes()))
            self.heard.setdefault(str(sample.key_expr), []).append(pair)

    def steer(self, kind: str, forward: float, age: float = 0.0, **change: Any) -> None:
        self.sequence += 1
        zero = dict.fromkeys("xyz", 0.0)
        message: dict[str, Any] = {"linear": zero | {"x": forward}, "angular": zero}
        if kind == COMMANDS[1]:
            message = {"header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}, "twist": message}
        attachment = Attachment(self.sequence, time.time_ns() - round(age * 1e9), b"0123456789abcdef").encode()
        sent = {"payload": cdr.encode(kind, message), "attachment": attachment} | change
        self.session.put(topic("/cmd_vel", kind).key(5), congestion_control=zenoh.CongestionControl.BLOCK, **sent)


def test_the_robot_is_a_node_whose_messages_another_reads(tmp_path: Path) -> None:
    async def main() -> None:
        async with Served(make_config(), tmp_path) as served:
            with router() as (session, endpoint), bridged(served, endpoint):
                peer = Peer(session)
                await until(lambda: len(peer.heard) == 4 and min(map(len, peer.heard.values())) > 5)
                tokens = {str(reply.ok.key_expr) for reply in session.liveliness().get("@ros2_lv/5/**")}
            peer.subscriber.undeclare()
        name = served.config.robot.name.replace("-", "_")
        kinds = {"joint_states": "JointState", "imu/data": "Imu", "odom": "Odometry", "tf": "TFMessage"}
        assert {key.split("/RIHS01_")[0].rsplit("/", 1)[0] for key in peer.heard} == {f"5/{place}" for place in kinds}
        assert sum("/MP/" in token for token in tokens) == 4 and sum("/MS/" in token for token in tokens) == 2
        assert sum(token.endswith(f"/NN/%/%/{name}") for token in tokens) == 1 and len(tokens) == 7
        for key, messages in peer.heard.items():
            kind = next(kind for kind in BUILDERS if key.endswith(topic("/x", kind).key(5).removeprefix("5/x")))
            attachments = [attachment for _, attachment in messages]
            assert [a.sequence for a in attachments] == list(
                range(attachments[0].sequence, attachments[0].sequence + len(messages))
            )
            (token,) = {token for token in tokens if gid_of(token) == attachments[0].gid}
            assert f"/{kind.split('/')[0]}::msg::dds_::" in token
            for data, attachment in messages:
                read: Any = read_message(kind, data)
                stamp = (read.transforms[0] if kind.startswith("tf2") else read).header.stamp
                assert abs(stamp.sec + stamp.nanosec * 1e-9 - attachment.stamp * 1e-9) < PATIENCE  # of one clock

    asyncio.run(main())


@pytest.mark.parametrize("kind", COMMANDS)
def test_a_twist_steers_a_robot_that_walks_and_no_other(kind: str, tmp_path: Path) -> None:
    async def main() -> None:
        async with Served(make_config(), tmp_path) as served:
            with router() as (session, endpoint), bridged(served, endpoint) as bridge:
                peer, row = Peer(session), served.daemon.cycle.tick
                await until(lambda: bridge.published > 0)
                peer.steer(kind, 0.3)
                await until(lambda: bridge.steering.counts["taken"] == 1)
                assert served.daemon.cycle.state.mode is Mode.DAMP
                peer.steer(kind, 0.0)  # arming wants the sticks centred
                await until(lambda: bridge.steering.counts["taken"] == 2)
                await served.walk()
                peer.steer(kind, 0.3)
                await until(lambda: row["asked_velocity"][0].tolist() == [0.3, 0.0, 0.0])
                bound = served.config.control.bounds.linear_velocity[0]
                peer.steer(kind, -100.0)
                await until(lambda: row["asked_velocity"][0].tolist() == [-bound, 0.0, 0.0])
                assert bridge.steering.counts["clipped"] == 1
                peer.subscriber.undeclare()
            await served.reach(Mode.STAND)  # the process that steered is gone

    asyncio.run(main())


def test_what_cannot_be_a_wish_of_now_is_counted_and_moves_nothing(tmp_path: Path) -> None:
    async def main() -> None:
        async with Served(make_config(), tmp_path) as served:
            with router() as (session, endpoint), bridged(served, endpoint) as bridge:
                peer, counts = Peer(session), bridge.steering.counts
                await until(lambda: bridge.published > 0)
                await served.walk()
                peer.steer(COMMANDS[0], 0.0)
                peer.steer(COMMANDS[0], 0.3, age=2.0)
                peer.steer(COMMANDS[0], math.nan)
                peer.steer(COMMANDS[0], 0.3, attachment=None)
                peer.steer(COMMANDS[0], 0.3, payload=b"\0\1\0\0" + bytes(7))
                peer.steer(COMMANDS[0], 0.3, payload=bytes(2**16))
                await until(lambda: sum(counts.values()) >= 6)
                assert not served.daemon.cycle.tick["asked_velocity"].any()
                assert counts == {
                    "taken": 1,
                    "clipped": 0,
                    "late": 1,
                    "not finite": 1,
                    "without rmw_zenoh's attachment": 1,
                    "not a message of its type": 2,
                }
                peer.subscriber.undeclare()

    asyncio.run(main())


def test_an_observer_declares_no_subscription(tmp_path: Path) -> None:
    async def main() -> None:
        async with Served(make_config(), tmp_path) as served:
            with router() as (session, endpoint), bridged(served, endpoint, observe=True, namespace="/a") as bridge:
                await until(lambda: bridge.published > 0)  # by then everything is declared
                tokens: list[str] = []
                end = time.monotonic() + PATIENCE
                while len(tokens) < 5 and time.monotonic() < end:
                    tokens = [str(reply.ok.key_expr) for reply in session.liveliness().get("@ros2_lv/5/**")]
            assert len(tokens) == 5 and not any("/MS/" in token for token in tokens)
            assert any("/%a%joint_states/" in token for token in tokens)

    asyncio.run(main())


def test_the_daemon_and_ros_share_a_router_that_runs_already(tmp_path: Path) -> None:
    async def main() -> None:
        with router() as (session, endpoint):
            async with Served(make_config(link__connect=[endpoint]), tmp_path) as served:
                with bridged(served, endpoint, daemon=endpoint) as bridge:
                    peer, row = Peer(session), served.daemon.cycle.tick
                    await until(lambda: len(peer.heard) == 4)
                    peer.steer(COMMANDS[0], 0.0)
                    await until(lambda: bridge.steering.counts["taken"] == 1)
                    await served.walk()
                    peer.steer(COMMANDS[0], 0.3)
                    await until(lambda: row["asked_velocity"][0].tolist() == [0.3, 0.0, 0.0])
                    peer.subscriber.undeclare()
                await served.reach(Mode.STAND)

    asyncio.run(main())


def test_a_daemon_is_not_taken_for_a_router(tmp_path: Path) -> None:
    async def main() -> None:
        async with Served(make_config(), tmp_path) as served:
            with pytest.raises(StationError, match="is no zenoh router: is it the daemon"):
                await asyncio.to_thread(open_router, served.config.link.listen[0])

    asyncio.run(main())


def test_a_router_that_is_not_there_is_one_line_with_what_to_do() -> None:
    with pytest.raises(StationError, match="rmw_zenohd"):
        open_router(free_endpoint())


def test_cmd_vel_moves_the_simulated_robot(tmp_path: Path) -> None:
    """Both commands as a user starts them; the speed is read from /odom."""
    robot = quick_robot(tmp_path, tables=CALM)
    with router() as (session, endpoint), running(tmp_path, robot, "sim") as (_, station):
        command = [sys.executable, "-m", "trotd.cli", "ros2", "--connect", station.endpoint, "--router", endpoint]
        neighbour = subprocess.Popen([*command, "--domain", "5"], stderr=subprocess.PIPE, text=True)
        try:
            peer = Peer(session)
            odometry = topic("/odom", "nav_msgs/msg/Odometry").key(5)
            set_off(station)
            end = time.monotonic() + PATIENCE
            while time.monotonic() < end and (len(peer.heard.get(odometry, [])) < 10 or speed(peer, odometry) < 0.25):
                peer.steer(COMMANDS[0], 0.4)
                time.sleep(0.05)
            assert speed(peer, odometry) >= 0.25
            peer.subscriber.undeclare()
            neighbour.send_signal(signal.SIGINT)
            words = neighbour.communicate(timeout=PATIENCE)[1]
            assert neighbour.returncode == 130 and "Traceback" not in words
        finally:
            neighbour.kill()
            neighbour.communicate()


def speed(peer: Peer, odometry: str) -> float:
    """Forward, mean of the last messages, m/s."""
    last = [read_message("nav_msgs/msg/Odometry", data) for data, _ in peer.heard[odometry][-10:]]
    return float(np.mean([message.twist.twist.linear.x for message in last]))
