"""The robot over its own wires: real drivers, CAN frames over UDP, an IMU on a pseudo-terminal, noise on all of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from twin_walk import WireWalk

from runtime import config
from runtime.messages.mode import Mode, Request
from station.tour import Leg
from trotd.tour import take_tour


@pytest.fixture
def walk(tmp_path: Path) -> Iterator[WireWalk]:
    with WireWalk(tmp_path) as made:
        yield made


def test_it_walks_a_tour_over_the_wires(walk: WireWalk) -> None:
    walk.stand()
    walk.ask(Request.WALK)
    walk.run(1.0, (0.5, 0.0, 0.0))
    assert walk.mean_velocity(1.0, (0.5, 0.0, 0.0)) == pytest.approx((0.5, 0.0, 0.0), abs=0.1)
    walk.run(0.5, (0.0, 0.0, 0.8))
    assert walk.mean_velocity(1.0, (0.0, 0.0, 0.8)) == pytest.approx((0.0, 0.0, 0.8), abs=0.15)
    walk.world.push((0.0, 0.5 * walk.config.robot.mass / 0.1, 0.0), 0.1)
    walk.run(1.0, (0.0, 0.0, 0.0))
    assert walk.mean_velocity(0.5, (0.0, 0.0, 0.0))[:2] == pytest.approx((0.0, 0.0), abs=0.1)
    assert not walk.world.fallen()
    walk.ask(Request.STAND)
    walk.run(1.0)
    walk.ask(Request.SIT)
    walk.run(2.0)
    assert walk.cycle.state.mode is Mode.DAMP
    assert walk.faults == []
    assert walk.motors.counters.missed == 0
    assert walk.imu.counters.lost == walk.imu.counters.restarts == 0


WALKING = (0.4, 0.0, 0.0)
COASTED_TICKS = 2
STALE_TICKS = 8
"""0.03 s that an IMU's sample may be old, and the tick that sees it."""


def into_a_walk(walk: WireWalk) -> None:
    walk.stand()
    walk.ask(Request.WALK)
    walk.run(0.5, WALKING)
    assert walk.cycle.state.mode is Mode.WALK


def test_one_silent_motor_is_coasted_for_two_ticks_and_then_named(walk: WireWalk) -> None:
    into_a_walk(walk)
    walk.twin.servos[5].silent = True
    for _ in range(COASTED_TICKS):
        walk.tick(WALKING)
        assert walk.cycle.state.mode is Mode.WALK
    walk.tick(WALKING)
    assert walk.cycle.state.mode is Mode.DAMP
    assert not walk.command.kp.any()
    assert "FR knee" in walk.faults[0]
    assert walk.motors.counters.missed == COASTED_TICKS + 1


def test_lossy_and_late_wires_are_counted_and_walked_over(walk: WireWalk) -> None:
    into_a_walk(walk)
    faults, counters = walk.twin.wire.faults, walk.motors.counters
    faults.drop, faults.duplicate = 0.003, 0.02
    walk.run(0.5, WALKING)
    assert walk.cycle.state.mode is Mode.WALK
    assert counters.missed > 0 and counters.duplicate > 0
    faults.drop = faults.duplicate = 0.0
    before = counters.missed
    faults.delay = 0.01
    walk.run(0.05, WALKING)
    assert counters.missed == before, "later than usual, and still in their tick"
    faults.delay = 0.08
    walk.tick(WALKING)
    assert counters.missed == before + 12, "too late for their tick"
    faults.delay = 0.0
    walk.run(0.1, WALKING)
    assert walk.cycle.state.mode is Mode.WALK
    assert not walk.world.fallen()


def test_damaged_frames_of_a_motor_damp_or_are_survived_but_never_fell_the_daemon(walk: WireWalk) -> None:
    """Past a CAN controller's checksum no bit is wrong; a driver that is handed such a frame still has to cope."""
    walk.stand()
    walk.twin.wire.faults.corrupt = 1.0
    ticks = walk.ticks_to_damp()
    assert ticks <= COASTED_TICKS + 1
    assert walk.faults
    walk.twin.wire.faults.corrupt = 0.0
    walk.run(0.5)
    assert walk.cycle.state.mode is Mode.DAMP
    assert np.isfinite(walk.measurement.joints.position).all()


def test_an_unreliable_imu_cable_is_resynchronised_within_a_tick(walk: WireWalk) -> None:
    into_a_walk(walk)
    cable, counters = walk.wires.imu.faults, walk.imu.counters
    cable.split = 20
    walk.run(0.1, WALKING)
    assert cable.split == 0 and counters.lost == 0 and walk.imu.link.corrupt == 0
    cable.garbage, cable.corrupt, cable.lose = 2, 1, 1
    walk.run(0.1, WALKING)
    assert walk.imu.link.corrupt >= 1
    assert counters.lost >= 2, "the damaged one and the lost one"
    assert walk.cycle.state.mode is Mode.WALK
    assert walk.faults == [] and counters.restarts == 0


def test_an_imu_that_is_pulled_damps_and_put_back_walks_again(walk: WireWalk) -> None:
    into_a_walk(walk)
    walk.unplug()
    assert walk.ticks_to_leave(Mode.WALK, WALKING) <= STALE_TICKS
    assert walk.cycle.state.mode is Mode.SIT_DOWN, "the legs fold below it: they still answer"
    assert walk.ticks_to_damp(200) < 200
    assert "IMU" in walk.faults[0]
    walk.run(1.0)
    walk.plug_in()
    samples = walk.imu.counters.samples
    for _ in range(1000):
        walk.tick()
        if walk.imu.counters.samples > samples + 100:
            break
    assert walk.imu.counters.restarts >= 1
    walk.run(1.5)
    walk.ask(Request.CLEAR)
    walk.stand()


def test_an_imu_whose_line_overflows_damps_and_says_why(walk: WireWalk) -> None:
    into_a_walk(walk)
    walk.wires.imu.emulator.overflowing = True
    assert walk.ticks_to_leave(Mode.WALK, WALKING) <= STALE_TICKS
    assert walk.ticks_to_damp(200) < 200
    assert walk.imu.link.errors[41] >= 1


def test_it_walks_with_an_imu_that_gives_no_orientation(tmp_path: Path) -> None:
    with WireWalk(tmp_path, product="MTI-610") as walk:
        assert walk.imu.identity is not None and not walk.imu.identity.gives_orientation
        walk.stand()
        walk.ask(Request.WALK)
        walk.run(1.0, WALKING)
        assert walk.mean_velocity(1.0, WALKING) == pytest.approx(WALKING, abs=0.12)
        assert walk.faults == []


def test_daemon_and_twin_as_processes_walk_in_real_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What ``make run-wire`` does, over a shorter way."""
    legs = [
        Leg("forward", (0.4, 0.0, 0.0), 3.0),
        Leg("turn", (0.0, 0.0, 0.6), 3.0),
        Leg("push", (0.0, 0.0, 0.0), 3.0, 0.5),
    ]
    monkeypatch.setattr("station.tour.plan_tour", lambda _config: legs)
    path = config.find_robot("stoch3")
    loaded = config.load(path)
    arguments = ["--robot", str(path), "--rate-hz", str(loaded.control.rate_hz), "--state", str(tmp_path)]
    take_tour(loaded, arguments, as_json=True, wire=True)
    report = msgspec.json.decode(capsys.readouterr().out)
    assert report["problems"] == []
    assert [leg["falls"] for leg in report["legs"]] == [0, 0, 0]
    forward, turn, _ = (leg["measured"] for leg in report["legs"])
    assert forward[0] > 0.2 and turn[2] > 0.3
