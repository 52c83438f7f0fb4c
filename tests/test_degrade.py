"""Taking back before giving up, on the simulator: what a robot that is not whole still does, and how it ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from walks import Walk

from drivers.robot import Measurement
from runtime.control.records import Clamp, VelocityCommand
from runtime.cycle import Cycle
from runtime.messages.mode import Mode, Request
from runtime.reasons import Reason
from sim.scenario import Scenario

Change = Callable[[Measurement, int], Measurement]


@pytest.fixture(scope="module")
def only(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Walk]:
    walk = Walk(tmp_path_factory.mktemp("recordings"))
    yield walk
    walk.world.close()


@pytest.fixture
def walk(only: Walk) -> Walk:
    """One world, a robot that stands."""
    only.world.__dict__.pop("step", None)
    only.measurement = only.world.reset(Scenario())
    only.cycle = Cycle(only.config, only.policy)
    only.cycle.warm_up(only.measurement)
    only.command, only.index = only.cycle.sources.damp, 0
    only.stand()
    only.run(0.3)
    return only


def spoil(walk: Walk, change: Change) -> None:
    """From now on the daemon reads something else than is."""
    real, count = type(walk.world).step, 0

    def step(command: object) -> Measurement:
        nonlocal count
        count += 1
        return change(real(walk.world, command), count)  # type: ignore[arg-type]

    walk.world.step = step  # type: ignore[method-assign]


def heat(celsius: float) -> Change:
    return lambda m, _n: replace(m, joints=replace(m.joints, temperature=np.full((4, 3), celsius)))


def no_imu(m: Measurement, _n: int) -> Measurement:
    return replace(m, imu=replace(m.imu, orientation=m.imu.orientation * np.nan))


def sinks(walk: Walk, seconds: float) -> tuple[float, float]:
    """The fastest that the body falls, m/s, and the furthest that it leans, rad."""
    fastest = furthest = 0.0
    for _ in range(round(seconds * 200)):
        walk.run(0.005)
        truth = walk.world.truth
        fastest = max(fastest, -float(truth.linear_velocity[2]))
        furthest = max(furthest, float(np.arccos(min(1.0, truth.rotation_body_to_world[2, 2]))))
    return fastest, furthest


def marks(walk: Walk) -> Clamp:
    return Clamp(int(walk.cycle.tick["clamps"][0]))


@pytest.mark.parametrize("why", ["asked", "operator lost"])
def test_a_fast_robot_slows_down_before_it_stands(walk: Walk, why: str) -> None:
    walk.ask(Request.WALK)
    walk.run(1.5, (0.8, 0.0, 0.0))
    if why == "asked":
        walk.ask(Request.STAND)
    else:
        walk.cycle.lose_operator(walk.measurement)
    walk.run(0.05, (0.8, 0.0, 0.0))
    assert walk.cycle.state.mode is Mode.WALK and marks(walk) & Clamp.STOPPING
    assert bool(marks(walk) & Clamp.DEADMAN) == (why == "operator lost")
    _, leant = sinks(walk, 3.0)
    assert walk.cycle.state.mode is Mode.STAND and leant < 0.4
    assert walk.cycle.state.reason is (Reason.STOPPED if why == "asked" else Reason.OPERATOR_LOST)
    assert np.abs(walk.world.truth.linear_velocity).max() < 0.05


def test_a_walking_robot_that_is_too_hot_stops_stands_and_sits(walk: Walk) -> None:
    walk.ask(Request.WALK)
    walk.run(1.5, (0.8, 0.0, 0.0))
    spoil(walk, heat(85.0))
    fastest, leant = sinks(walk, 6.0)
    state = walk.cycle.state
    assert state.mode is Mode.DAMP and state.reason is Reason.SAT_DOWN and state.fault is Reason.HOT_MOTOR
    assert fastest < 0.8 and leant < 0.4, "it sat down, it did not fall"


def test_a_standing_robot_without_imu_sits_down(walk: Walk) -> None:
    spoil(walk, no_imu)
    fastest, leant = sinks(walk, 5.0)
    state = walk.cycle.state
    assert state.mode is Mode.DAMP and state.reason is Reason.SAT_DOWN and state.fault is Reason.IMPLAUSIBLE_IMU
    assert fastest < 0.8 and leant < 0.2


def test_a_walking_robot_without_imu_folds_its_legs(walk: Walk) -> None:
    walk.ask(Request.WALK)
    walk.run(1.5, (0.8, 0.0, 0.0))
    spoil(walk, no_imu)
    walk.run(0.01)
    assert walk.cycle.state.mode is Mode.WALK and marks(walk) & Clamp.EXTRAPOLATED
    walk.run(0.005)
    assert walk.cycle.state.mode is Mode.SIT_DOWN and walk.cycle.state.fault is Reason.IMPLAUSIBLE_IMU
    peak = np.array(walk.config.robot.joints.peak_torque)
    gain = walk.config.posture.brace_gain
    for _ in range(400):
        walk.run(0.005)
        assert (walk.command.kp <= gain * 150.0 + 1e-9).all()
        assert (np.abs(walk.measurement.joints.torque) <= peak * (1 + 1e-9)).all()
    assert walk.cycle.state.mode is Mode.DAMP and walk.cycle.state.reason is Reason.SAT_DOWN
    assert not walk.command.kp.any()


def test_an_imu_that_misses_samples_is_carried_on(walk: Walk) -> None:
    walk.ask(Request.WALK)
    walk.run(0.5, (0.5, 0.0, 0.0))
    spoil(walk, lambda m, n: no_imu(m, n) if n % 10 < 2 else m)
    walk.run(3.0, (0.5, 0.0, 0.0))
    assert walk.cycle.state.mode is Mode.WALK
    assert abs(walk.world.truth.linear_velocity[0] - 0.5) < 0.15
    assert walk.cycle.clamps[list(Clamp).index(Clamp.EXTRAPOLATED)] >= 115


def test_warm_motors_slow_the_walk_and_bound_its_torque(walk: Walk) -> None:
    walk.ask(Request.WALK)
    spoil(walk, heat(75.0))
    walk.run(3.0, (0.8, 0.0, 0.0))
    assert walk.cycle.state.mode is Mode.WALK and marks(walk) & Clamp.SPEED
    assert walk.cycle.guard.speed_share == pytest.approx(0.75)
    assert walk.cycle.guard.torque_share == pytest.approx(0.8)
    assert walk.cycle.tick["velocity_command"][0, 0] < 0.75
    assert abs(walk.world.truth.linear_velocity[0] - 0.6) < 0.15


def test_a_robot_that_gives_up_while_standing_sinks_instead_of_dropping(walk: Walk) -> None:
    spoil(walk, lambda m, _n: replace(m, joints=replace(m.joints, fault=np.ones((4, 3), np.int32))))
    fastest, leant = sinks(walk, 2.0)
    assert walk.cycle.state.mode is Mode.DAMP and walk.cycle.state.fault is Reason.MOTOR_FAULT
    assert fastest < 1.0 and leant < 0.4, "with damp.kd alone it reaches 1.26 m/s"
    assert float(walk.command.kd.max()) == walk.config.damp.kd, "and the damping is the ordinary one in the end"


@pytest.mark.parametrize("seed", range(4))
def test_it_stands_up_again_from_wherever_it_fell(walk: Walk, seed: int) -> None:
    """Pushed over its side while it walks, down on its belly with the legs anywhere."""
    random = np.random.default_rng(seed)
    walk.ask(Request.DAMP)
    pose = walk.cycle.sources.posture.folded_joints + random.uniform(-0.5, 0.5, (4, 3))
    lower, upper = np.array(walk.config.robot.joints.lower), np.array(walk.config.robot.joints.upper)
    roll, pitch = random.uniform(-0.25, 0.25, 2).tolist()
    walk.measurement = walk.world.reset(Scenario(joint_position=np.clip(pose, lower, upper), rpy=(roll, pitch, 0.0)))
    walk.run(1.5)
    walk.ask(Request.ARM, Request.STAND)
    walk.until(lambda: walk.cycle.state.mode is Mode.STAND)
    walk.run(0.5)
    assert walk.cycle.state.mode is Mode.STAND and not walk.world.fallen(0.2)
    assert abs(walk.world.truth.position[2] - walk.config.control.gait.walking_height) < 0.05


def test_velocity_commands_during_a_stop_are_not_followed(walk: Walk) -> None:
    walk.ask(Request.WALK)
    walk.run(1.0, (0.6, 0.0, 0.0))
    walk.ask(Request.STAND)
    walk.cycle.command_velocity(VelocityCommand(walk.index / 200.0, np.array([0.8, 0.0]), 0.0))
    walk.run(0.005)
    assert not walk.cycle.tick["asked_velocity"].any()
