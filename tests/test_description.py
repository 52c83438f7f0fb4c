"""A robot's composite mass properties against the rigid bodies that the simulator builds, and Pinocchio's."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import ROBOTS, robot

from drivers.description import composite_inertia
from sim.model import build_model


@pytest.mark.parametrize("name", ROBOTS)
def test_composite_inertia_against_pinocchio(name: str) -> None:
    pin = pytest.importorskip("pinocchio")
    body = robot(name).robot
    model = pin.buildModelFromXML(build_model(body).urdf(), pin.JointModelFreeFlyer())
    rng = np.random.default_rng(0)
    for _ in range(5):
        q = rng.uniform(-1, 1, (4, 3))
        theirs = pin.neutral(model)
        for leg, prefix in enumerate(("FL", "FR", "BL", "BR")):
            for joint, suffix in enumerate(("abduction", "hip", "knee")):
                theirs[model.joints[model.getJointId(f"{prefix}_{suffix}")].idx_q] = q[leg, joint]
        data = model.createData()
        pin.ccrba(model, data, theirs, np.zeros(model.nv))
        com, inertia = composite_inertia(body, q)
        np.testing.assert_allclose(com, data.com[0], atol=1e-9)
        assert body.mass == pytest.approx(data.Ig.mass)
        # the URDF's inertias carry the rotors, ours do not
        rotors = 24 * body.joints.rotor_inertia
        np.testing.assert_allclose(inertia, data.Ig.inertia, atol=rotors + 1e-9)


@pytest.mark.parametrize("name", ROBOTS)
def test_composite_inertia_is_a_real_bodys(name: str) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        _, inertia = composite_inertia(robot(name).robot, rng.uniform(-1, 1, (4, 3)))
        np.testing.assert_allclose(inertia, inertia.T, atol=1e-12)
        moments = np.linalg.eigvalsh(inertia)
        assert moments[0] > 0 and moments[2] <= moments[0] + moments[1]


def test_stoch3_is_the_methods_single_rigid_body() -> None:
    """Method: about diag(0.7, 1.4, 1.7) kg m² in the stand pose, centre of mass some 27 mm behind and below."""
    from runtime.control.state import stand_angles

    body = robot().robot
    com, inertia = composite_inertia(body, stand_angles(body, 0.54))
    assert body.mass == pytest.approx(25.04, abs=0.1)
    np.testing.assert_allclose(np.diag(inertia), [0.7, 1.4, 1.7], rtol=0.35)
    assert -0.04 < com[0] < 0 and com[1] == pytest.approx(0, abs=1e-12) and -0.06 < com[2] < 0
