"""The guard against injected faults: every one is named, placed and leads to damp; torque never passes the peak."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from daemons import make_config
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.robot import JointCommand, JointState, motor_torque
from runtime.control.records import Clamp, Records
from runtime.guard import Guard, tilt
from runtime.messages.mode import Mode
from runtime.messages.tick import TICK_DTYPE
from runtime.parameters import LimitsConfig
from runtime.reasons import Reason

CONFIG = make_config()
PEAK = np.array(CONFIG.robot.joints.peak_torque)


def make_guard(**limits: object) -> Guard:
    """A guard that has passed its soft start."""
    guard = Guard(CONFIG.robot, LimitsConfig(**limits), 200.0)  # type: ignore[arg-type]
    guard.memory["ramp"] = 1.0
    return guard


def healthy() -> Records:
    tick = np.zeros(1, TICK_DTYPE)
    tick["orientation"][0, 0] = 1.0
    tick["linear_acceleration"][0, 2] = 9.81
    tick["joint_temperature"] = 30.0
    tick["voltage"] = 48.0
    tick["joint_position"][0, :, 2] = -2.0
    tick["measured_stamp"] = tick["imu_stamp"] = 10.0
    tick["mode"], tick["armed"], tick["period"] = Mode.STAND, 1, 0.005
    return tick


def put(name: str, index: Any, value: float) -> Callable[[Records], None]:
    def act(tick: Records) -> None:
        tick[name][index] = value

    return act


def lean(tick: Records) -> None:
    tick["orientation"][0] = (math.cos(0.5), math.sin(0.5), 0.0, 0.0)


INJECTED = [
    (put("joint_fault", (0, 2, 1), 5), Reason.MOTOR_FAULT, "BL hip: a motor reports a fault (code 5)"),
    (put("joint_temperature", (0, 0, 2), 81.0), Reason.HOT_MOTOR, "FL knee: a motor is too hot (81 °C, bound 80)"),
    (put("joint_velocity", (0, 3, 0), -30.5), Reason.JOINT_SPEED, "BR abduction: a joint is too fast (-30.5 rad/s"),
    (put("joint_age", (0, 1, 1), 0.04), Reason.STALE_MOTOR, "FR hip: a motor's reply is too old (40 ms, bound 30)"),
    (put("imu_stamp", 0, 9.9), Reason.STALE_IMU, "(100 ms, bound 30)"),
    (put("orientation", (0, 0), 0.8), Reason.IMPLAUSIBLE_IMU, "cannot be"),
    (put("angular_velocity", (0, 2), 21.0), Reason.IMPLAUSIBLE_IMU, "cannot be"),
    (put("linear_acceleration", (0, 0), 500.0), Reason.IMPLAUSIBLE_IMU, "cannot be"),
    (lean, Reason.TILTED, "(1.00 rad, bound 0.9)"),
]


def test_a_healthy_measurement_passes() -> None:
    guard = make_guard()
    assert guard.judge(healthy()) is Reason.OK and guard.marks == 0


@pytest.mark.parametrize(("inject", "reason", "words"), INJECTED, ids=lambda part: getattr(part, "name", None))
def test_an_injected_fault_is_named(inject: Callable[[Records], None], reason: Reason, words: str) -> None:
    tick = healthy()
    inject(tick)
    guard = make_guard()
    assert guard.judge(tick) is reason
    assert words in guard.explain(reason)


def test_a_walking_joint_may_be_too_fast_for_a_moment() -> None:
    """A foot that slips off an edge spins its knee until it is unloaded, two or three ticks later."""
    guard, tick = make_guard(overspeed_time=0.025, max_overspeed=2.0), healthy()
    tick["mode"] = Mode.WALK
    for speed in (35.0, -40.0, 59.0, 31.0, 29.0, 35.0, 35.0, 35.0, 35.0):
        tick["joint_velocity"][0, 3, 2] = speed
        assert guard.judge(tick) is Reason.OK
    assert guard.judge(tick) is Reason.JOINT_SPEED
    assert "BR knee: a joint is too fast (35.0 rad/s, bound 30" in guard.explain(Reason.JOINT_SPEED)


def test_a_walking_joint_that_is_far_too_fast_is_found_at_once() -> None:
    guard, tick = make_guard(overspeed_time=0.025, max_overspeed=2.0), healthy()
    tick["mode"] = Mode.WALK
    tick["joint_velocity"][0, 3, 2] = -60.5
    assert guard.judge(tick) is Reason.JOINT_SPEED


MEASURED = [
    "orientation",
    "angular_velocity",
    "linear_acceleration",
    "joint_position",
    "joint_velocity",
    "joint_torque",
    "joint_temperature",
    "joint_age",
    "voltage",
    "imu_stamp",
]


@pytest.mark.parametrize("name", MEASURED)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_whatever_is_not_a_number_is_seen(name: str, value: float) -> None:
    for index in np.ndindex(healthy()[name].shape):
        tick = healthy()
        tick[name][index] = value
        assert make_guard().judge(tick) is not Reason.OK, (name, index)


def test_low_voltage() -> None:
    guard = make_guard(min_voltage=40.0)
    tick = healthy()
    tick["voltage"] = 39.0
    assert guard.judge(tick) is Reason.LOW_VOLTAGE
    assert "39.0 V, bound 40" in guard.explain(Reason.LOW_VOLTAGE)
    tick["voltage"] = 42.0
    assert guard.judge(tick) is Reason.OK


@pytest.mark.parametrize(("torque", "trips"), [(17.0, False), (19.0, True), (36.0, True)])
def test_the_continuous_rating_holds_for_the_rms(torque: float, trips: bool) -> None:
    guard = make_guard()
    tick = healthy()
    tick["joint_torque"][0, 1, 2] = torque
    ticks = math.inf
    for count in range(200 * 120):
        if guard.judge(tick) is Reason.OVERLOAD:
            ticks = count
            break
    assert (ticks < math.inf) == trips
    if trips:  # the first-order low-pass reaches the bound when 1 - exp(-t/T) = (18/torque)²
        expected = -CONFIG.limits.thermal_time * math.log(1.0 - (18.0 / torque) ** 2)
        assert ticks / 200.0 == pytest.approx(expected, rel=0.01)
        assert "FR knee" in guard.explain(Reason.OVERLOAD)


numbers = st.floats(-60.0, 60.0)


@settings(max_examples=200)
@given(
    st.lists(numbers, min_size=12, max_size=12),
    st.floats(0, 400),
    st.floats(0, 10),
    st.lists(st.floats(-2, 2), min_size=12, max_size=12),
)
def test_the_law_with_the_bounded_command_stays_within_the_peak(
    torque: list[float], kp: float, kd: float, error: list[float]
) -> None:
    tick = healthy()
    tick["command_torque"] = np.reshape(torque, (4, 3))
    tick["command_position"] = np.reshape(error, (4, 3))
    tick["command_kp"], tick["command_kd"] = kp, kd
    asked = _law(tick)
    guard = make_guard()
    assert guard.judge(tick) is Reason.OK and guard.bound(tick) is Reason.OK
    given_ = _law(tick)
    np.testing.assert_allclose(given_, np.clip(asked, -PEAK, PEAK), atol=1e-9)
    assert bool(guard.marks & Clamp.TORQUE) == bool((np.abs(asked) > PEAK).any())


def test_a_torque_beyond_the_peak_is_named_beside_a_lower_bound() -> None:
    for torque, both in ((39.0, False), (41.0, True)):
        guard, tick = make_guard(), healthy()
        tick["joint_temperature"][0, 0, 0] = 79.0
        tick["command_torque"][0, 0, 0] = torque
        assert guard.judge(tick) is Reason.OK and guard.bound(tick) is Reason.OK
        assert guard.marks & Clamp.THERMAL and bool(guard.marks & Clamp.TORQUE) == both


def _law(tick: Records) -> np.ndarray:
    t = tick[0]
    fields = ("position", "velocity", "kp", "kd", "torque")
    command = JointCommand(*(t[f"command_{name}"] for name in fields))
    joints = JointState(
        *(t[f"joint_{name}"] for name in ("position", "velocity", "torque", "temperature", "fault", "age"))
    )
    return motor_torque(command, joints)


@pytest.mark.parametrize("name", ["position", "velocity", "kp", "kd", "torque"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_command_that_is_not_finite_is_refused(name: str, value: float) -> None:
    for index in np.ndindex(4, 3):
        tick = healthy()
        tick["command_kp"] = tick["command_kd"] = 1.0
        tick[f"command_{name}"][0][index] = value
        assert make_guard().bound(tick) is Reason.BAD_COMMAND


@pytest.mark.parametrize("name", ["command_kp", "command_kd"])
def test_a_negative_gain_is_refused(name: str) -> None:
    tick = healthy()
    tick[name][0, 1, 1] = -1.0
    assert make_guard().bound(tick) is Reason.BAD_COMMAND


def moving(speed: float, mode: Mode = Mode.STAND) -> Records:
    """Sideways, m/s, over feet that stand 0.2 m beside the body's middle."""
    tick = healthy()
    tick["mode"], tick["height"], tick["twist"][0, 1] = mode, 0.5, speed
    tick["feet"][0, :, 1] = (0.2, -0.2, 0.2, -0.2)
    return tick


def judged_moving(tick: Records, upright: float = 10.0) -> tuple[Reason, str]:
    guard = make_guard(max_overreach=(0.3, 0.6))
    guard.memory["upright"] = upright
    reason = guard.judge_plan(tick)
    return reason, guard.explain(reason) if reason.is_fault else ""


REACH = math.sqrt(0.5 / 9.81)
"""m of capture point for each m/s."""


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize(("mode", "bound"), [(Mode.STAND, 0.3), (Mode.WALK, 0.6)])
def test_a_capture_point_that_no_step_reaches_is_a_fall(side: float, mode: Mode, bound: float) -> None:
    limit = (0.2 + bound) / REACH
    assert judged_moving(moving(side * limit * 0.99, mode)) == (Reason.OK, "")
    reason, words = judged_moving(moving(side * limit * 1.01, mode))
    assert reason is Reason.FALLING
    assert f"bound {bound:g}" in words


def test_a_robot_that_has_just_stood_up_is_not_judged_by_its_speed() -> None:
    assert judged_moving(moving(5.0), upright=0.1)[0] is Reason.OK


@pytest.mark.parametrize(("mode", "ticks", "falls"), [
    (Mode.STAND, 99, False), (Mode.STAND, 110, True), (Mode.WALK, 110, True), (Mode.STAND_UP, 500, False),
])  # fmt: skip
def test_half_a_second_of_standing_or_walking_makes_its_speed_tell(mode: Mode, ticks: int, falls: bool) -> None:
    guard, tick = make_guard(), moving(5.0, mode)
    for _ in range(ticks):
        guard.judge(tick)
    assert (guard.judge_plan(tick) is Reason.FALLING) is falls


def test_a_robot_that_does_not_move_does_not_fall() -> None:
    tick = moving(0.0)
    tick["rpy"][0, 0] = 0.8
    assert judged_moving(tick)[0] is Reason.OK


def test_a_lean_the_way_that_it_moves_brings_the_fall_nearer() -> None:
    """To the right: a positive roll turns the left side up."""
    for roll, expected in ((0.4, Reason.FALLING), (-0.4, Reason.OK)):
        tick = moving(-0.9 * 0.5 / REACH)
        tick["rpy"][0, 0] = roll
        assert judged_moving(tick)[0] is expected


@given(st.floats(0, 3.1), st.floats(-math.pi, math.pi), st.floats(-math.pi, math.pi))
def test_tilt_does_not_depend_on_heading(angle: float, axis: float, yaw: float) -> None:
    half, turn = angle / 2, yaw / 2
    about = np.array([math.cos(half), math.sin(half) * math.cos(axis), math.sin(half) * math.sin(axis), 0.0])
    w, x, y, _ = about
    c, s = math.cos(turn), math.sin(turn)
    turned = np.array([c * w, c * x - s * y, c * y + s * x, s * w])
    assert tilt(turned) == pytest.approx(angle, abs=1e-6)
