"""A robot whose numbers its motors' frames cannot carry is refused at the door; one that is let in is never clipped."""

from __future__ import annotations

from typing import Any

import moteus
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.moteus import REVOLUTION
from drivers.moteus_registers import Register
from drivers.motor_codec import build_codec
from runtime import config
from runtime.config import ConfigError

STOCH3 = config.load(config.find_robot("stoch3"))
CHEETAH = config.load(config.find_robot("mini_cheetah"))
CARRIED: dict[str, Any] = {
    "motors.format": "compact",
    "motors.servo_kp": 2000.0,
    "motors.servo_kd": 100.0,
}
"""Servos whose own gains are so high that a byte of share of them says all that Stoch3 wants."""


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"motors.format": "compact"}, r"control.gains.kp\[0\] = 150 N·m/rad: .*'compact' carry 31.83 .*\"float\""),
        (CARRIED | {"motors.servo_kp": 1000.0}, r"tuning.kp, with control.gains.kp\[0\] = 225 N·m/rad: .* 159.2"),
        (CARRIED | {"motors.servo_kd": 30.0}, r"tuning.kd, with control.gains.kd\[0\] = 8 N·m·s/rad: .* 4.775"),
        (CARRIED | {"motors.servo_kd": 51.0, "damp.fall_kd": 9.0}, r"damp.fall_kd\[0\] = 9 N·m·s/rad: .* 8.117"),
        (CARRIED | {"motors.max_torque": [40.0, 400.0, 40.0]}, r"motors.max_torque\[1\] = 400 N·m: .* 327.7"),
        (CARRIED | {"robot.joints.max_velocity": [30.0, 30.0, 60.0]}, r"max_velocity\[2\] = 60 rad/s: .* 51.47"),
        (
            CARRIED | {"motors.gear": [1.0, 1.0, 8.0], "robot.joints.max_velocity": [6.0] * 3},
            r"upper, .*offset\[0\]\[2\] = 2.753 rad",
        ),
    ],
)
def test_what_the_frames_cannot_carry_is_refused_by_value_bound_and_place(changes: dict, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        config.override(STOCH3, "stoch3.toml", changes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"damp.fall_kd": 5.1}, r"damp.fall_kd\[0\] = 5.1 N·m·s/rad: frames of 'mit' carry 5 .*motors.model"),
        ({"motors.max_torque": [17.0, 17.0, 19.0]}, r"motors.max_torque\[2\] = 19 N·m: .* carry 18"),
        ({"motors.model": "AK0"}, "AK0"),
    ],
)
def test_so_is_it_for_other_protocols(changes: dict, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        config.override(CHEETAH, "mini_cheetah.toml", changes)


@given(
    kp=st.floats(0, 400),
    kd=st.floats(0, 20),
    servo_kp=st.floats(50, 5000),
    servo_kd=st.floats(5, 300),
    torque=st.floats(1, 500),
)
@settings(max_examples=60, deadline=None)
def test_what_is_let_in_arrives_within_half_a_step(
    kp: float, kd: float, servo_kp: float, servo_kd: float, torque: float
) -> None:
    changes = CARRIED | {"motors.servo_kp": servo_kp, "motors.servo_kd": servo_kd, "motors.max_torque": [torque] * 3}
    changes |= {"control.gains.kp": [kp] * 3, "control.gains.kd": [kd] * 3}
    try:
        let_in = config.override(STOCH3, "test", changes)
    except ConfigError:
        return
    assert let_in.motors is not None
    most = let_in.tuning.kp[1] * kp, let_in.tuning.kd[1] * kd
    joints = let_in.robot.joints
    position = np.array(joints.upper)[0, 0] + let_in.motors.offset[0][0]
    command = np.tile([position, 0.0, joints.peak_torque[0], *most], (12, 1))
    said = moteus.parse_registers(build_codec(let_in.motors).encode(command)[0]).command
    for register, wanted, step in (
        (Register.COMMAND_POSITION, position, 1e-4 * REVOLUTION),
        (Register.COMMAND_TORQUE, joints.peak_torque[0], 0.01),
        (Register.COMMAND_KP_SCALE, most[0], servo_kp / REVOLUTION / 127),
        (Register.COMMAND_KD_SCALE, most[1], servo_kd / REVOLUTION / 127),
        (Register.COMMAND_MAX_TORQUE, torque, 0.01),
    ):
        unit = {Register.COMMAND_POSITION: REVOLUTION, Register.COMMAND_KP_SCALE: servo_kp / REVOLUTION}.get(
            register, servo_kd / REVOLUTION if register is Register.COMMAND_KD_SCALE else 1.0
        )
        assert said[register] * unit == pytest.approx(wanted, abs=0.5 * step * (1.0 + 1e-9))
