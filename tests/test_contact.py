"""Foot force from joint torque, and contact from foot force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import ROBOTS, Workbench, bearing_torque, robot, rotation

from runtime.control.contact import feel_contacts, foot_force
from runtime.control.kinematics import gravity_of_leg, jacobians, leg_geometry


@pytest.mark.parametrize("name", ROBOTS)
def test_force_is_found_again_from_the_torque_that_bears_it(name: str) -> None:
    """Torque from the energy of the simulator's bodies: nothing of the core's own."""
    rng = np.random.default_rng(0)
    geometry = leg_geometry(robot(name).robot)
    for _ in range(3):
        q = rng.uniform([-0.4, 0.2, -1.8], [0.4, 1.0, -0.6], (4, 3))
        up = rotation(rng.uniform(-0.4, 0.4, 3))[2]
        wanted = rng.normal([0, 0, 80], 40, 3)
        torque = bearing_torque(name, q, wanted, up)
        matrices = jacobians(geometry, q)
        for leg in range(4):
            gravity, force = np.empty(3), np.empty(3)
            gravity_of_leg(geometry.view(np.recarray)[0], leg, q[leg], up, gravity)
            foot_force(gravity, torque[leg], matrices[leg], force)
            np.testing.assert_allclose(force, wanted, atol=1e-4)


def test_a_singular_leg_tells_no_force() -> None:
    geometry = leg_geometry(robot().robot)
    matrices = jacobians(geometry, np.zeros((4, 3)))
    force = np.full(3, 9.0)
    foot_force(np.zeros(3), np.full(3, 50.0), matrices[0], force)
    np.testing.assert_array_equal(force, 0.0)


def feel(bench: Workbench, vertical: float) -> bool:
    bench.t.contact_force[0] = (0.0, 0.0, vertical)
    feel_contacts(bench.p, bench.s, bench.t, bench.m)
    assert bench.t.contacts[0] == bench.s.contacts[0]
    return bool(bench.s.contacts[0])


def test_contact_begins_at_the_threshold_and_is_lost_at_its_half() -> None:
    bench = Workbench(contact={"threshold": 50.0, "release": 0.5, "force_time_constant": 0.0})
    assert [feel(bench, force) for force in (49.0, 51.0, 26.0, 24.0, 26.0, 49.9, 50.1)] == [
        False, True, True, False, False, False, True,
    ]  # fmt: skip


def test_no_contact_begins_early_in_a_swing_but_one_can_end() -> None:
    bench = Workbench(contact={"blanking": 0.5, "force_time_constant": 0.0})
    bench.s.swinging[0] = 1
    for phase, expected in ((0.1, False), (0.49, False), (0.51, True)):
        bench.s.felt[0] = 0
        bench.s.phase[0] = phase * np.pi
        assert feel(bench, 200.0) is expected
    bench.s.felt[0], bench.s.phase[0] = 1, 0.1
    assert feel(bench, 200.0)
    assert not feel(bench, 0.0)


@given(forces=st.lists(st.floats(-500, 500), min_size=1, max_size=60))
def test_hysteresis_is_never_inside_its_band(forces: list[float]) -> None:
    bench = Workbench(contact={"threshold": 40.0, "release": 0.6})
    for force in forces:
        before = bool(bench.s.contacts[0])
        after = feel(bench, force)
        if before != after:
            assert force > 40.0 if after else force <= 24.0


def test_the_inertia_of_a_swinging_leg_is_no_contact_but_a_landing_is_at_once() -> None:
    """Forces of a real swing over the wires, encoder steps and torque noise in them, and of a real landing."""
    bench = Workbench(contact={"threshold": 50.0})
    bench.s.started = 1
    assert not any(feel(bench, force) for force in (4.0, 13.0, -15.0, 45.0, 11.0, -13.0, 53.0, -30.0, 51.0))
    assert feel(bench, 166.0)


def test_a_foot_that_moves_over_the_ground_while_another_rests_is_in_the_air() -> None:
    bench = Workbench(contact={"lift_speed": 1.5})
    bench.t.contact_force[:, 2] = 120.0
    bench.m.odometry[0] = (0.0, 0.0, -2.0)
    feel_contacts(bench.p, bench.s, bench.t, bench.m)
    assert bench.t.contacts.tolist() == [0, 1, 1, 1]
    assert bench.s.lifted.tolist() == [1, 0, 0, 0]


def test_when_no_foot_agrees_with_the_estimate_the_feet_are_believed() -> None:
    """Otherwise one wrong velocity would silence the very readings that correct it."""
    bench = Workbench()
    bench.t.contact_force[:, 2] = 120.0
    bench.m.odometry[:] = (3.0, 0.0, 0.0)
    feel_contacts(bench.p, bench.s, bench.t, bench.m)
    assert bench.t.contacts.tolist() == [1, 1, 1, 1]
    assert not bench.s.lifted.any()


def test_not_a_number_is_no_contact() -> None:
    bench = Workbench()
    bench.s.felt[0] = 1
    assert not feel(bench, np.nan)
