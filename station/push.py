"""``trotd push``: a policy to the robot, checked here first, and the robot's verdict."""

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec

from runtime import policies
from runtime.control.policy import Policy
from runtime.messages import PolicyReply
from station.session import Station, StationError


def push(station: Station, path: Path) -> PolicyReply:
    """Send a policy file and return what the robot made of it.

    Raises:
        PolicyError: it cannot be this robot's policy; nothing was sent.
        StationError: nobody answers, or something else than this file became active.
    """
    policies.load(path, station.robot)
    data = path.read_bytes()
    reply = station.ask_for(PolicyReply, station.keys.policy, data)
    if reply.accepted and reply.sha256 != hashlib.sha256(data).hexdigest():
        raise StationError(f"robot {station.robot!r}: accepted, but {reply.name} {reply.sha256[:12]} is active")
    return reply


def roll_back(station: Station) -> PolicyReply:
    """Have the robot take the policy again that was active before."""
    return station.ask_for(PolicyReply, station.keys.policy, parameters="rollback")


def active(station: Station) -> tuple[Policy, str]:
    """The robot's active policy and its file's digest."""
    data = station.ask(station.keys.policy)
    try:
        return msgspec.json.decode(data, type=Policy), hashlib.sha256(data).hexdigest()
    except msgspec.MsgspecError as error:
        raise StationError(f"robot {station.robot!r}: its policy: {error}") from error
