"""Twelve motors on an in-process bus: units and signs, silence, strange frames, latches and restarts."""

from __future__ import annotations

import asyncio
import math

import numpy as np
import pytest
from bench_robot import DIRECTION, IDS, OFFSET, Bench, command, motors_config

from drivers.bus import Frame, InProcessBus
from drivers.moteus_registers import Mode
from drivers.motor_faults import NOT_STARTING, RESTARTED, START_TIME
from drivers.motors import Motors
from sim.moteus_emulator import REVOLUTION


def run(bench: Bench, *commands, seconds: float = 0.005) -> None:
    async def go() -> None:
        await bench.motors.open()
        for item in commands:
            bench.tick(seconds)
            await bench.motors.command(item)

    asyncio.run(go())


def test_joint_angles_follow_the_published_formula():
    bench = Bench()
    motor = np.linspace(-0.4, 0.5, 12)
    for servo, revolutions in zip(bench.servos, motor, strict=True):
        servo.position = revolutions
        servo.velocity = 0.1
        servo.torque = 2.0
    run(bench, command(kd=1.0))
    state = bench.motors.joint_state()
    direction = np.array(DIRECTION)
    wanted = direction * motor.reshape(4, 3) * 2 * math.pi - np.array(OFFSET)
    assert state.position == pytest.approx(wanted, abs=1e-6)
    assert state.velocity == pytest.approx(direction * 0.2 * math.pi, abs=1e-6)
    assert state.torque == pytest.approx(direction * 2.0)
    assert state.fault.tolist() == [[0] * 3] * 4
    assert bench.motors.voltage == 24.0


@pytest.mark.parametrize("protocol", [{}, {"protocol": "mit", "model": "AK80-8", "id": ((1, 2, 3),) * 4}])
def test_the_shaft_gets_the_law_that_the_joint_was_promised(protocol):
    """Torque at the joint, computed from the servos' own side, equals motor_torque at the joints' side."""
    gear = (1.0, 1.5, 1.36)
    bench = Bench(gear=gear, offset=((0.1, 0.2, -0.3),) * 4, **protocol)
    rng = np.random.default_rng(1)
    wanted = command(
        position=rng.uniform(-0.5, 0.5, (4, 3)),
        velocity=rng.uniform(-2, 2, (4, 3)),
        torque=rng.uniform(-5, 5, (4, 3)),
        kp=rng.uniform(20, 60, (4, 3)),
        kd=rng.uniform(0.5, 2, (4, 3)),
    )
    run(bench, command(kd=1.0), command(kd=1.0), wanted)
    joint_angle = rng.uniform(-0.5, 0.5, (4, 3))
    ratio = np.array(DIRECTION) * np.array(gear)
    shaft = ratio * (joint_angle + np.array(((0.1, 0.2, -0.3),) * 4))
    torque = np.zeros((4, 3))
    for place, drive in enumerate(bench.bus.drives().values()):
        leg, joint = divmod(place, 3)
        at_motor = drive.torque + drive.kp * (drive.position - shaft[leg, joint]) + drive.kd * drive.velocity
        torque[leg, joint] = at_motor * ratio[leg, joint]
    expected = wanted.torque + wanted.kp * (wanted.position - joint_angle) + wanted.kd * wanted.velocity
    assert torque == pytest.approx(expected, abs=0.35 if protocol else 1e-4)


def test_every_command_disarms_the_three_traps():
    bench = Bench()
    run(bench, command(kd=1.0))
    servo = bench.servos[0]
    assert servo._watchdog() == pytest.approx(0.1)
    servo.sense(0.0, 0.0, 0.0, 30.0)
    run(bench, command(kd=1.0, kp=10.0, position=1.5), command(kd=1.0, kp=10.0, position=1.5))
    target = DIRECTION[0][0] * (1.5 + OFFSET[0][0])
    assert servo.step(bench.clock()).position == pytest.approx(target, abs=1e-4)  # no planner in between


def test_a_silent_motor_is_named_and_its_age_grows_while_it_keeps_its_reading():
    bench = Bench()
    bench.servos[5].position = 0.25
    run(bench, command(kd=1.0), command(kd=1.0))
    before = bench.motors.joint_state()
    bench.servos[5].silent = True
    run(bench, *[command(kd=1.0)] * 3)
    state = bench.motors.joint_state()
    assert state.age[1, 2] == pytest.approx(0.015)
    assert np.delete(state.age.ravel(), 5).max() == pytest.approx(0.0)
    assert state.position[1, 2] == before.position[1, 2]
    assert bench.motors.counters.missed == 3
    assert [bench.motors.name(i) for i in bench.motors.silent(0.01)] == ["FR knee (id 23, bus 2)"]


def test_duplicates_strangers_and_damage_are_told_apart():
    bench = Bench()
    run(bench, command(kd=1.0))

    def fault(reply: Frame) -> list[Frame]:
        bus, identifier, data = reply
        if identifier >> 8 == 11:
            return [reply, reply]
        if identifier >> 8 == 12:
            return [(bus, 0x800B, data), reply]  # an echo of a command
        if identifier >> 8 == 13:
            return [(bus, identifier, b"\x21\x00\x0a\xff\xff")]
        return [(3, identifier, data)] if identifier >> 8 == 21 else [reply]  # 21 answers on a wrong bus

    bench.bus.fault = fault
    run(bench, command(kd=1.0))
    counters = bench.motors.counters
    assert (counters.duplicate, counters.foreign, counters.corrupt, counters.missed) == (1, 2, 1, 2)


def test_a_late_reply_is_used_with_its_true_age():
    bench = Bench()
    run(bench, command(kd=1.0))
    held: list[Frame] = []
    bench.bus.fault = lambda reply: held.append(reply) or [] if reply[1] >> 8 == 43 else [reply]
    bench.servos[11].position = 0.1
    run(bench, command(kd=1.0))
    sent_at = bench.clock()
    bench.clock.now += 0.004
    bench.motors._receive(*held[0])
    bench.clock.now += 0.001
    run(bench, command(kd=1.0), seconds=0.0)
    assert bench.motors.counters.late == 1
    assert bench.motors.joint_state().age[3, 2] == pytest.approx(bench.clock() - sent_at)
    assert bench.motors.joint_state().position[3, 2] == pytest.approx(0.1 * REVOLUTION - OFFSET[3][2], abs=1e-6)


def test_watchdog_latches_until_stop_then_ramps_from_nothing():
    bench = Bench()
    run(bench, command(kd=1.0), command(kd=1.0))
    bench.tick(0.2)
    assert {servo.mode for servo in bench.servos} == {Mode.TIMEOUT}
    run(bench, command(kd=1.0), command(kd=1.0))
    state = bench.motors.joint_state()
    assert (state.fault == int(Mode.TIMEOUT)).all()
    assert "watchdog" in bench.motors.describe_fault(state.fault[0, 0])

    async def recover() -> None:
        await bench.motors.open()
        await bench.motors.stop()
        assert bench.motors.modes == [Mode.STOPPED] * 12
        assert (bench.motors.joint_state().fault == 0).all()

    asyncio.run(recover())
    run(bench, *[command(kd=1.0)] * 3)
    assert bench.motors.modes == [Mode.POSITION] * 12
    assert (bench.motors.joint_state().fault == 0).all()


def test_a_fault_of_the_servo_comes_through_with_its_name_until_stopped():
    bench = Bench()
    run(bench, command(kd=1.0), command(kd=1.0))
    bench.servos[4].fail(38)
    run(bench, command(kd=1.0))
    state = bench.motors.joint_state()
    assert state.fault[1, 1] == 38
    assert np.count_nonzero(state.fault) == 1
    assert "over-temperature" in bench.motors.describe_fault(38)


def test_a_restarted_motor_is_a_fault_though_it_obeys_again():
    bench = Bench()
    run(bench, command(kd=1.0), command(kd=1.0))
    bench.motors.joint_state()
    bench.servos[7].restart(shift=1 / 6)
    run(bench, command(kd=1.0))
    assert bench.motors.joint_state().fault[2, 1] == RESTARTED
    run(bench, *[command(kd=1.0)] * 3)
    assert bench.servos[7].mode == Mode.POSITION
    assert bench.motors.joint_state().fault[2, 1] == RESTARTED
    assert "zero" in bench.motors.describe_fault(RESTARTED)


def test_a_motor_that_never_begins_is_a_fault_after_its_start_time():
    bench = Bench()
    run(bench, command(kd=1.0), command(kd=1.0))
    stuck = bench.servos[3]
    stuck.mode = Mode.STOPPED
    stuck._energise = lambda: None  # type: ignore[method-assign]
    bench.motors.reset()
    run(bench, command(kd=1.0))
    assert bench.motors.joint_state().fault[1, 0] == 0
    run(bench, command(kd=1.0), seconds=START_TIME + 0.01)
    assert bench.motors.joint_state().fault[1, 0] == NOT_STARTING


def test_start_outside_the_servos_own_limits_is_fault_39():
    bench = Bench()
    bench.servos[0].settings.position_max = 0.1
    bench.servos[0].position = 0.3
    run(bench, command(kd=1.0), command(kd=1.0))
    assert bench.motors.joint_state().fault[0, 0] == 39


def test_query_energises_nothing():
    bench = Bench()

    async def go() -> None:
        await bench.motors.open()
        await bench.motors.query()

    asyncio.run(go())
    assert bench.motors.silent(1.0) == []
    assert {servo.mode for servo in bench.servos} == {Mode.STOPPED}


def test_two_motors_with_one_id_on_one_bus_are_refused():
    ids = ((11, 12, 13), (21, 22, 23), (31, 32, 32), (41, 42, 43))
    with pytest.raises(ValueError, match="BL hip and BL knee both have id 32 on bus 3"):
        Motors(motors_config(id=ids), InProcessBus(lambda frame: []), 0.003)
    Motors(motors_config(id=((1, 2, 3),) * 4), InProcessBus(lambda frame: []), 0.003)


def test_a_command_that_is_not_finite_sends_nothing():
    bench = Bench()
    run(bench, command(kd=1.0))
    bench.bus.sent.clear()
    with pytest.raises(ValueError, match="motor 22"):
        run(bench, command(kd=[[1, 1, 1], [1, math.nan, 1], [1, 1, 1], [1, 1, 1]]))
    assert bench.bus.sent == []


@pytest.mark.parametrize("model", ["AK70-10", "DM8009"])
def test_mit_motors_are_enabled_before_they_are_commanded(model):
    bench = Bench(protocol="mit", model=model, id=((1, 2, 3),) * 4)
    run(bench, command(kd=1.0))
    assert all(servo.enabled for servo in bench.servos)
    assert {drive.kp for drive in bench.bus.drives().values()} == {0.0}
    run(bench, command(kd=1.0, kp=20.0))
    assert all(drive.kp == pytest.approx(20.0, abs=0.1) for drive in bench.bus.drives().values())
    bench.servos[2].fault = 10 if model == "DM8009" else 2
    run(bench, command(kd=1.0))
    fault = bench.motors.joint_state().fault
    assert np.count_nonzero(fault) == 1
    assert "over-current" in bench.motors.describe_fault(int(fault[0, 2]))


def test_ids_of_the_lab_are_used_as_they_are():
    bench = Bench()
    run(bench, command(kd=1.0))
    assert [identifier & 0x7F for _, identifier, _ in bench.bus.sent[:12]] == [i for leg in IDS for i in leg]
