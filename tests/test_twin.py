"""The control cycle over emulated wires: it walks, its estimates hold, and every fault of the wire ends as promised."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from twin_walk import QUICK

from drivers.errors import DriverError
from drivers.robot import JOINTS, LEGS
from runtime import config
from runtime.messages.mode import Mode, Request
from runtime.reasons import Reason
from sim.build import Build, build_of, lab_build, scrambled
from sim.mit_emulator import MitEmulator
from trotd.lockstep import TwinWalk

COASTED_TICKS = 2


def test_it_walks_over_the_wires_and_knows_how_fast():
    walk = TwinWalk()
    walk.stand()
    assert walk.motors.counters.missed == 0
    walk.ask(Request.WALK)
    truth, estimate, height = [], [], []

    def note() -> None:
        tick = walk.cycle.tick[0]
        truth.append(walk.velocity[:2])
        estimate.append(tick["twist"][:2].copy())
        height.append(tick["height"] - walk.world.truth.position[2])

    walk.run(1.5, (0.8, 0.0, 0.0))
    walk.run(2.5, (0.8, 0.0, 0.0), note)
    assert walk.cycle.state.mode is Mode.WALK
    error = np.array(estimate) - np.array(truth)
    assert np.mean(truth, axis=0) == pytest.approx([0.8, 0.0], abs=0.1)
    assert np.sqrt((error**2).mean(axis=0)).max() <= 0.05
    assert np.sqrt(np.mean(np.square(height))) <= 0.01


@pytest.fixture
def standing() -> TwinWalk:
    walk = TwinWalk(QUICK)
    walk.stand()
    return walk


def reason(walk: TwinWalk) -> Reason:
    return walk.cycle.state.fault


def silence(walk: TwinWalk) -> None:
    walk.twin.servos[5].silent = True


def unplug(walk: TwinWalk) -> None:
    walk.twin.wire.faults.unplugged.add(2)


def unplug_all(walk: TwinWalk) -> None:
    walk.twin.wire.faults.unplugged.update(range(4))


def overheat(walk: TwinWalk) -> None:
    walk.twin.overheating[4] = 60.0


def encoder_fault(walk: TwinWalk) -> None:
    walk.twin.servos[1].fail(35)  # type: ignore[attr-defined]


def brown_out(walk: TwinWalk) -> None:
    for servo in walk.twin.servos[6:9]:
        servo.restart(shift=1 / 6)  # type: ignore[attr-defined]


def imu_gone(walk: TwinWalk) -> None:
    walk.lockstep_imu.emulator.silent = True


@pytest.mark.parametrize(
    ("fault", "ends_as", "ticks", "named"),
    [
        (silence, Reason.MOTOR_FAULT, COASTED_TICKS + 1, "FR knee"),
        (unplug, Reason.MOTOR_FAULT, COASTED_TICKS + 1, "BL"),
        (unplug_all, Reason.BODY_SILENT, COASTED_TICKS + 1, "no motor answered"),
        (overheat, Reason.MOTOR_FAULT, 3, "FR hip"),
        (encoder_fault, Reason.MOTOR_FAULT, 1, "FL hip"),
        (brown_out, Reason.MOTOR_FAULT, 2, "BL"),
    ],
)
def test_every_fault_ends_in_damp_in_time_and_is_named(
    standing: TwinWalk, fault: Callable[[TwinWalk], None], ends_as: Reason, ticks: int, named: str
):
    standing.cycle.events.clear()
    fault(standing)
    assert standing.ticks_to_damp() <= ticks
    assert reason(standing) is ends_as
    assert named in " ".join(event.text for event in standing.cycle.events)
    assert not standing.command.kp.any()
    assert not standing.command.torque.any()


def test_a_standing_robot_whose_imu_is_gone_sits_down(standing: TwinWalk):
    imu_gone(standing)
    for _ in range(8):
        standing.tick()
    state = standing.cycle.state
    assert state.mode is Mode.SIT_DOWN and state.fault is Reason.STALE_IMU
    for _ in range(1200):
        standing.tick()
        if standing.cycle.state.mode is Mode.DAMP:
            break
    assert standing.cycle.state.mode is Mode.DAMP and standing.cycle.state.reason is Reason.SAT_DOWN
    assert standing.cycle.state.fault is Reason.STALE_IMU


def test_two_missed_ticks_are_coasted_and_scattered_losses_do_not_matter(standing: TwinWalk):
    standing.twin.servos[5].silent = True
    standing.run(COASTED_TICKS / 200)
    standing.twin.servos[5].silent = False
    standing.twin.wire.faults.drop = 0.01
    standing.twin.wire.faults.duplicate = 0.02
    standing.ask(Request.WALK)
    standing.run(2.0, (0.4, 0.0, 0.0))
    assert standing.cycle.state.mode is Mode.WALK
    counters = standing.motors.counters
    assert counters.missed > 20
    assert counters.duplicate > 40
    assert not standing.world.fallen()


def test_the_watchdogs_hold_the_robot_down_when_the_computer_dies(standing: TwinWalk):
    for _ in range(60):
        standing.live()  # 0.3 s without a command
    assert {servo.mode for servo in standing.twin.servos} == {11}
    assert standing.ticks_to_damp() <= 2
    standing.run(1.5)
    standing.ask(Request.CLEAR)
    standing.run(0.1)
    standing.ask(Request.ARM, Request.STAND)
    standing.run(2.0)
    assert standing.cycle.state.mode is Mode.STAND


def test_the_twins_table_is_the_labs_in_another_form():
    motors = config.load(config.find_robot("stoch3")).motors
    assert motors is not None
    lab, ours = lab_build(), build_of(motors, (1.0, 0.0, 0.0, 0.0))
    joints = np.random.default_rng(0).uniform(-1, 1, (4, 3))
    assert lab.to_motor(joints) == pytest.approx(ours.to_motor(joints))
    assert lab.to_joint(lab.to_motor(joints)) == pytest.approx(joints)
    other = scrambled(lab, 7)
    assert sorted(other.id.ravel()) == sorted(lab.id.ravel())
    assert (other.id != lab.id).any()
    assert np.linalg.norm(other.mount) == pytest.approx(1.0)


@pytest.mark.parametrize("place", [0, 4, 8])
def test_a_stuck_encoder_is_found_in_a_walk_before_the_robot_falls(standing: TwinWalk, place: int):
    standing.ask(Request.WALK)
    standing.run(0.6, (0.4, 0.0, 0.0))
    standing.cycle.events.clear()
    standing.twin.servos[place].stuck_encoder = True  # type: ignore[attr-defined]
    assert standing.ticks_to_damp(velocity=(0.4, 0.0, 0.0)) <= 20
    assert not standing.world.fallen()
    assert reason(standing) in (Reason.STUCK_ENCODER, Reason.TORQUE_LOST, Reason.ASTRAY)
    assert f"{LEGS[place // 3]} {JOINTS[place % 3]}" in standing.faults[0]


def test_a_stuck_encoder_does_not_push_a_folded_leg_up(standing: TwinWalk):
    lying = TwinWalk(QUICK)
    lying.run(0.6)
    lying.twin.servos[8].stuck_encoder = True  # type: ignore[attr-defined]
    lying.ask(Request.ARM, Request.STAND)
    assert lying.ticks_to_damp(200) < 200
    assert lying.world.truth.position[2] < 0.5 * standing.world.truth.position[2]
    assert "BL knee" in lying.faults[0]


def wrong(joint: tuple[int, int], **factor: float) -> Build:
    """The lab's build, but one joint's number other than the driver believes."""
    build = lab_build()
    for name, value in factor.items():
        table = getattr(build, name).copy()
        table[joint] *= value
        build = replace(build, **{name: table})
    return build


@pytest.mark.parametrize("joint", [(0, 1), (0, 2), (1, 0)])
@pytest.mark.parametrize("factor", [{"direction": -1.0}, {"offset": -1.0}, {"gear": 3.0}])
def test_a_wrong_number_in_the_drivers_table_shows(joint: tuple[int, int], factor: dict[str, float]):
    """The twin turns as its own table says: were it the driver's, two wrongs would look right."""
    try:
        walk = TwinWalk(QUICK, build=wrong(joint, **factor))
    except DriverError as error:
        assert f"{LEGS[joint[0]]} {JOINTS[joint[1]]} reads" in str(error)
        return
    if abs(walk.measurement.joints.position - walk.world.truth.joint_position)[joint] > 0.1:
        return
    walk.run(0.6)  # folded, this motor stands where its joint's angle does not depend on the number: it has to move
    walk.ask(Request.ARM, Request.STAND)
    assert walk.ticks_to_damp(400) < 400
    assert walk.faults


def test_a_knob_of_a_mit_motor_holds_its_reading_and_its_law():
    motor = MitEmulator(1, "AK80-8")
    motor.sense(0.5, 1.0, 0.0, 30.0)
    motor.stuck_encoder = True
    motor.sense(0.9, 1.0, 0.0, 30.0)
    assert (motor.position, motor.velocity) == (0.5, 0.0)
