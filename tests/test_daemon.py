"""The service whole, on a body that remembers: every way out damps, nothing moves unasked, one daemon a robot."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from daemons import PATIENCE, Probe, Served, is_damp, make_config, make_policy, until

from drivers.errors import BusTimeout, DriverError
from drivers.robot import Measurement
from runtime.control.policy import encode_policy
from runtime.link import LinkError
from runtime.messages.event import Event
from runtime.messages.mode import Mode, ModeReply, Request
from runtime.messages.policy import PolicyReply
from runtime.messages.recording import RecordingReply
from runtime.messages.status import Status
from runtime.recording import load
from runtime.state import AlreadyRunning, lock, state_folder
from runtime.systemd import Notifier
from station.session import Station


def serve(tmp_path: Path, act: Callable[[Served], object], made: object = None) -> Served:
    """Run ``act`` (a coroutine function of the served daemon) beside a daemon, to its end."""

    async def main() -> Served:
        served = Served(made or make_config(), tmp_path)  # type: ignore[arg-type]
        async with served:
            await act(served)  # type: ignore[misc]
        return served

    return asyncio.run(main())


def ended_in_damp(body: Probe) -> bool:
    return len(body.commands) >= 3 and all(is_damp(command) for command in body.commands[-3:]) and body.closed


def test_start_never_moves_the_robot(tmp_path: Path) -> None:
    async def act(served: Served) -> None:
        await served.ticks(25)

    served = serve(tmp_path, act)
    assert len(served.body.commands) > 20
    assert all(is_damp(command) for command in served.body.commands)
    assert ended_in_damp(served.body)


def test_refused_requests_carry_reasons_and_move_nothing(tmp_path: Path) -> None:
    async def act(served: Served) -> None:
        for word, why in (("stand", "arm first"), ("walk", "stand first"), ("sit", "stand first"), ("dance", "one of")):
            reply = await served.ask(word)
            assert not reply.accepted and why in reply.reason and reply.mode == "DAMP"
        await served.ticks(10)
        assert all(is_damp(command) for command in served.body.commands)

    serve(tmp_path, act)


def test_arming_says_what_speaks_against_it(tmp_path: Path) -> None:
    async def act(served: Served) -> None:
        hot = np.full((4, 3), 70.0)
        served.body.change = lambda m: replace(m, joints=replace(m.joints, temperature=hot))
        await served.ticks(3)
        reply = await served.ask("arm")
        assert not reply.accepted and "70 °C, bound 65" in reply.reason

    serve(tmp_path, act)


def test_a_client_arms_stands_walks_and_sits(tmp_path: Path) -> None:
    seen: list[Status] = []

    async def act(served: Served) -> None:
        for word, mode in (("arm", Mode.DAMP), ("stand", Mode.STAND), ("walk", Mode.WALK)):
            assert (await served.ask(word)).accepted
            await served.reach(mode)

        def drive(station: Station) -> None:
            station.session.put(station.keys.velocity, b'{"linear": [0.3, 0.0], "yaw_rate": 0.1}')
            seen.append(station.next_status())

        await served.client(drive)
        assert (await served.ask("stand")).accepted
        async with asyncio.timeout(PATIENCE):
            while not (await served.ask("sit")).accepted:  # noqa: ASYNC110
                await asyncio.sleep(0.05)
        await served.reach(Mode.DAMP)

    served = serve(tmp_path, act)
    assert seen[0].mode == "WALK" and seen[0].robot == served.config.robot.name
    assert not all(is_damp(command) for command in served.body.commands)
    assert ended_in_damp(served.body)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_in_the_middle_of_a_walk_ends_in_damp(tmp_path: Path, number: signal.Signals) -> None:
    async def act(served: Served) -> None:
        await served.walk()
        assert not is_damp(served.body.commands[-1])
        os.kill(os.getpid(), number)
        await served.task

    assert ended_in_damp(serve(tmp_path, act).body)


def test_an_exception_inside_the_tick_ends_in_damp(tmp_path: Path) -> None:
    async def main() -> Probe:
        served = Served(make_config(), tmp_path)
        async with served:
            await served.walk()

            def fail(*_: object) -> None:
                raise ZeroDivisionError("injected")

            served.daemon.cycle.step = fail  # type: ignore[assignment, method-assign]
            with pytest.raises(ExceptionGroup) as caught:
                await served.task
            assert caught.group_contains(ZeroDivisionError, match="injected")
        return served.body

    assert ended_in_damp(asyncio.run(main()))


def test_an_exception_in_the_link_ends_in_damp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def main() -> Probe:
        served = Served(make_config(), tmp_path)
        async with served:
            await served.walk()
            monkeypatch.setattr(served.daemon.link, "_send_batch", lambda: 1 / 0)
            with pytest.raises(ExceptionGroup):
                await served.task
        return served.body

    assert ended_in_damp(asyncio.run(main()))


def test_cancelling_the_daemon_ends_in_damp(tmp_path: Path) -> None:
    async def act(served: Served) -> None:
        await served.walk()
        served.task.cancel()
        await asyncio.wait([served.task])
        assert served.task.cancelled()

    assert ended_in_damp(serve(tmp_path, act).body)


def test_a_bus_that_falls_silent_damps_and_comes_back(tmp_path: Path) -> None:
    async def act(served: Served) -> None:
        await served.walk()

        def silence(_body: Probe) -> None:
            raise BusTimeout("injected silence")

        served.body.before = silence
        await served.reach(Mode.DAMP)
        assert "does not answer" in served.daemon.status().fault
        served.body.before = lambda _body: None
        await served.ticks(3)
        assert not (await served.ask("arm")).accepted
        assert (await served.ask("clear")).accepted
        assert (await served.ask("arm")).accepted

    assert ended_in_damp(serve(tmp_path, act).body)


def test_a_body_that_never_answers_does_not_hold_up_the_stop(tmp_path: Path) -> None:
    async def act(served: Served) -> None:
        await served.walk()

        def silence(_body: Probe) -> None:
            raise BusTimeout("injected silence")

        served.body.before = silence

    served = serve(tmp_path, act)
    assert served.body.closed
    assert all(is_damp(command) for command in served.body.commands[-5:])


def test_a_body_that_cannot_be_reached_ends_the_start(tmp_path: Path) -> None:
    class Dead(Probe):
        async def connect(self) -> None:
            raise DriverError("FL knee: no reply")

    async def main() -> None:
        made = make_config()
        served = Served(made, tmp_path, Dead(made))
        with pytest.raises(DriverError, match="FL knee"):
            async with served:
                pass
        assert served.body.closed

    asyncio.run(main())


def test_a_fault_is_recorded_with_all_that_a_replay_needs(tmp_path: Path) -> None:
    async def act(served: Served) -> None:
        await served.walk()

        def break_motor(measurement: Measurement) -> Measurement:
            fault = measurement.joints.fault.copy()
            fault[2, 1] = 7
            return replace(measurement, joints=replace(measurement.joints, fault=fault))

        served.body.change = break_motor
        await served.reach(Mode.DAMP)
        await served.until(lambda: bool(served.daemon.flight.written))

    served = serve(tmp_path, act)
    recording = load(served.daemon.flight.written[0])
    header, ticks = recording.header, recording.ticks
    assert header.reason == "fault"
    assert any("BL hip: a motor reports a fault (code 7)" in event.text for event in header.events)
    assert header.robot_toml == "# test" and header.rate_hz == served.config.control.rate_hz
    assert json.loads(header.policy)["name"] == "balance"
    assert {"trotd", "numpy", "numba", "python"} <= set(header.versions)
    faulty = ticks[ticks["joint_fault"][:, 2, 1] == 7]
    assert len(faulty) >= 2, "it ran on after the fault"
    assert (faulty["mode"] == Mode.DAMP).all() and not faulty["command_kp"].any()
    assert (ticks["mode"] == Mode.WALK).any()
    assert load(served.daemon.flight.written[-1]).header.reason == "stop"


def test_a_recording_is_written_when_asked_for(tmp_path: Path) -> None:
    async def act(served: Served) -> None:
        reply = await served.client(
            lambda station: station.ask_for(RecordingReply, station.keys.recording, parameters="write")
        )
        assert reply.accepted
        assert load(Path(reply.path)).header.reason == "asked for"

    serve(tmp_path, act)


def test_a_policy_survives_a_restart_and_a_spoilt_one_is_left(tmp_path: Path) -> None:
    made = make_config()
    candidate = msgspec.structs.replace(make_policy(made.robot.name), name="candidate")

    async def send(served: Served) -> None:
        reply = await served.client(
            lambda station: station.ask_for(PolicyReply, station.keys.policy, encode_policy(candidate))
        )
        assert reply.accepted

    async def prove(served: Served) -> None:
        await send(served)
        await served.walk()
        await served.until(lambda: served.daemon.audition.stage is None)

    async def look(served: Served) -> None:
        names.append(served.daemon.cycle.policy.name)

    names: list[str] = []
    serve(tmp_path, send, made)
    serve(tmp_path, look, made)
    serve(tmp_path, prove, made)
    serve(tmp_path, look, made)
    (tmp_path / "policies" / f"{made.robot.name}.json").write_bytes(b'{"format": 1')
    serve(tmp_path, look, made)
    assert names == ["balance", "candidate", "balance"], "only what has walked is kept"


def test_two_daemons_for_one_robot(tmp_path: Path) -> None:
    made = make_config()

    async def act(served: Served) -> None:
        second = Served(made, tmp_path)
        with pytest.raises(AlreadyRunning, match=f"robot '{made.robot.name}' is served by process {os.getpid()}"):
            async with second:
                pass
        assert not second.body.commands, "it touched the body of the first"
        assert (await served.ask("damp")).accepted

    serve(tmp_path, act, made)


def test_a_port_in_use_is_one_line_and_damps(tmp_path: Path) -> None:
    made = make_config()
    host, port = made.link.listen[0].removeprefix("tcp/").split(":")

    async def main() -> Probe:
        served = Served(made, tmp_path)
        with pytest.raises(LinkError, match=rf"^link endpoint '{made.link.listen[0]}': address already in use$"):
            async with served:
                pass
        return served.body

    with socket.socket() as taken:
        taken.bind((host, int(port)))
        taken.listen()
        body = asyncio.run(main())
    assert ended_in_damp(body)


def test_an_operator_that_goes_away_stops_the_walk(tmp_path: Path) -> None:
    async def act(served: Served) -> None:
        await served.walk()

        def come_and_go(station: Station) -> None:
            token = station.session.liveliness().declare_token(f"{station.keys.operator}/me")
            station.session.put(station.keys.velocity, b'{"linear": [0.1, 0.0], "yaw_rate": 0.0}')
            token.undeclare()

        await served.client(come_and_go)
        await served.reach(Mode.STAND)  # the command itself is believed for ten minutes
        await until(lambda: any("operator is gone" in event.text for event in served.daemon.link.history))
        assert served.daemon.cycle.state.mode is Mode.STAND and not served.daemon.status().fault

    assert ended_in_damp(serve(tmp_path, act).body)


def test_overruns_are_told(tmp_path: Path) -> None:
    import time

    async def act(served: Served) -> None:
        served.body.before = lambda _body: time.sleep(0.012)
        await served.until(lambda: served.daemon.status().overruns >= 5)

    served = serve(tmp_path, act)
    assert served.daemon.status().overruns >= 5 and ended_in_damp(served.body)


def test_the_watchdog_is_fed_by_the_tick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "100000")
        heard: list[str] = []

        async def act(served: Served) -> None:
            await served.ticks(60)  # six times what the watchdog is fed after

        serve(tmp_path, act)
        while True:
            try:
                heard.append(manager.recv(100).decode())
            except BlockingIOError:
                break
    assert heard[0] == "READY=1"
    assert heard[-1] == "STOPPING=1"
    assert heard.count("WATCHDOG=1") >= 3


def test_a_notifier_speaks_to_its_manager_and_outlives_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = str(tmp_path / "manager")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(path)
        manager.settimeout(PATIENCE)
        monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
        nobodys = Notifier()
        nobodys.tell("READY=1")
        monkeypatch.setenv("NOTIFY_SOCKET", path)
        notifier = Notifier()
        notifier.tell("WATCHDOG=1")
        assert manager.recv(100) == b"WATCHDOG=1", "what was told without a manager went nowhere"
    notifier.tell("WATCHDOG=1")
    (tmp_path / "manager").unlink()
    notifier.tell("STOPPING=1")
    for one in (nobodys, notifier):
        one.close()


def test_the_state_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/trotd")
    assert state_folder() == Path("/var/lib/trotd")
    monkeypatch.delenv("STATE_DIRECTORY")
    monkeypatch.setenv("XDG_STATE_HOME", "/x")
    assert state_folder() == Path("/x/trotd")


def test_the_lock_is_free_again_after_the_holder(tmp_path: Path) -> None:
    with lock(tmp_path, "r"), pytest.raises(AlreadyRunning), lock(tmp_path, "r"):
        pass
    with lock(tmp_path, "r"):
        pass


def test_events_of_a_whole_run_are_in_the_recording(tmp_path: Path) -> None:
    async def act(served: Served) -> None:
        await served.stand()
        assert isinstance(served.daemon.take_request(Request.DAMP), ModeReply)

    served = serve(tmp_path, act)
    texts = [event.text for event in load(served.daemon.flight.written[-1]).header.events if isinstance(event, Event)]
    assert "DAMP -> STAND_UP: asked for" in texts
    assert "STAND -> DAMP: asked for" in texts
