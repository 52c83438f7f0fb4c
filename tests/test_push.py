"""Pushing policies: what is sent is what becomes active and survives; what cannot be is refused before it leaves."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from daemons import Served, make_config, make_policy

from runtime.control.policy import encode_policy
from runtime.messages import PolicyReply
from runtime.policies import PolicyError
from station.push import active, push, roll_back
from station.session import Station


def served(folder: Path, act: Callable[[Station, Path], object]) -> Served:
    """Let ``act`` push the file ``taught.json`` to a robot in damp."""

    async def play() -> Served:
        async with Served(made, folder / "state") as here:
            await here.client(lambda station: act(station, folder / "taught.json"))
            return here

    made = make_config()
    taught = msgspec.structs.replace(make_policy(made.robot.name), name="taught")
    (folder / "taught.json").write_bytes(encode_policy(taught))
    return asyncio.run(play())


def test_a_pushed_policy_is_active_and_kept(tmp_path: Path) -> None:
    def act(station: Station, path: Path) -> None:
        assert active(station)[0].name != "taught"
        reply = push(station, path)
        assert reply.accepted and reply.name == "taught"
        policy, digest = active(station)
        assert (policy.name, digest) == ("taught", reply.sha256)

    here = served(tmp_path, act)
    assert here.daemon.cycle.policy.name == "taught"
    kept = list((tmp_path / "state" / "policies").glob("*.json"))
    assert [path.read_bytes() for path in kept] == [(tmp_path / "taught.json").read_bytes()]


def test_rolling_back_takes_the_policy_before_and_keeps_that(tmp_path: Path) -> None:
    answers: list[PolicyReply] = []

    def act(station: Station, path: Path) -> None:
        answers.append(roll_back(station))
        push(station, path)
        answers.append(roll_back(station))

    here = served(tmp_path, act)
    nothing_before, back = answers
    assert not nothing_before.accepted and "no policy was active before" in nothing_before.reason
    assert back.accepted and back.name == here.daemon.job.policy.name == here.daemon.cycle.policy.name
    (kept,) = (tmp_path / "state" / "policies").glob("*.json")
    assert msgspec.json.decode(kept.read_bytes())["name"] == back.name


def test_another_robot_s_policy_does_not_even_leave(tmp_path: Path) -> None:
    def act(station: Station, path: Path) -> None:
        path.write_bytes(encode_policy(make_policy("a1")))
        with pytest.raises(PolicyError, match="this robot is"):
            push(station, path)

    assert served(tmp_path, act).daemon.cycle.generation == 1
