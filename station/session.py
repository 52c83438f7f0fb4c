"""The desk's end of the link: one zenoh session to one robot, with a time limit on every question.

zenoh answers nobody who may not ask: silence is reported as "nobody answers, or it is not permitted".
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

import msgspec
import zenoh

from runtime.access import AccessError, use_certificates
from runtime.messages.keys import Keys
from runtime.messages.status import Status

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
PATIENCE = 5.0
"""s that a question waits for its answer, where it does not say how long."""
Answer = TypeVar("Answer")


class StationError(RuntimeError):
    """What the operator must know to go on: the message names the robot, the endpoint or the file."""


class NoAnswer(StationError):
    """Nobody answered in time."""


def certificates() -> Path:
    """Where this user's certificate lies: ``TROTD_CERTIFICATES``, or ``~/.config/trotd/certificates``."""
    named = os.environ.get("TROTD_CERTIFICATES")
    return Path(named) if named else Path.home() / ".config" / "trotd" / "certificates"


def session_config(endpoint: str) -> zenoh.Config:
    """A client of the one endpoint that is named; no scouting. A ``tls/`` one is shown this user's certificate.

    Raises:
        StationError: a certificate is needed and not there.
    """
    config = zenoh.Config()
    for key, value in (
        ("mode", "client"),
        ("connect/endpoints", [endpoint]),
        ("scouting/multicast/enabled", False),
        ("scouting/gossip/enabled", False),
        ("timestamping/enabled", True),  # the daemon tells by it what waited on the way
        ("transport/shared_memory/enabled", False),  # gains nothing below 2 kB; a confined service may not have it
    ):
        config.insert_json5(key, json.dumps(value))
    if endpoint.startswith("tls/"):
        try:
            use_certificates(config, certificates())
        except AccessError as error:
            raise StationError(f"{endpoint} needs a certificate: {error}") from error
    return config


class Station:
    """One robot, as reached from the desk."""

    def __init__(self, session: zenoh.Session, robot: str, endpoint: str, patience: float = PATIENCE) -> None:
        self.session = session
        self.robot = robot
        self.endpoint = endpoint
        self.patience = patience
        """s that a question waits for its answer."""
        self.keys = Keys(robot)

    def ask(self, key: str, payload: bytes | None = None, parameters: str = "", timeout: float | None = None) -> bytes:
        """The one reply to a query on ``key``.

        Args:
            key: one of ``keys``.
            payload: what is sent along.
            parameters: zenoh's selector parameters, such as ``write`` or ``name=x``.
            timeout: how long to wait, s; ``patience`` if not said.

        Raises:
            NoAnswer: silence for ``timeout``.
            StationError: the robot answered with an error.
        """
        timeout = self.patience if timeout is None else timeout
        selector = f"{key}?{parameters}" if parameters else key
        for reply in self.session.get(selector, payload=payload, timeout=timeout):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            assert reply.err is not None
            words = reply.err.payload.to_bytes()
            if words != b"Timeout":
                raise StationError(f"robot {self.robot!r}: {words.decode(errors='replace')}")
        raise NoAnswer(
            f"robot {self.robot!r} at {self.endpoint} does not answer on {key} within {timeout:g} s:"
            " it is another robot's endpoint, or this certificate may not ask"
        )

    def ask_for(
        self,
        kind: type[Answer],
        key: str,
        payload: bytes | None = None,
        parameters: str = "",
        timeout: float | None = None,
    ) -> Answer:
        """``ask``, with the JSON reply decoded to ``kind``."""
        data = self.ask(key, payload, parameters, timeout)
        try:
            return msgspec.json.decode(data, type=kind)
        except msgspec.MsgspecError as error:
            raise StationError(f"robot {self.robot!r}: reply on {key}: {error}") from error

    def next_status(self, timeout: float | None = None) -> Status:
        """The next status that the robot sends.

        Raises:
            NoAnswer: none within ``timeout`` seconds; ``patience`` if not said.
        """
        timeout = self.patience if timeout is None else timeout
        arrived: SimpleQueue[bytes] = SimpleQueue()
        subscriber: Any = self.session.declare_subscriber(self.keys.status, lambda s: arrived.put(s.payload.to_bytes()))
        try:
            return msgspec.json.decode(arrived.get(timeout=timeout), type=Status)
        except Empty:
            raise NoAnswer(f"robot {self.robot!r} at {self.endpoint}: no status within {timeout:g} s") from None
        except msgspec.MsgspecError as error:
            raise StationError(f"robot {self.robot!r}: status: {error}") from error
        finally:
            subscriber.undeclare()


def free_endpoint() -> str:
    """A TCP endpoint of this machine that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@contextlib.contextmanager
def connected(robot: str, endpoint: str = DEFAULT_ENDPOINT, patience: float = PATIENCE) -> Iterator[Station]:
    """A station for ``robot`` that waits ``patience`` seconds for an answer; closed at the end.

    Raises:
        StationError: nobody listens at the endpoint, or it refuses this side's certificate.
    """
    zenoh.init_log_from_env_or("off")
    try:
        session: Any = zenoh.open(session_config(endpoint))
    except zenoh.ZError as error:
        why = "is `trotd run` up there (its first start compiles for minutes), and is this what it listens on?"
        if endpoint.startswith("tls/"):
            why = "does it run there, and does it know this certificate?"
        raise StationError(f"no daemon to talk to at {endpoint}: {why}") from error
    try:
        yield Station(session, robot, endpoint, patience)
    finally:
        session.close()
