"""``trotd push``: a policy to the robot, checked here first, and the robot's verdict, which takes it some seconds."""

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec

from runtime import policies
from runtime.control.policy import Policy
from runtime.messages.policy import PolicyEntry, PolicyReply
from station.session import Station, StationError

VERDICT_TIMEOUT = 60.0
"""Shadow, waiting for support, blending and trial may take together, s."""


def push(station: Station, path: Path, immediate: bool = False) -> PolicyReply:
    """Send a policy file and return what the robot made of it.

    Raises:
        PolicyError: it cannot be this robot's policy; nothing was sent.
        StationError: nobody answers, or something else than this file became active.
    """
    policies.load(path, station.robot)
    return send(station, path.read_bytes(), immediate)


def send(station: Station, data: bytes, immediate: bool = False) -> PolicyReply:
    """Send the bytes of a policy file: what training does with every iteration.

    Args:
        station: the robot.
        data: as ``encode_policy`` makes them.
        immediate: active at the next support, without a shadow and without waiting for the trial's end. Every check is
            made and the trial runs all the same; only simulated bodies accept it.

    Raises:
        StationError: nobody answers, or something else than this policy became active.
    """
    parameters = "immediate" if immediate else ""
    reply = station.ask_for(PolicyReply, station.keys.policy, data, parameters, timeout=VERDICT_TIMEOUT)
    if reply.accepted and reply.sha256 != hashlib.sha256(data).hexdigest():
        raise StationError(f"robot {station.robot!r}: accepted, but {reply.name} {reply.sha256[:12]} is active")
    return reply


def roll_back(station: Station) -> PolicyReply:
    """Have the robot take the last policy again that proved good and is not the active one."""
    return station.ask_for(PolicyReply, station.keys.policy, parameters="rollback", timeout=VERDICT_TIMEOUT)


def active(station: Station) -> tuple[Policy, str]:
    """The robot's active policy and its file's digest."""
    data = station.ask(station.keys.policy)
    try:
        return msgspec.json.decode(data, type=Policy), hashlib.sha256(data).hexdigest()
    except msgspec.MsgspecError as error:
        raise StationError(f"robot {station.robot!r}: its policy: {error}") from error


def known(station: Station) -> list[PolicyEntry]:
    """Every policy that the robot knows of: active, previous, good, kept, shipped."""
    return station.ask_for(list[PolicyEntry], station.keys.policies)
