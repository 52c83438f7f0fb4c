"""Pushing policies: what is sent is what becomes active, what proved good survives; what cannot be does not leave."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import msgspec
import pytest
from daemons import Served, make_config, make_policy

from runtime.audition import Stage
from runtime.control.policy import Policy, encode_policy
from runtime.messages.mode import Request
from runtime.messages.policy import PolicyReply
from runtime.policies import PolicyError
from station.push import active, known, push, roll_back, send
from station.session import Station

Script = Callable[[Served], Awaitable[None]]


def serve(folder: Path, script: Script, simulated: bool = True) -> Served:
    async def play() -> Served:
        async with Served(make_config(), folder / "state", simulated=simulated) as here:
            await script(here)
            return here

    return asyncio.run(play())


def taught(served: Served, name: str = "taught") -> Policy:
    return msgspec.structs.replace(make_policy(served.config.robot.name), name=name)


async def sent(served: Served, name: str = "taught", immediate: bool = False, **changes: object) -> PolicyReply:
    policy = msgspec.structs.replace(taught(served, name), **changes)
    reply: PolicyReply = await served.client(lambda station: send(station, encode_policy(policy), immediate))
    return reply


def kept(folder: Path) -> list[str]:
    return [msgspec.json.decode(p.read_bytes())["name"] for p in (folder / "state" / "policies").glob("*.json")]


def test_what_is_pushed_in_damp_is_active_at_once_and_kept_once_it_has_walked(tmp_path: Path) -> None:
    async def script(served: Served) -> None:
        path = tmp_path / "taught.json"
        path.write_bytes(encode_policy(taught(served)))

        def act(station: Station) -> None:
            assert active(station)[0].name != "taught"
            reply = push(station, path)
            assert reply.accepted and reply.name == "taught" and "not proved" in reply.reason
            policy, digest = active(station)
            assert (policy.name, digest) == ("taught", reply.sha256)

        await served.client(act)
        assert not kept(tmp_path)
        await served.walk()
        await served.until(lambda: bool(kept(tmp_path)))

    assert serve(tmp_path, script).daemon.cycle.policy.name == "taught"
    assert kept(tmp_path) == ["taught"]


def test_a_standing_robot_shadows_blends_and_tells(tmp_path: Path) -> None:
    async def script(served: Served) -> None:
        await served.stand()
        reply = await sent(served)
        assert reply.accepted and "proved while standing" in reply.reason
        assert reply.report["ticks"] == 20 and reply.report["force"] == 0.0 and reply.report["shift"] == 0.0
        assert served.daemon.audition.stage is Stage.STOOD and not kept(tmp_path)
        assert served.daemon.take_request(Request.WALK).accepted
        await served.until(lambda: kept(tmp_path) == ["taught"])

    serve(tmp_path, script)


def test_a_second_one_waits_and_a_rollback_gives_the_first_up(tmp_path: Path) -> None:
    async def script(served: Served) -> None:
        await served.stand()
        first = asyncio.get_running_loop().create_task(sent(served, "first"))
        await served.until(lambda: served.daemon.audition.stage is Stage.SHADOW)
        second = await sent(served, "second")
        assert not second.accepted and "first is in shadow" in second.reason
        await served.until(lambda: served.daemon.audition.stage is Stage.TRIAL)
        back = await served.client(roll_back)
        assert back.accepted and back.name == "balance"
        assert not (await first).accepted

    served = serve(tmp_path, script)
    assert served.daemon.cycle.policy.name == "balance" and not kept(tmp_path)


def test_a_daemon_that_stops_in_the_shadow_tells_who_waits(tmp_path: Path) -> None:
    async def script(served: Served) -> None:
        await served.stand()
        waiting = asyncio.get_running_loop().create_task(sent(served))
        await served.until(lambda: served.daemon.audition.stage is Stage.SHADOW)
        served.daemon.stop()
        reply = await waiting
        assert not reply.accepted and reply.reason == "the daemon is stopping"

    assert serve(tmp_path, script).daemon.cycle.generation == 1


def test_rolling_back_takes_the_last_one_that_proved_good_and_keeps_that(tmp_path: Path) -> None:
    async def script(served: Served) -> None:
        nothing = await served.client(roll_back)
        assert not nothing.accepted and "no policy was active before" in nothing.reason
        await served.walk()
        for name in ("first", "second"):
            assert (await sent(served, name)).reason == "proved, kept"
        entries = await served.client(known)
        named = [(entry.role, entry.name) for entry in entries if entry.role != "shipped"]
        assert named == [("active", "second"), ("previous", "first"), ("good", "balance"), ("kept", "second")]
        assert (await served.client(roll_back)).name == "first"

    assert serve(tmp_path, script).daemon.cycle.policy.name == "first"
    assert kept(tmp_path) == ["first"]


def test_immediate_skips_the_waiting_but_no_check_and_is_not_for_robots(tmp_path: Path) -> None:
    async def script(served: Served) -> None:
        await served.walk()
        for number in range(3):  # each may follow before the one before has proved good
            reply = await sent(served, f"n{number}", immediate=True)
            assert reply.accepted and reply.reason == "active, on trial" and not reply.report
            await served.until(lambda: served.daemon.cycle.outgoing == 0)
        wild = make_policy().matrix
        wild = tuple(tuple(1e3 * value for value in row) for row in wild)
        refused = await sent(served, "wild", immediate=True, matrix=wild)
        assert not refused.accepted and "max_norm" in refused.reason

    serve(tmp_path, script)

    async def on_a_robot(served: Served) -> None:
        await served.walk()
        reply = await sent(served, immediate=True)
        assert not reply.accepted and "simulated" in reply.reason

    serve(tmp_path, on_a_robot, simulated=False)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rate_hz": 500.0}, "rate_hz = 500: this robot ticks at 200"),
        ({"layout": "0123"}, "layout = '0123'"),
        ({"robot": "a1"}, "this robot is"),
        ({"action_scale": (1e6,) * 18}, "times its bound"),
    ],
)
def test_the_robot_checks_the_manifest_itself(tmp_path: Path, changes: dict[str, object], words: str) -> None:
    async def script(served: Served) -> None:
        reply = await sent(served, **changes)
        assert not reply.accepted and words in reply.reason
        assert served.daemon.link.entrance.refused["policy"] == 1

    assert serve(tmp_path, script).daemon.cycle.generation == 1


def test_another_robot_s_policy_does_not_even_leave(tmp_path: Path) -> None:
    async def script(served: Served) -> None:
        path = tmp_path / "other.json"
        path.write_bytes(encode_policy(make_policy("a1")))

        def act(station: Station) -> None:
            with pytest.raises(PolicyError, match="this robot is"):
                push(station, path)

        await served.client(act)

    assert serve(tmp_path, script).daemon.cycle.generation == 1
