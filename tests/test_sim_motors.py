"""The simulated servos run the one motor law, within their limits, when the command has reached them."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from drivers.robot import JointCommand, JointState, damp_command, motor_torque
from runtime.config import ROBOTS, load
from sim.motors import Motors
from sim.sensing import STICKING_SPEED

LIMITS = load(ROBOTS / "stoch3.toml").robot.joints
SMOOTH = msgspec.structs.replace(LIMITS, friction_torque=0.0)

joints = arrays(np.float64, (4, 3), elements=st.floats(-10.0, 10.0))
gains = arrays(np.float64, (4, 3), elements=st.floats(0.0, 200.0))
commands = st.builds(JointCommand, position=joints, velocity=joints, kp=gains, kd=gains, torque=joints)


def states(position: np.ndarray, velocity: np.ndarray) -> list[tuple[float, float]]:
    return list(zip(position.ravel().tolist(), velocity.ravel().tolist(), strict=True))


def torque_command(torque: float) -> JointCommand:
    return replace(damp_command(0.0), torque=np.full((4, 3), torque))


@given(commands, joints, joints, st.floats(0.0, 2.0))
def test_the_law_is_the_drivers_clipped_at_the_peak(
    command: JointCommand, position: np.ndarray, velocity: np.ndarray, strength: float
) -> None:
    motors = Motors(SMOOTH)
    motors.reset(strength, 0)
    motors.take(command, 0)
    applied = np.reshape(motors.drive(0, states(position, velocity)), (4, 3))
    zero = np.zeros((4, 3))
    exact = motor_torque(command, JointState(position, velocity, zero, zero, zero.astype(np.int32), zero))
    peak = strength * np.array(LIMITS.peak_torque)
    np.testing.assert_allclose(applied, np.clip(exact, -peak, peak), atol=1e-9)
    np.testing.assert_array_equal(applied.ravel(), motors.torque)


@given(joints)
def test_dry_friction_only_takes_energy(velocity: np.ndarray) -> None:
    motors = Motors(LIMITS)
    applied = np.reshape(motors.drive(0, states(np.zeros((4, 3)), velocity)), (4, 3))
    assert (applied * velocity <= 0).all()
    assert (np.abs(applied) <= LIMITS.friction_torque).all()
    fast = np.abs(velocity) > STICKING_SPEED
    np.testing.assert_allclose(np.abs(applied[fast]), LIMITS.friction_torque)
    assert motors.torque == [0.0] * 12


@pytest.mark.parametrize("delay", [0, 1, 7])
def test_commands_act_after_the_delay_in_their_order(delay: int) -> None:
    motors = Motors(SMOOTH)
    motors.reset(1.0, delay)
    rest = states(np.zeros((4, 3)), np.zeros((4, 3)))
    seen = []
    for step in range(20):
        if step % 5 == 0:
            motors.take(torque_command(1.0 + step), step)
        seen.append(motors.drive(step, rest)[0])
    assert seen == [0.0 if step < delay else 1.0 + (step - delay) // 5 * 5 for step in range(20)]


def test_an_episode_starts_without_the_last_ones_commands() -> None:
    motors = Motors(LIMITS)
    rest = states(np.zeros((4, 3)), np.zeros((4, 3)))
    motors.take(torque_command(5.0), 0)
    motors.drive(0, rest)
    motors.take(torque_command(6.0), 1)
    motors.reset(1.0, 0)
    assert motors.drive(1, rest) == [0.0] * 12


@pytest.mark.parametrize("field", ["position", "velocity", "kp", "kd", "torque"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_command_that_is_not_finite_is_refused_by_name(field: str, value: float) -> None:
    broken = np.ones((4, 3))
    broken[2, 1] = value
    command = replace(replace(damp_command(1.0), kp=np.ones((4, 3))), **{field: broken})
    with pytest.raises(ValueError, match=rf"joint command {field}: not finite"):
        Motors(LIMITS).take(command, 0)
