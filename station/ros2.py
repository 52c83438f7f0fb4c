"""``trotd ros2``: one robot as a node among ROS 2 nodes that speak ``rmw_zenoh``. A process of its own.

Out go ``/joint_states``, ``/imu/data``, ``/odom`` and ``/tf``; ``/cmd_vel`` comes in and is an operator's velocity,
no more: the robot is armed, stood up and set walking with trotd's own commands.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import zenoh

from runtime.control.parameters import BoundsConfig
from runtime.delays import Delays
from runtime.messages.motion import VelocityMessage
from station import cdr
from station.cdr import CdrError
from station.rmw_zenoh import Attachment, Node, Role, Topic, decode_attachment, gid_of
from station.ros_messages import NANOSECONDS, imu, joint_state, odometry, transforms
from station.session import Station, StationError, session_config
from station.ticks import TickStream

LATE = 0.2
"""s; a command that took so much longer than its publisher's quickest is not a wish of now."""
FORGET = 1e-3
"""s a second, by which the quickest tick is believed less: clocks drift apart."""
COMMANDS = ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped")
Message = dict[str, Any]


def topic(name: str, kind: str, depth: int = 10) -> Topic:
    """A topic of a type that this process has the definition of."""
    return Topic(name, kind, cdr.type_hash(kind), depth)


def open_router(endpoint: str) -> Any:
    """A zenoh session with ROS 2's router, which may be the one that leads to the daemon too.

    Raises:
        StationError: nobody there, or no router; the message says how to start one beside the daemon.
    """
    try:
        session: Any = zenoh.open(session_config(endpoint))
    except zenoh.ZError as error:
        raise StationError(
            f"no zenoh router of ROS 2 at {endpoint}: start one with"
            f" ZENOH_CONFIG_OVERRIDE='listen/endpoints=[\"{endpoint}\"]' ros2 run rmw_zenoh_cpp rmw_zenohd"
        ) from error
    if not session.info.routers_zid():
        session.close()
        raise StationError(
            f"{endpoint} is no zenoh router: is it the daemon? ROS 2's router has its port to itself;"
            " start one of both elsewhere: trotd run --listen, or the router's listen/endpoints"
        )
    return session


class Refused(ValueError):
    """A command that is not taken; the few words are what it is counted under."""


class Publisher:
    """One topic of the node: its token in the graph, its sequence numbers, its messages."""

    def __init__(self, session: Any, node: Node, number: int, what: Topic) -> None:
        self.topic = what
        self._kind = what.kind
        token = node.token_of(number, Role.PUBLISHER, what)
        self._gid = gid_of(token)
        self._sequence = 0
        self._publisher = session.declare_publisher(
            what.key(node.domain), congestion_control=zenoh.CongestionControl.DROP
        )
        self._token = session.liveliness().declare_token(token)

    def put(self, message: Message) -> None:
        """Send a message to whoever listens."""
        self._sequence += 1
        if self._publisher.matching_status.matching:
            attachment = Attachment(self._sequence, time.time_ns(), self._gid)
            self._publisher.put(cdr.encode(self._kind, message), attachment=attachment.encode())


class Clock:
    """When a tick was on this machine's wall clock: by the quickest message so far, so that no jitter comes in."""

    def __init__(self) -> None:
        self._offset = math.inf
        self._last = -math.inf

    def of(self, stamp: float, now: float) -> int:
        """A tick's ``stamp`` (s, the robot's monotonic clock) that is here at ``now`` (s), as ns since 1970."""
        if stamp < self._last:  # the robot's machine was started anew
            self._offset = math.inf
        elif math.isfinite(self._last):
            self._offset += FORGET * (stamp - self._last)
        self._last = stamp
        self._offset = min(self._offset, now - stamp)
        return round((stamp + self._offset) * NANOSECONDS)


class Steering:
    """What comes on ``/cmd_vel``, as an operator's velocity; what cannot be one is counted by its reason."""

    def __init__(self, station: Station, bounds: BoundsConfig) -> None:
        self.counts: Counter[str] = Counter()
        """``taken``, ``clipped`` and the reasons of those that were not taken."""
        self._station = station
        self._bounds = (*bounds.linear_velocity, bounds.yaw_rate)
        self._delays = Delays()
        self._token: Any = None
        self._lock = threading.Lock()

    def hear(self, kind: str, sample: zenoh.Sample) -> None:
        """One message of ``kind``. On zenoh's threads."""
        with self._lock:
            try:
                velocity = self._read(kind, sample, time.monotonic())
            except CdrError:
                self.counts["not a message of its type"] += 1
                return
            except Refused as error:
                self.counts[str(error)] += 1
                return
            self._take(velocity)

    def _read(self, kind: str, sample: zenoh.Sample, now: float) -> np.ndarray:
        try:
            attachment = decode_attachment(b"" if sample.attachment is None else sample.attachment.to_bytes())
        except ValueError as error:
            raise Refused("without rmw_zenoh's attachment") from error
        if self._delays.lateness(attachment.gid, attachment.stamp / NANOSECONDS, now) > LATE:
            raise Refused("late")
        message = cdr.decode(kind, sample.payload.to_bytes())
        twist = message.twist if kind == COMMANDS[1] else message
        velocity = np.array((twist.linear.x, twist.linear.y, twist.angular.z))
        if not np.isfinite(velocity).all():
            raise Refused("not finite")
        return velocity

    def _take(self, velocity: np.ndarray) -> None:
        if self._token is None:  # from now on the robot stands when this process is gone
            name = f"{self._station.keys.operator}/ros2-{self._station.session.zid()}"
            self._token = self._station.session.liveliness().declare_token(name)
        bounded = np.clip(velocity, np.negative(self._bounds), self._bounds)
        self.counts["taken"] += 1
        self.counts["clipped"] += int((bounded != velocity).any())
        forward, left, turn = bounded.tolist()
        message = VelocityMessage((forward, left), turn)
        self._station.session.put(self._station.keys.velocity, msgspec.json.encode(message))


class Bridge:
    """The node: four publishers and, unless it only observes, two subscriptions of the one topic."""

    def __init__(
        self, station: Station, ros: Any, domain: int, bounds: BoundsConfig, namespace: str = "/", observe: bool = False
    ) -> None:
        """Declare everything; ``ros`` is the session with ROS 2's router."""
        self.steering = Steering(station, bounds)
        self.published = 0
        """Ticks that were published."""
        self._station = station
        self._node = node = Node(domain, str(ros.zid()), station.robot.replace("-", "_"), namespace)
        inside = namespace.rstrip("/")
        topics: list[tuple[Topic, Callable[[np.void, int], Message]]] = [
            (topic(f"{inside}/joint_states", "sensor_msgs/msg/JointState"), joint_state),
            (topic(f"{inside}/imu/data", "sensor_msgs/msg/Imu"), imu),
            (topic(f"{inside}/odom", "nav_msgs/msg/Odometry"), odometry),
            (topic("/tf", "tf2_msgs/msg/TFMessage", 100), transforms),
        ]
        self._publishers = [
            (Publisher(ros, node, number, what), build) for number, (what, build) in enumerate(topics, start=1)
        ]
        self._declared = [ros.liveliness().declare_token(node.token)]
        for number, kind in enumerate(() if observe else COMMANDS, start=1 + len(topics)):
            what = topic(f"{inside}/cmd_vel", kind, 1)
            self._declared += [
                ros.declare_subscriber(
                    what.any_hash(domain), lambda sample, kind=kind: self.steering.hear(kind, sample)
                ),
                ros.liveliness().declare_token(node.token_of(number, Role.SUBSCRIPTION, what)),
            ]

    def run(self, hz: float, going: Callable[[], bool], tell: Callable[[Bridge], None]) -> None:
        """Publish ``hz`` ticks a second at most while ``going`` says so; ``tell`` is called after each look."""
        clock, last = Clock(), -math.inf
        with TickStream(self._station) as stream:
            while going():
                now = time.time()
                ticks = stream.take()
                behind = ticks["stamp"][-1] if len(ticks) else 0.0
                for tick in ticks:
                    stamp = float(tick["stamp"])
                    if stamp - last >= 0.999 / hz or stamp < last:
                        last = stamp
                        self._publish(tick, clock.of(stamp, now - float(behind - stamp)))
                tell(self)
                time.sleep(0.5 / hz)

    def _publish(self, tick: np.void, when: int) -> None:
        self.published += 1
        for publisher, build in self._publishers:
            publisher.put(build(tick, when))
