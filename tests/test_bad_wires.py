"""What can be wrong with a robot's wires before it ever moves: each is named, with where and what to do; no torque."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from test_hardware import STAND, Body

from drivers import can_channels, xbus_link
from drivers.bus import BusCounters
from drivers.errors import DriverError
from drivers.moteus_registers import Mode
from drivers.wiring import BusConfig
from sim.moteus_emulator import MoteusEmulator


def wrong_id(body: Body) -> None:
    body.bench.bus.servos[0, 14] = body.bench.bus.servos.pop((0, 13))
    body.bench.servos[2].id = 14


def two_on_one_id(body: Body) -> None:
    twin = MoteusEmulator(22)
    twin.position = body.bench.servos[4].position  # type: ignore[attr-defined]
    body.bench.bus.servos[1, 99] = twin


def already_in_a_fault(body: Body) -> None:
    body.bench.servos[8].fail(33)  # type: ignore[attr-defined]


def outside_its_range(body: Body) -> None:
    joints = STAND.copy()
    joints[3, 1] = 4.0
    body.place(joints)


def unplugged(body: Body) -> None:
    for place in [place for place in body.bench.bus.servos if place[0] == 2]:
        del body.bench.bus.servos[place]


@pytest.mark.parametrize(
    ("spoil", "found", "advice"),
    [
        (wrong_id, "FL knee (id 13, bus 1) does not answer", "supply, cable, id?"),
        (two_on_one_id, "FR hip (id 22, bus 2): two motors share this id", "give one another"),
        (already_in_a_fault, "BL knee (id 33, bus 3): fault 33: motor driver fault", "switch it off and on"),
        (outside_its_range, "BR hip reads 4.00 rad, its range is -0.93 to 1.79", "trotd commission"),
        (unplugged, "BL abduction (id 31, bus 3) does not answer", "supply, cable, id?"),
    ],
)
def test_a_daemon_does_not_start_on_it(spoil: Callable[[Body], None], found: str, advice: str) -> None:
    body = Body()
    spoil(body)
    with pytest.raises(DriverError) as caught:
        body.connect()
    (line, *_) = [line for line in str(caught.value).splitlines() if found in line]
    assert advice in line
    energised = {servo.mode for servo in body.bench.bus.servos.values()} - {Mode.STOPPED, Mode.FAULT}  # type: ignore[attr-defined]
    assert not energised


def test_a_reply_that_the_wire_doubled_is_not_a_second_motor() -> None:
    body = Body()
    doubled = [2]

    def once(reply: object) -> list[object]:
        doubled[0] -= 1
        return [reply, reply] if doubled[0] == 0 else [reply]

    body.bench.bus.fault = once  # type: ignore[assignment]
    body.connect()
    assert body.bench.motors.counters.duplicate == 1


@pytest.mark.parametrize(
    ("error", "advice"),
    [
        (PermissionError(1, "Operation not permitted"), "run with the rights to open it"),
        (PermissionError(13, "Permission denied"), "run with the rights to open it"),
        (OSError(19, "No such device"), "is the adapter plugged in and its interface up?"),
        (OSError(100, "Network is down"), "set the interface up"),
    ],
)
def test_a_bus_that_cannot_be_opened_says_which_and_why(monkeypatch: pytest.MonkeyPatch, error, advice) -> None:
    import can

    def refuse(**_: object) -> None:
        raise error

    monkeypatch.setattr(can, "Bus", refuse)
    config = BusConfig(backend="socketcan", channels=("can0", "can1"))
    with pytest.raises(DriverError) as caught:
        can_channels.open_channel(config, 1, BusCounters(), fd=True)
    assert f"bus 2 (socketcan can1): {error}; {advice}" in str(caught.value)


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (PermissionError(13, "Permission denied"), "Permission denied"),
        (FileNotFoundError(2, "No such file or directory"), "No such file"),
    ],
)
def test_a_serial_port_that_cannot_be_opened_says_which_and_why(monkeypatch: pytest.MonkeyPatch, error, words) -> None:
    import serial

    def refuse(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(serial, "Serial", refuse)
    with pytest.raises(DriverError, match=f"IMU port /dev/xsens: .*{words}.*plugged in. rights. \\(deploy/udev"):
        xbus_link.open_port("/dev/xsens", 921600)


def test_a_real_port_without_rights_is_refused_too(tmp_path: Path) -> None:
    port = tmp_path / "port"
    port.write_bytes(b"")
    with pytest.raises(DriverError, match=f"IMU port {port}"):
        xbus_link.open_port(str(port), 921600)


def test_everything_in_order_connects() -> None:
    body = Body()
    body.connect()
    assert body.bench.motors.joint_state().position == pytest.approx(STAND, abs=1e-4)
    assert body.bench.motors.doubled() == []
    asyncio.run(body.robot.close())
    assert np.isfinite(body.bench.motors.voltage)
