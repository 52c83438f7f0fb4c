"""Feet: Eq. 1-2 as mended: swing lands on its touchdown, stance moves against the command."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import Workbench, policy, robot, variant

from runtime.control.kinematics import leg_geometry
from runtime.control.policy import Terms
from runtime.control.trajectory import aim_feet

GEOMETRY = leg_geometry(robot().robot).view(np.recarray)[0]


def bench(command: tuple[float, float, float] = (0.0, 0.0, 0.0), **terms: float) -> Workbench:
    known = Workbench(chosen=variant(policy(), terms=Terms(**terms)))
    known.t.velocity_command = command
    known.t.stance = known.s.stance = 1
    ground = robot().robot.foot_radius - known.config.gait.walking_height
    known.s.foot_targets = np.column_stack([known.p.nominal_footholds, np.full(4, ground)])
    known.t.feet = known.s.foot_targets
    return known


def aim(known: Workbench) -> None:
    aim_feet(known.p, GEOMETRY, known.chosen, known.s, known.t)
    known.s.stance = known.t.stance


def swing(known: Workbench, leg: int = 0) -> np.ndarray:
    """One whole swing; foot targets tick by tick."""
    ticks = round(float(known.p.swing_time) / float(known.p.dt))
    known.s.swinging[leg] = 1
    known.t.stance[leg] = 0
    path = []
    for tick in range(ticks):
        known.t.phase[leg] = np.pi * tick / ticks
        aim(known)
        path.append(np.array(known.t.foot_targets[leg]))
    return np.array(path)


def test_touchdown_is_eq_1() -> None:
    known = bench((0.6, -0.2, 0.5))
    known.t.action[:12] = np.arange(12) / 100
    aim(known)
    for leg in range(4):
        nominal = known.p.nominal_footholds[leg]
        at_foot = np.array([0.6, -0.2]) + 0.5 * np.array([-nominal[1], nominal[0]])
        expected = nominal + at_foot * known.p.stance_time / 2 + known.t.action[3 * leg : 3 * leg + 2]
        np.testing.assert_allclose(known.t.touchdown[leg], expected)


@pytest.mark.parametrize("command", [(0.0, 0.0, 0.0), (0.8, 0.0, 0.0), (-0.4, 0.3, -0.8)])
def test_the_last_step_of_a_swing_lands_on_the_touchdown(command: tuple[float, float, float]) -> None:
    known = bench(command)
    known.t.feet[0] += (-0.1, 0.05, 0.0)
    path = swing(known)
    np.testing.assert_allclose(path[-1, :2], known.t.touchdown[0], atol=1e-12)
    steps = np.diff(path[:, :2], axis=0)
    np.testing.assert_allclose(steps, np.broadcast_to(steps[0], steps.shape), atol=1e-12)


def test_swing_rises_to_its_height_and_returns_to_the_ground() -> None:
    known = bench()
    path = swing(known)
    ground = robot().robot.foot_radius - known.config.gait.walking_height
    assert path[:, 2].max() == pytest.approx(ground + known.config.gait.swing_height, abs=1e-4)
    assert path[0, 2] == pytest.approx(ground)
    assert path[-1, 2] == pytest.approx(ground, abs=0.008)


def test_a_policy_may_swing_its_feet_higher() -> None:
    known = bench(swing_lift=0.04)
    ground = robot().robot.foot_radius - known.config.gait.walking_height
    assert swing(known)[:, 2].max() == pytest.approx(ground + known.config.gait.swing_height + 0.04, abs=1e-4)


def test_stance_moves_against_the_commanded_velocity_at_the_foot() -> None:
    known = bench((0.5, 0.2, 0.6))
    before = known.s.foot_targets.copy()
    aim(known)
    for leg in range(4):
        x, y = before[leg, :2]
        velocity = np.array([0.5 - 0.6 * y, 0.2 + 0.6 * x])
        np.testing.assert_allclose(known.t.foot_targets[leg, :2], before[leg, :2] - velocity * known.p.dt)
        assert known.t.foot_targets[leg, 2] == before[leg, 2]


def test_target_is_the_measured_foot_only_where_stance_changes() -> None:
    known = bench()
    known.t.feet = known.s.foot_targets + 0.02
    aim(known)
    np.testing.assert_allclose(known.t.foot_targets, known.t.feet - 0.02)
    known.t.stance[1] = 0
    known.s.searching[1] = 1
    aim(known)
    np.testing.assert_allclose(known.t.foot_targets[1, :2], known.t.feet[1, :2])
    np.testing.assert_allclose(known.t.foot_targets[0], known.t.feet[0] - 0.02)


def test_a_searching_foot_goes_down_to_its_depth_and_no_further() -> None:
    known = bench()
    known.s.searching[2] = 1
    start = float(known.s.foot_targets[2, 2])
    heights = []
    for _ in range(100):
        aim(known)
        heights.append(start - known.t.foot_targets[2, 2])
    gait = known.config.gait
    assert heights[0] == pytest.approx(gait.search_speed * known.p.dt)
    assert heights[-1] == pytest.approx(gait.search_depth)
    known.s.searching[2] = 0
    aim(known)
    assert known.t.foot_targets[2, 2] == pytest.approx(start)


def test_vertical_shifts_and_slope_are_added_to_the_height() -> None:
    known = bench(slope_feet=0.5)
    known.t.slope = (0.2, -0.1)
    known.t.action[2] = 0.03
    before = known.s.foot_targets.copy()
    aim(known)
    rise = 0.5 * (before[:, :2] @ [0.2, -0.1]) + [0.03, 0, 0, 0]
    np.testing.assert_allclose(known.t.foot_targets[:, 2], before[:, 2] + rise)
    aim(known)
    np.testing.assert_allclose(known.t.foot_targets[:, 2], before[:, 2] + rise), "not integrated"
