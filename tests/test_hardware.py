"""The whole body over in-process emulators: one report at the start, ages in the loop, nothing energised by asking."""

from __future__ import annotations

import asyncio
import math

import numpy as np
import pytest
from bench_robot import OFFSET, Bench, command

from drivers.description import RobotDescription
from drivers.errors import BusTimeout, DriverError, NotConnected
from drivers.hardware import CLEAR_INTERVAL, HardwareRobot, build_bus
from drivers.moteus_registers import Mode
from drivers.motor_faults import RESTARTED
from drivers.robot import ImuSample, damp_command
from drivers.wiring import BusConfig
from runtime import config
from sim.moteus_emulator import REVOLUTION

STAND = np.array([[0.0, 0.75, -1.4]] * 4)


def description() -> RobotDescription:
    return config.load(config.find_robot("stoch3")).robot


class StillImu:
    """An IMU that lies on a table, or refuses."""

    def __init__(self, refusal: str = "") -> None:
        self.refusal, self.closed = refusal, False

    async def connect(self) -> None:
        if self.refusal:
            raise DriverError(self.refusal)

    def latest(self) -> ImuSample:
        return ImuSample(100.0, np.array([1.0, 0, 0, 0]), np.zeros(3), np.array([0.0, 0.0, 9.81]))

    async def close(self) -> None:
        self.closed = True

    def troubles(self) -> dict[str, int]:
        return {"IMU samples lost": 0, "IMU restarts": 2}


class Body:
    """A robot whose legs stand at ``STAND``."""

    def __init__(self, observe: bool = False, refusal: str = "") -> None:
        self.bench = Bench()
        self.place(STAND)
        self.imu = StillImu(refusal)
        self.robot = HardwareRobot(
            description(), self.bench.motors, self.imu, observe=observe, clock=self.wait_a_little
        )

    def wait_a_little(self) -> float:
        self.bench.clock.now += 1e-6
        return self.bench.clock.now

    def place(self, joints: np.ndarray) -> None:
        direction = np.array(self.bench.motors.config.direction)
        for servo, angle in zip(self.bench.servos, (direction * (joints + np.array(OFFSET))).ravel(), strict=True):
            servo.position = angle / REVOLUTION

    def run(self, *commands, seconds: float = 0.005):
        async def go():
            measurement = None
            for item in commands:
                self.bench.tick(seconds)
                measurement = await self.robot.exchange(item)
            return measurement

        return asyncio.run(go())

    def connect(self) -> None:
        asyncio.run(self.robot.connect())


DAMP = damp_command(2.0)


def test_it_connects_without_energising_and_measures():
    body = Body()
    body.connect()
    assert {servo.mode for servo in body.bench.servos} == {Mode.STOPPED}
    measurement = body.run(DAMP, DAMP)
    assert measurement.joints.position == pytest.approx(STAND, abs=1e-4)
    assert measurement.voltage == 24.0
    assert measurement.joints.age.max() < 1e-3
    assert {servo.mode for servo in body.bench.servos} == {Mode.POSITION}
    asyncio.run(body.robot.close())
    assert {servo.mode for servo in body.bench.servos} == {Mode.STOPPED}


def test_everything_that_is_wrong_is_in_one_report():
    body = Body(refusal="IMU port /dev/xsens: no such device")
    body.bench.servos[5].silent = True
    body.bench.servos[8].fail(40)
    joints = STAND.copy()
    joints[3, 1] = 4.0
    body.place(joints)
    with pytest.raises(DriverError) as caught:
        body.connect()
    report = str(caught.value)
    assert "FR knee (id 23, bus 2) does not answer" in report
    assert "BL knee (id 33, bus 3): fault 40: under-voltage" in report
    assert "BR hip reads 4.00 rad" in report
    assert "/dev/xsens" in report
    assert body.imu.closed
    assert all(servo.mode in (Mode.STOPPED, Mode.FAULT) for servo in body.bench.servos)


def test_servos_left_latched_by_a_dead_daemon_are_stopped_first():
    body = Body()
    body.connect()
    body.run(DAMP, DAMP)
    body.bench.tick(0.3)
    assert {servo.mode for servo in body.bench.servos} == {Mode.TIMEOUT}
    second = HardwareRobot(description(), body.bench.motors, body.imu, clock=body.wait_a_little)
    asyncio.run(second.connect())
    assert {servo.mode for servo in body.bench.servos} == {Mode.STOPPED}


def test_observing_never_energises_whatever_is_asked():
    body = Body(observe=True)
    body.connect()
    body.bench.bus.sent.clear()
    measurement = body.run(*[command(kp=100.0, kd=3.0, torque=5.0)] * 5)
    assert measurement.joints.position == pytest.approx(STAND, abs=1e-4)
    asyncio.run(body.robot.close())
    assert {servo.mode for servo in body.bench.servos} == {Mode.STOPPED}
    assert {data for _, _, data in body.bench.bus.sent} == {body.bench.motors.codec.query[0]}


def test_one_silent_motor_ages_by_a_tick_a_tick():
    body = Body()
    body.connect()
    body.run(DAMP, DAMP)
    body.bench.servos[2].silent = True
    ages = [body.run(DAMP).joints.age[0, 2] for _ in range(3)]
    assert ages == pytest.approx([0.005, 0.010, 0.015], abs=1e-4)


def test_what_went_wrong_on_the_wires_is_counted_by_its_name():
    body = Body()
    body.connect()
    body.run(DAMP)
    assert body.robot.troubles == {"IMU restarts": 2}
    body.bench.servos[5].silent = True
    body.run(DAMP, DAMP)
    assert body.robot.troubles == {"IMU restarts": 2, "replies missed": 2}


def test_all_silent_for_longer_than_coasting_is_a_bus_timeout_and_not_the_end():
    body = Body()
    body.connect()
    body.run(DAMP, DAMP)
    for servo in body.bench.servos:
        servo.silent = True
    assert [body.run(DAMP).joints.age.min() for _ in range(2)] == pytest.approx([0.005, 0.010], abs=1e-4)
    with pytest.raises(BusTimeout, match="no motor answered for 15 ms"):
        body.run(DAMP)
    for servo in body.bench.servos:
        servo.silent = False
    assert body.run(DAMP).joints.age.max() < 1e-3


def test_latched_motors_come_back_while_damping_and_only_then():
    body = Body()
    body.connect()
    body.run(DAMP, DAMP)
    body.bench.servos[4].fail(38)
    stiff = command(kp=50.0, kd=2.0, position=STAND)
    for _ in range(5):
        assert body.run(stiff).joints.fault[1, 1] == 38
    body.run(DAMP, DAMP, DAMP, DAMP)
    assert body.bench.servos[4].mode == Mode.POSITION
    assert body.run(DAMP).joints.fault[1, 1] == 0
    assert body.robot.cleared == 1
    body.bench.servos[4].fail(38)
    body.run(*[DAMP] * 10)
    assert body.robot.cleared == 1  # not all the time
    body.run(DAMP, seconds=CLEAR_INTERVAL)
    assert body.robot.cleared == 2


def test_a_restarted_motor_stays_a_fault_until_connected_anew():
    body = Body()
    body.connect()
    body.run(DAMP, DAMP)
    body.bench.servos[1].restart(shift=0.5)
    assert body.run(DAMP).joints.fault[0, 1] == RESTARTED
    body.bench.tick(CLEAR_INTERVAL)
    assert body.run(*[DAMP] * 5).joints.fault[0, 1] == RESTARTED
    with pytest.raises(DriverError, match="FL hip reads"):
        body.connect()  # its zero is half a turn off


def test_not_connected_and_not_finite():
    body = Body()
    with pytest.raises(NotConnected):
        body.run(DAMP)
    body.connect()
    with pytest.raises(ValueError, match="motor 11"):
        body.run(command(kd=math.nan))


def test_a_bus_that_the_motors_need_must_be_named():
    config = BusConfig(backend="udp_multicast", channels=("239.74.163.2", "239.74.163.3"))
    with pytest.raises(ValueError, match="bus 4"):
        build_bus(config, Bench().motors.config)
