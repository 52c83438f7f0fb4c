"""Our moteus codec against the maker's own package, the documented byte vectors, and damaged frames."""

from __future__ import annotations

import math
import struct

import moteus
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from moteus import multiplex
from moteus.protocol import Writer

from drivers.errors import CorruptFrame
from drivers.moteus import REVOLUTION, MoteusCodec, command_id, reply_id
from drivers.moteus_registers import FAULTS, LEGAL_LENGTHS, Mode, Register, describe_fault, encode_read, pad, parse

SERVO_KP, SERVO_KD = 200.0, 10.0
INT8_LIMITS = moteus.PositionResolution()
INT8_LIMITS.velocity_limit = INT8_LIMITS.accel_limit = moteus.INT8


def codec(form: str = "float", ids: tuple[int, ...] = (11, 12, 13)) -> MoteusCodec:
    torque = np.full(len(ids), 18.0)
    return MoteusCodec(ids, max_torque=torque, servo_kp=SERVO_KP, servo_kd=SERVO_KD, form=form)  # type: ignore[arg-type]


def wire(number: float) -> float:
    return float(np.float32(number))


commands = st.tuples(
    st.floats(-20, 20), st.floats(-60, 60), st.floats(-60, 60), st.floats(0, 300), st.floats(0, 12)
).map(lambda row: np.array([row]))


@given(commands)
def test_float_command_is_byte_for_byte_the_packages(command):
    ours = codec(ids=(11,)).encode(command)[0]
    position, velocity, torque, kp, kd = command[0]
    theirs = moteus.Controller(id=11, position_resolution=INT8_LIMITS).make_position(
        position=wire(position / REVOLUTION),
        velocity=0.0,
        feedforward_torque=torque + kd * velocity,
        kp_scale=wire(kp * (REVOLUTION / SERVO_KP)),
        kd_scale=wire(kd * (REVOLUTION / SERVO_KD)),
        maximum_torque=18.0,
        watchdog_timeout=0.1,
        velocity_limit=-0.1,
        accel_limit=-0.05,
        query=True,
    )
    assert len(ours) == 48
    expected = pad(theirs.data)
    for mine, other in zip(values(ours), values(expected), strict=True):
        assert mine == pytest.approx(other, rel=2e-7, abs=1e-30)
    assert ours[:6] + ours[30:] == expected[:6] + expected[30:]
    assert theirs.destination == 11


def values(frame: bytes) -> tuple[float, ...]:
    return struct.unpack_from("<6f", frame, 6)


@given(commands)
def test_compact_command_means_the_same_within_half_a_step(command):
    ours = codec("compact", ids=(11,)).encode(command)[0]
    said = moteus.parse_registers(ours).command
    assert len(ours) == 32
    steps = {
        Register.COMMAND_POSITION: (command[0, 0] / REVOLUTION, 1e-4, 3.2767),
        Register.COMMAND_VELOCITY: (0.0, 2.5e-4, 8.19175),
        Register.COMMAND_TORQUE: (command[0, 2] + command[0, 4] * command[0, 1], 0.01, 327.67),
        Register.COMMAND_KP_SCALE: (command[0, 3] * REVOLUTION / SERVO_KP, 1 / 127, 1.0),
        Register.COMMAND_KD_SCALE: (command[0, 4] * REVOLUTION / SERVO_KD, 1 / 127, 1.0),
    }
    for register, (wanted, step, bound) in steps.items():
        assert said[register] == pytest.approx(max(-bound, min(bound, wanted)), abs=step * 0.5001)
    assert said[Register.COMMAND_WATCHDOG] == pytest.approx(0.1)
    assert said[Register.COMMAND_VELOCITY_LIMIT] < 0
    assert said[Register.COMMAND_ACCEL_LIMIT] < 0
    assert said[Register.MODE] == Mode.POSITION


@pytest.mark.parametrize(("form", "reply"), [("float", moteus.F32), ("compact", moteus.INT16)])
@given(
    mode=st.integers(0, 15),
    position=st.floats(-3, 3),
    velocity=st.floats(-8, 8),
    torque=st.floats(-50, 50),
    volts=st.integers(0, 50),
    celsius=st.integers(-20, 110),
    fault=st.sampled_from([0, 33, 38, 40, 102]),
)
@example(mode=10, position=0.0003, velocity=0.00075, torque=0.29, volts=20, celsius=30, fault=0)
@settings(max_examples=50)
def test_replies_written_by_the_package_decode(form, reply, mode, position, velocity, torque, volts, celsius, fault):
    ours = codec(form)
    data = package_reply(reply, mode, position, velocity, torque, volts, celsius, fault)
    si = ours.to_si(np.array([ours.decode(data)]))[0]
    assert si[[0, 4, 5, 6]].tolist() == [mode, volts, celsius, fault]
    step = 1.0 + 1e-9  # the package cuts towards zero: 0.29 N·m is 28.999999999999996 steps, and goes out as 28
    assert si[1] == pytest.approx(position * REVOLUTION, abs=1e-4 * REVOLUTION * step)
    assert si[2] == pytest.approx(velocity * REVOLUTION, abs=2.5e-4 * REVOLUTION * step)
    assert si[3] == pytest.approx(torque, abs=0.01 * step)


def package_reply(resolution, mode, position, velocity, torque, volts, celsius, fault) -> bytes:
    import io

    buffer = io.BytesIO()
    writer = Writer(buffer)
    for head in (0x21, Register.MODE, mode, 0x23 | resolution << 2, Register.POSITION):
        writer.write_int8(head)
    writer.write_position(position, resolution)
    writer.write_velocity(velocity, resolution)
    writer.write_torque(torque, resolution)
    writer.write_int8(0x23)
    writer.write_int8(Register.VOLTAGE)
    writer.write_voltage(volts, moteus.INT8)
    writer.write_temperature(celsius, moteus.INT8)
    writer.write_int8(fault)
    return pad(buffer.getvalue())


def test_not_set_decodes_to_nan():
    ours = codec("compact")
    data = package_reply(moteus.INT16, 10, math.nan, 0.0, 0.0, 20, 30, 0)
    si = ours.to_si(np.array([ours.decode(data)]))[0]
    assert math.isnan(si[1])
    assert si[4] == 20


def test_documented_pair_of_can_md():
    command = parse(bytes.fromhex("01000a07206000200150ff140400130d"))
    assert command.written == {
        0: 10,
        0x20: pytest.approx(0.0096),
        0x21: pytest.approx(0.072),
        0x22: pytest.approx(-1.76),
    }
    assert command.asked == [(0, 1), (1, 1), (2, 1), (3, 1), (13, 0), (14, 0), (15, 0)]
    reply = parse(bytes.fromhex("2404000a005000000170ff230d181400")).answered
    assert reply == {
        0: 10,
        1: pytest.approx(0.008),
        2: pytest.approx(0.064),
        3: pytest.approx(-1.44),
        13: 12.0,
        14: 20.0,
        15: 0,
    }


def test_reply_of_the_package_with_current_is_walked():
    data = bytes.fromhex("21000a2f010000003e000000bf0000504025041900230d302300")
    assert parse(data).answered == {0: 10, 1: 0.125, 2: -0.5, 3: 3.25, 4: 2.5, 13: 24.0, 14: 35.0, 15: 0}
    with pytest.raises(CorruptFrame, match="not the registers"):
        codec().decode(data)


def test_ids_follow_can_md():
    assert (command_id(11), reply_id(11)) == (0x800B, 0x0B00)
    assert codec().command_ids == [0x800B, 0x800C, 0x800D]


def test_stop_and_query_energise_nothing():
    ours = codec()
    assert parse(ours.stop[0]).written == {Register.MODE: Mode.STOPPED}
    assert parse(ours.query[0]).written == {}
    assert [register for register, _ in parse(ours.query[0]).asked] == [0, 1, 2, 3, 13, 14, 15]


@pytest.mark.parametrize("form", ["float", "compact"])
def test_no_frame_has_an_illegal_length_or_zero_padding(form):
    ours = codec(form)
    for frame in (*ours.encode(np.zeros((3, 5))), ours.stop[0], ours.query[0], encode_read(Register.MODEL_NUMBER, 3)):
        assert len(frame) in LEGAL_LENGTHS
        parse(frame)
    with pytest.raises(ValueError, match="64"):
        pad(bytes(65))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30])
@pytest.mark.parametrize("column", range(5))
def test_a_command_that_is_not_a_number_never_leaves(value, column):
    command = np.zeros((3, 5))
    command[1, column] = value
    with pytest.raises(ValueError, match="motor 12"):
        codec().encode(command)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ids": (0,)}, "id 0"),
        ({"ids": (127,)}, "id 127"),
        ({"max_torque": np.array([0.0])}, "max_torque"),
        ({"servo_kp": 0.0}, "servo_kp"),
        ({"servo_kd": math.nan}, "servo_kd"),
        ({"watchdog": math.nan}, "watchdog"),
        ({"watchdog": 5.0}, "watchdog"),
    ],
)
def test_settings_are_refused_by_name(change, message):
    arguments = {"ids": (11,), "max_torque": np.array([18.0]), "servo_kp": 200.0, "servo_kd": 10.0} | change
    with pytest.raises(ValueError, match=message):
        MoteusCodec(arguments.pop("ids"), **arguments)


def test_a_refused_register_is_named():
    with pytest.raises(CorruptFrame, match="0x00d unknown register"):
        codec().decode(bytes.fromhex("21000a310d01505050505050"))


@given(st.binary(max_size=64))
@settings(max_examples=400)
def test_any_bytes_decode_or_are_called_corrupt(data):
    for form in ("float", "compact"):
        try:
            reading = codec(form).decode(data)
        except CorruptFrame as error:
            assert str(error) and "\n" not in str(error)
        else:
            assert type(reading) is type(codec().decode(VALID_REPLY))


def test_a_subframe_of_no_registers_is_corrupt():
    """The package goes on behind it, in the middle of what was meant to follow."""
    with pytest.raises(CorruptFrame, match="no registers at byte 0"):
        parse(bytes.fromhex("10000a2f010000003e000000bf00005040230d302300"))


@given(st.data())
@settings(max_examples=200)
def test_mutated_frames_agree_with_the_package_where_both_accept(data):
    frame = bytearray(codec().encode(np.ones((3, 5)))[0] if data.draw(st.booleans()) else VALID_REPLY)
    for _ in range(data.draw(st.integers(1, 3))):
        frame[data.draw(st.integers(0, len(frame) - 1))] = data.draw(st.integers(0, 255))
    try:
        ours = parse(bytes(frame))
    except CorruptFrame:
        return
    if any(0x40 <= byte <= 0x44 for byte in frame):
        return  # streams carry text, not registers
    theirs = list(multiplex.parse_frame(bytes(frame)))
    registers = [item for item in theirs if isinstance(item, multiplex.RegisterSubframe)]
    assert {item.register for item in registers if item.type == multiplex.SubframeType.WRITE} == set(ours.written)
    assert {item.register for item in registers if item.type == multiplex.SubframeType.RESPONSE} == set(ours.answered)


VALID_REPLY = bytes.fromhex("21000a2f010000003e000000bf00005040230d302300")


def test_every_fault_has_a_name():
    assert all(name in describe_fault(code) for code, name in FAULTS.items())
    assert "watchdog" in describe_fault(Mode.TIMEOUT)
    assert "250" in describe_fault(250)
    assert codec().fault(Mode.FAULT, 38) == 38
    assert codec().fault(Mode.FAULT, 0) == Mode.FAULT
    assert codec().fault(Mode.TIMEOUT, 0) == Mode.TIMEOUT
