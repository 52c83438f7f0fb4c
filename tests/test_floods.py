"""Bad input on every key, floods, giants, readers that do not read: refused or shed, and counted; the walk goes on."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

import zenoh
from daemons import PATIENCE, Served, make_config
from hypothesis import given
from hypothesis import strategies as st

from runtime.doors.crossing import REPEAT_TIME
from runtime.doors.velocity import SHED
from runtime.messages.decoding import MessageError
from runtime.messages.mode import Mode, decode_request
from runtime.messages.motion import decode_pose, decode_velocity
from runtime.messages.tuning import decode_tuning
from station.session import Station

Script = Callable[[Served], Awaitable[None]]
GARBAGE = (b"\xff", b"{", b"null", b"[]", b"{}", b'{"linear": 3}', b'{"a": ' * 2000, bytes(300), b"\x00")


def serve(folder: Path, script: Script, **changes: object) -> Served:
    async def play() -> Served:
        async with Served(make_config(**changes), folder) as here:
            await here.walk()
            await script(here)
            assert here.daemon.cycle.state.mode is Mode.WALK, here.daemon.cycle.state
            return here

    return asyncio.run(play())


def test_garbage_on_every_key_is_refused_counted_and_walked_through(tmp_path: Path) -> None:
    def throw(station: Station) -> None:
        keys = station.keys
        for data in GARBAGE:
            for key in (keys.velocity, keys.pose):
                station.session.put(key, data)
            for key in (keys.mode, keys.change_tuning, keys.policy):
                with_reply = json.loads(station.ask(key, data))
                assert with_reply["accepted"] is False and with_reply["reason"]
            for key in (keys.tick_schema, keys.event, keys.recording, keys.policies, keys.tuning):
                assert station.ask(key, data), "these take no payload"
            for key in (keys.status, keys.tick, f"{keys.root}/nothing", keys.alive):
                station.session.put(key, data)  # nobody at the robot listens there
            station.session.delete(keys.velocity)

    async def script(served: Served) -> None:
        refused, began = served.daemon.link.entrance.refused, time.monotonic()
        await served.client(throw)
        await served.until(
            lambda: refused["command/velocity"] >= len(GARBAGE) and refused["command/pose"] >= len(GARBAGE)
        )
        assert all(refused[key] == len(GARBAGE) for key in ("command/mode", "command/tuning", "policy"))
        assert served.daemon.status().refused["policy"] == len(GARBAGE)
        events = [event.text for event in served.daemon.link.history if event.kind == "refused"]
        seconds = (time.monotonic() - began) / REPEAT_TIME
        assert len(events) <= 5 * (seconds + 1.0), "the same refusal is told once a second"

    serve(tmp_path, script)


@given(st.binary(max_size=200))
def test_no_bytes_get_past_a_decoder_but_with_a_reason(data: bytes) -> None:
    for decode in (decode_request, decode_tuning, decode_pose, lambda d: decode_velocity(d, (1.0, 1.0), 1.0)):
        try:
            decode(data)
        except MessageError as error:
            assert str(error)


def test_a_giant_is_refused_unread_and_a_greater_one_does_not_even_arrive(tmp_path: Path) -> None:
    def throw(station: Station) -> None:
        for size in (100_000, 5_000_000):
            station.session.put(station.keys.velocity, bytes(size))
            assert "at most" in json.loads(station.ask(station.keys.mode, bytes(size)))["reason"]
        station.session.put(station.keys.velocity, bytes(20_000_000))

    async def script(served: Served) -> None:
        refused = served.daemon.link.entrance.refused
        await served.client(throw)
        await served.until(lambda: refused["command/velocity"] == 2)
        await served.client(lambda station: station.next_status())

    serve(tmp_path, script)


def test_thousands_of_commands_cost_the_loop_one_each_tick(tmp_path: Path) -> None:
    taken = 0

    def flood(station: Station) -> None:
        publisher = station.session.declare_publisher(
            station.keys.velocity, congestion_control=zenoh.CongestionControl.BLOCK
        )
        for number in range(5000):
            publisher.put(json.dumps({"linear": [number * 1e-5, 0.0], "yaw_rate": 0.0}))

    async def script(served: Served) -> None:
        nonlocal taken
        take = served.daemon.take_velocity

        def count(command: object) -> None:
            nonlocal taken
            taken += 1
            take(command)  # type: ignore[arg-type]

        served.daemon.take_velocity = count  # type: ignore[method-assign, assignment]
        await served.client(flood)
        shed = served.daemon.link.entrance.refused
        await served.until(lambda: taken + shed[SHED] == 5000)
        await served.until(lambda: served.daemon.cycle.tick["asked_velocity"][0, 0] == 4999 * 1e-5)

    served = serve(tmp_path, script, command__expiry=600.0)
    assert 0 < taken <= 5000 and taken + served.daemon.link.entrance.refused[SHED] == 5000


READER = """
import sys, time
from station.session import connected
from station.ticks import TickStream
with connected(sys.argv[1], sys.argv[2]) as station, TickStream(station) as ticks:
    while not len(ticks.take()):
        time.sleep(0.01)
    print("reading", flush=True)
    while True:
        ticks.take()
        time.sleep(0.05)
"""


def test_a_reader_that_is_stopped_holds_up_neither_ticks_nor_events_nor_memory(tmp_path: Path) -> None:
    async def script(served: Served) -> None:
        made, daemon = served.config, served.daemon
        command = [sys.executable, "-c", READER, made.robot.name, made.link.listen[0]]
        reader = await asyncio.to_thread(subprocess.Popen, command, stdout=subprocess.PIPE)
        try:
            assert reader.stdout is not None
            assert await asyncio.to_thread(reader.stdout.readline) == b"reading\n"
            reader.send_signal(signal.SIGSTOP)
            first, used = daemon.cycle.tick["index"][0], _resident()
            sent = 0
            end = time.monotonic() + PATIENCE
            while sent < 60_000_000 and time.monotonic() < end:  # far more than any socket takes
                for _ in range(200):
                    daemon.link.offer(daemon.cycle.tick)
                    sent += daemon.cycle.tick.nbytes
                    if not daemon.link._filled:
                        daemon.link._send_batch()
                daemon.refuse("test", "an event")
                await asyncio.sleep(0.005)
            assert sent >= 60_000_000
            assert _resident() - used < 40_000_000
            last = daemon.cycle.tick["index"][0]
            await served.until(lambda: daemon.cycle.tick["index"][0] > last + 20)
            assert last > first
            await served.client(lambda station: station.next_status())  # others are served as before
        finally:
            reader.kill()
            reader.wait()
            reader.stdout.close()  # type: ignore[union-attr]

    serve(tmp_path, script)


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")
