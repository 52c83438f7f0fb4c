"""The arming list: every line ok on a healthy robot, and no line ok that should not be."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from test_cycle import Bench, spoil

from runtime.control.records import Records, VelocityCommand
from runtime.messages.mode import ArmingCheck, Mode, Request

NAMES = [
    *("guard", "motors", "joints", "imu", "contacts", "supply", "temperature", "timing", "policy", "sticks"),
]


def limp(**changes: object) -> Bench:
    bench = Bench(**changes)
    bench.tick(3)
    return bench


def refused(bench: Bench) -> dict[str, str]:
    """The lines that are not ok."""
    return {check.name: check.words for check in bench.cycle.examine() if not check.ok}


def test_a_healthy_robot_passes_every_line_and_is_armed() -> None:
    bench = limp()
    assert bench.ask(Request.ARM) == (True, "armed")
    assert [check.name for check in bench.cycle.checks] == NAMES
    assert all(check.ok and check.words for check in bench.cycle.checks)


def lean(t: Records) -> None:
    t["orientation"][0] = (math.cos(0.2), 0.0, math.sin(0.2), 0.0)


def put(name: str, index: tuple[int, ...], value: float) -> Callable[[Records], None]:
    def act(t: Records) -> None:
        t[name][index] = value

    return act


@pytest.mark.parametrize(
    ("inject", "name", "words"),
    [
        (put("joint_fault", (0, 1, 2), 7), "motors", "FR knee reports fault 7"),
        (put("joint_age", (0, 0, 0), 0.2), "motors", "FL abduction last answered 200 ms ago"),
        (put("joint_age", (0, 0, 0), math.nan), "motors", "FL abduction"),
        (put("joint_position", (0, 3, 2), 1.0), "joints", "BR knee at 1.00 rad, range -2.9 to"),
        (put("joint_position", (0, 3, 2), math.nan), "joints", "BR knee"),
        (put("joint_position", (0, 2, 1), -0.9), "joints", "from any known pose"),
        (lean, "imu", "tilted 0.40 rad, bound 0.35"),
        (put("imu_stamp", (0,), -1.0), "imu", "last sample"),
        (put("contact_force", (0, 2, 2), 900.0), "contacts", "feels 900 N"),
        (put("voltage", (0,), 20.0), "supply", "supply 20.0 V, bound 22"),
        (put("joint_temperature", (0, 0, 0), 70.0), "temperature", "hottest motor 70 °C, bound 65"),
    ],
)
def test_a_line_that_is_not_ok_says_why(inject: Callable[[Records], None], name: str, words: str) -> None:
    bench = limp(limits__arming_voltage=22.0, arming__pose_tolerance=1.2)
    assert refused(bench) == {}
    inject(bench.cycle.tick)
    assert set(refused(bench)) == {name}
    assert words in refused(bench)[name]
    accepted, said = bench.ask(Request.ARM)
    assert not accepted and words in said
    assert not bench.cycle.state.armed


def test_an_imu_that_does_not_feel_gravity_keeps_the_robot_from_arming() -> None:
    bench = limp()
    weak = np.array([0.0, 0.0, 7.0])
    bench.body.change = lambda m: replace(m, imu=replace(m.imu, linear_acceleration=weak))
    bench.tick(1000)
    assert "felt 7.0 m/s² lately, bound 9.81 ± 2" in refused(bench)["imu"]


def test_what_the_guard_finds_keeps_the_robot_from_arming() -> None:
    bench = limp()
    bench.body.change = lambda m: spoil(m, velocity=np.full((4, 3), 31.0))
    bench.tick()
    assert "too fast" in refused(bench)["guard"]
    assert not bench.ask(Request.ARM)[0]


def test_the_loop_must_have_run_punctually_for_a_while() -> None:
    bench = limp(arming__soak_time=0.2, arming__max_missed=0.1, arming__max_lateness=0.005)
    assert "wait for 0.2" in refused(bench)["timing"]
    bench.tick(40)
    assert refused(bench) == {}
    bench.overruns, bench.lateness = 30, 0.02
    bench.tick()
    bench.lateness = 0.0
    assert "20 ms late lately" in refused(bench)["timing"]
    for _ in range(60):
        bench.overruns += 1
        bench.tick()
    assert "of the ticks missed lately" in refused(bench)["timing"]
    bench.tick(400)
    assert refused(bench) == {}


def test_sticks_must_be_centred() -> None:
    bench = limp()
    bench.velocity(0.3)
    assert "centre the sticks" in refused(bench)["sticks"]
    bench.cycle.command_velocity(VelocityCommand(bench.now, np.zeros(2), -0.5))
    assert "sticks" in refused(bench)
    bench.velocity(0.0)
    assert refused(bench) == {}
    bench.velocity(0.3)
    bench.tick(420)
    assert refused(bench) == {}, "a command long ago is none"


def test_another_robots_policy_is_refused() -> None:
    bench = limp()
    bench.cycle.swap_policy(type(bench.cycle.policy)(**{
        name: getattr(bench.cycle.policy, name) for name in bench.cycle.policy.__struct_fields__
    } | {"robot": "another"}))  # fmt: skip
    assert "is for another" in refused(bench)["policy"]


def test_what_only_the_shell_knows_counts_as_well() -> None:
    bench = limp()
    bench.cycle.outside = lambda: (ArmingCheck("calibration", False, "none"),)
    assert bench.ask(Request.ARM) == (False, "none")


def test_no_torque_before_the_list_and_then_a_soft_start_from_the_measured_pose() -> None:
    bench = limp(posture__soft_start=0.5)
    measured = bench.measurement.joints.position.copy()
    assert bench.ask(Request.STAND)[0] is False
    assert bench.ask(Request.ARM)[0]
    assert not bench.tick().kp.any(), "armed, but limp"
    assert bench.ask(Request.STAND)[0]
    shares, bounds = [], []
    for _ in range(100):
        command = bench.tick()
        np.testing.assert_array_equal(command.position, measured)
        shares.append(float(command.kp.max()))
        bounds.append(float(bench.cycle.guard.memory["torque_bound"].max()))
    assert shares == sorted(shares) and shares[0] < 1.0 and shares[-1] > 0.99 * bench.config.control.gains.kp[0]
    assert bounds == sorted(bounds) and bounds[0] < 1.0
    np.testing.assert_allclose(bounds[50], 0.5 * bench.config.robot.joints.peak_torque[0], atol=0.5)
    bench.tick(3)
    assert bench.cycle.guard.memory["torque_bound"].max() == bench.config.robot.joints.peak_torque[0]
    assert bench.cycle.state.mode is Mode.STAND_UP
