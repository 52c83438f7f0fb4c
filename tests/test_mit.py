"""The MIT protocol: documented vectors, ranges, damaged frames."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import CorruptFrame
from drivers.mit import DISABLE, ENABLE, RANGES, MitCodec


def unpack(frame: bytes) -> list[int]:
    """A command's five fields by bit string: an independent reading of the manual's table."""
    bits = "".join(f"{byte:08b}" for byte in frame)
    position, velocity, kp, kd, torque = (
        int(bits[a:b], 2) for a, b in ((0, 16), (16, 28), (28, 40), (40, 52), (52, 64))
    )
    return [position, velocity, torque, kp, kd]


def reply(motor: int, position: int, velocity: int, torque: int, *tail: int) -> bytes:
    bits = f"{motor:08b}{position:016b}{velocity:012b}{torque:012b}"
    return int(bits, 2).to_bytes(6, "big") + bytes(tail)


@given(
    st.sampled_from(sorted(RANGES)),
    st.tuples(st.floats(-40, 40), st.floats(-90, 90), st.floats(-150, 150), st.floats(-1, 600), st.floats(-1, 6)),
)
def test_commands_are_the_nearest_step_within_the_range(model, command):
    span = RANGES[model]
    fields = unpack(MitCodec([3], model=model).encode(np.array([command]))[0])
    lows = [-span.position, -span.velocity, -span.torque, 0.0, 0.0]
    highs = [span.position, span.velocity, span.torque, 500.0, 5.0]
    for field, wanted, low, high, bits in zip(fields, command, lows, highs, (16, 12, 12, 12, 12), strict=True):
        step = (high - low) / (2**bits - 1)
        assert low + field * step == pytest.approx(min(max(wanted, low), high), abs=step * 0.501)


def test_zero_command_is_the_manuals():
    frame = MitCodec([1], model="AK80-6").encode(np.zeros((1, 5)))[0]
    assert frame.hex() == "7fff7ff0000007ff"


@pytest.mark.parametrize("model", ["AK10-9", "DM8009"])
@given(position=st.integers(0, 65535), velocity=st.integers(0, 4095), torque=st.integers(0, 4095))
def test_replies_decode_over_the_range(model, position, velocity, torque):
    codec = MitCodec([3], model=model)
    first = 0x13 if model == "DM8009" else 3
    data = reply(first, position, velocity, torque, 35, 0)
    si = codec.to_si(np.array([codec.decode(data)]))[0]
    span = codec.range
    assert codec.motor_of(data) == 3
    assert si[0] == codec.running
    assert si[1] == pytest.approx(-span.position + position * 2 * span.position / 65535)
    assert si[2] == pytest.approx(-span.velocity + velocity * 2 * span.velocity / 4095)
    assert si[3] == pytest.approx(-span.torque + torque * 2 * span.torque / 4095)
    assert si[5] == 35


def test_faults_of_both_makers_are_named():
    ak, dm = MitCodec([3], model="AK70-10"), MitCodec([3], model="DM4310")
    mode, *_, fault = ak.decode(reply(3, 0, 0, 0, 90, 1))
    assert mode != ak.running
    assert "over-temperature" in ak.describe_fault(ak.fault(int(mode), int(fault)))
    mode, *_, fault = dm.decode(reply(0xD3, 0, 0, 0, 30, 31))
    assert "lost communication" in dm.describe_fault(dm.fault(int(mode), int(fault)))
    assert dm.decode(reply(0x03, 0, 0, 0, 30, 31))[0] == 0


def test_cold_motor_is_below_zero_degrees():
    assert MitCodec([3], model="AK70-10").decode(reply(3, 0, 0, 0, 0xF6, 0))[5] == -10


def test_special_frames():
    codec = MitCodec([1, 2], model="AK80-6")
    assert codec.stop == [DISABLE] * 2
    assert codec.enable == [ENABLE] * 2
    assert ENABLE[-1] == 0xFC


@given(st.binary(max_size=12), st.sampled_from(["AK80-9", "DM4340"]))
def test_any_bytes_decode_or_are_called_corrupt(data, model):
    codec = MitCodec([1], model=model)
    try:
        codec.motor_of(data)
        assert len(codec.decode(data)) == 7
    except CorruptFrame:
        assert len(data) != 8


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_command_that_is_not_a_number_never_leaves(value):
    with pytest.raises(ValueError, match="motor 2"):
        MitCodec([1, 2], model="AK80-6").encode(np.array([[0.0] * 5, [0.0, value, 0.0, 0.0, 0.0]]))


def test_settings_are_refused_by_name():
    with pytest.raises(ValueError, match="AK99"):
        MitCodec([1], model="AK99")
    with pytest.raises(ValueError, match="motor id 16"):
        MitCodec([16], model="DM4310")
