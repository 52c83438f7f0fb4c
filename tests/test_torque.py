"""Eq. 5-6: joint targets, gains and feed-forward of swing and stance legs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scenes import Workbench, robot, rotation

from runtime.control.kinematics import forward, inverse, jacobians, leg_geometry
from runtime.control.records import Clamp
from runtime.control.state import stand_angles
from runtime.control.torque import command_joints, damp_joints

TABLE = leg_geometry(robot().robot)
GEOMETRY = TABLE.view(np.recarray)[0]
STAND = stand_angles(robot().robot, 0.5)


class Bench(Workbench):
    """Standing on four feet in the pose ``STAND``."""

    def __init__(self, rpy: Any = (0.0, 0.0, 0.0)) -> None:
        super().__init__()
        self.m.rotation = rotation(rpy)
        self.m.jacobian = jacobians(TABLE, STAND)
        self.t.stance = self.s.stance = 1
        self.t.foot_targets = forward(TABLE, STAND) @ rotation(rpy).T
        self.out = np.empty((5, 4, 3))

    def command(self, standing: bool = False) -> dict[str, np.ndarray]:
        self.t.clamps = 0
        command_joints(self.p, GEOMETRY, self.s, self.t, self.m, standing, self.out)
        names = ("position", "velocity", "kp", "kd", "torque")
        for index, name in enumerate(names):
            np.testing.assert_array_equal(self.out[index], getattr(self.t, f"command_{name}"))
        return dict(zip(names, self.out.copy(), strict=True))


@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (0.1, -0.15, 0.0)])
def test_targets_and_forces_are_turned_into_the_body_frame(rpy: tuple[float, float, float]) -> None:
    bench = Bench(rpy)
    force = np.random.default_rng(0).normal([0, 0, 60], 20, (4, 3))
    bench.t.grf = force
    found = bench.command()
    np.testing.assert_allclose(found["position"], STAND, atol=1e-9)
    in_body = force @ rotation(rpy)
    expected = [-jacobian.T @ f for jacobian, f in zip(jacobians(TABLE, STAND), in_body, strict=True)]
    np.testing.assert_allclose(found["torque"], expected, atol=1e-9)


def test_feed_forward_holds_the_body_up_by_virtual_work() -> None:
    """Lifting the body by dz against the forces costs Σ f_z dz; the torques do that work over dq."""
    bench = Bench()
    bench.t.grf = np.tile([0.0, 0.0, 60.0], (4, 1))
    torque = bench.command()["torque"]
    feet = forward(TABLE, STAND)
    up, _ = inverse(TABLE, feet - np.array([0, 0, 1e-6]))
    assert (torque * (up - STAND)).sum() == pytest.approx(4 * 60.0 * 1e-6, rel=1e-4)


def test_swing_has_whole_gains_and_stance_a_share() -> None:
    bench = Bench()
    bench.t.stance[1] = 0
    found = bench.command()
    gains = bench.config.gains
    np.testing.assert_allclose(found["kp"], np.outer([0.1, 1.0, 0.1, 0.1], gains.kp))
    np.testing.assert_allclose(found["kd"], np.outer([0.1, 1.0, 0.1, 0.1], gains.kd))


def test_gains_of_standing_rise_gently_and_fall_back_at_once_when_walking() -> None:
    bench = Bench()
    bench.command()
    shares = [bench.command(standing=True)["kp"][0, 0] / bench.config.gains.kp[0] for _ in range(200)]
    assert max(np.diff([0.1, *shares])) <= float(bench.p.dt) / 0.5 + 1e-12
    assert shares[-1] == pytest.approx(bench.config.gains.standing_scale)
    assert bench.command()["kp"][0, 0] == pytest.approx(0.1 * bench.config.gains.kp[0])


def test_joint_speed_is_the_difference_of_the_targets() -> None:
    bench = Bench()
    assert not bench.command()["velocity"].any(), "the first tick has no difference"
    bench.t.foot_targets[:, 0] += 0.005
    before = STAND
    found = bench.command()
    np.testing.assert_allclose(found["velocity"], (found["position"] - before) / bench.p.dt, atol=1e-9)


def test_joint_speed_is_zero_where_stance_changes_and_bounded_elsewhere() -> None:
    bench = Bench()
    bench.command()
    bench.t.foot_targets[:, 0] += 0.15
    bench.t.stance[2] = 0
    found = bench.command()
    assert not found["velocity"][2].any()
    assert np.abs(found["velocity"]).max() == bench.config.gains.max_joint_speed
    assert bench.t.clamps & Clamp.JOINT_SPEED


def test_a_target_out_of_reach_or_range_is_cut_and_named() -> None:
    bench = Bench()
    bench.t.foot_targets[0] = (1.5, 0.0, -0.3)
    found = bench.command()
    assert bench.t.clamps & Clamp.REACH
    lower, upper = robot().robot.joints.lower, robot().robot.joints.upper
    assert (found["position"] >= lower).all() and (found["position"] <= upper).all()
    bench = Bench()
    bench.t.foot_targets[0, 1] += 0.45
    bench.command()
    assert bench.t.clamps & Clamp.JOINT_LIMIT


def test_the_safe_command_only_damps() -> None:
    bench = Bench()
    bench.out[:] = np.nan
    damp_joints(bench.p, bench.t, bench.out)
    assert not bench.out[[0, 1, 2, 4]].any()
    np.testing.assert_array_equal(bench.out[3], np.tile(bench.config.gains.kd, (4, 1)))
    np.testing.assert_array_equal(bench.t.command_kd, bench.out[3])
