"""How much torque and speed are left: each cause by itself, and that the least of them counts."""

from __future__ import annotations

import numpy as np
import pytest
from test_limits import CONFIG, healthy, make_guard

from runtime.control.records import Clamp
from runtime.guard import Guard
from runtime.messages.mode import Mode
from runtime.parameters import DegradeConfig, LimitsConfig


@pytest.mark.parametrize(("celsius", "torque", "speed"), [(70.0, 1.0, 1.0), (75.0, 0.8, 0.75), (80.0, 0.6, 0.5)])
def test_a_warm_motor_is_given_less_and_the_robot_goes_slower(celsius: float, torque: float, speed: float) -> None:
    guard, tick = make_guard(), healthy()
    tick["joint_temperature"][0, 1, 2] = celsius
    guard.judge(tick)
    bound = guard.memory["torque_bound"][0] / 40.0
    assert bound[1, 2] == pytest.approx(torque) and np.delete(bound.ravel(), 5).min() == 1.0, "only that one"
    assert guard.torque_share == pytest.approx(torque) and guard.speed_share == pytest.approx(speed)
    tick["command_torque"] = -39.0
    guard.bound(tick)
    assert bool(guard.marks & Clamp.THERMAL) == (torque < 1.0) and not guard.marks & (Clamp.TORQUE | Clamp.CURRENT)
    assert tick["command_torque"][0, 1, 2] == pytest.approx(max(-39.0, -40.0 * torque))


def test_a_supply_is_not_looked_at_where_the_robot_does_not_say_so() -> None:
    guard, tick = make_guard(), healthy()
    tick["voltage"] = 1.0
    guard.judge(tick)
    assert guard.speed_share == 1.0


def test_the_bound_of_a_robot_that_left_damp_grows_from_none() -> None:
    guard = Guard(CONFIG.robot, LimitsConfig(), 200.0, soft_start=0.5)
    tick = healthy()
    tick["mode"] = Mode.DAMP
    guard.judge(tick)
    assert guard.memory["torque_bound"].max() == 0.0 and guard.torque_share == 1.0
    tick["mode"] = Mode.STAND_UP
    bounds = []
    for _ in range(101):
        guard.judge(tick)
        bounds.append(float(guard.memory["torque_bound"].max()))
    np.testing.assert_allclose(bounds[:100], 40.0 * np.arange(1, 101) / 100.0)
    assert bounds[100] == 40.0
    tick["mode"] = Mode.DAMP
    guard.judge(tick)
    tick["command_torque"] = 30.0
    guard.bound(tick)
    assert guard.marks & Clamp.SOFT_START and not tick["command_torque"].any()


def test_a_supply_that_sags_slows_the_walk() -> None:
    guard = Guard(CONFIG.robot, LimitsConfig(min_voltage=20.0), 200.0, DegradeConfig(voltage_start=24.0))
    for volts, share in ((25.0, 1.0), (22.0, 0.75), (20.0, 0.5)):
        tick = healthy()
        tick["voltage"] = volts
        guard.judge(tick)
        assert guard.speed_share == pytest.approx(share)


def test_torque_is_taken_back_as_the_rms_nears_the_rating() -> None:
    guard, tick = make_guard(), healthy()
    shares = []
    for rms in (10.0, 15.0, 16.5, 18.0):
        guard.memory["mean_square"] = rms**2
        tick["joint_torque"] = rms
        guard.judge(tick)
        shares.append(guard.torque_share)
    assert shares[:2] == [1.0, 1.0] and shares[1] > shares[2] > shares[3]
    assert shares[3] == pytest.approx(0.9 * 18.0 / 40.0, abs=0.01)
    tick["command_torque"] = 30.0
    guard.bound(tick)
    assert guard.marks & Clamp.CURRENT and not guard.marks & (Clamp.TORQUE | Clamp.THERMAL)
    assert tick["command_torque"].max() == pytest.approx(40.0 * shares[3])
