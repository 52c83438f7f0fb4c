"""The moteus register map and the walk over any of its frames.

Source: mjbots moteus ``docs/protocol/registers.md`` (map version 5) and ``docs/protocol/can.md`` (subframes). This is
the general, slow way to read a frame: for checks, commissioning and the emulator. The tick uses ``drivers.moteus``.
"""

from __future__ import annotations

import math
import struct
from enum import IntEnum
from typing import NamedTuple

from drivers.errors import CorruptFrame

LEGAL_LENGTHS: tuple[int, ...] = (*range(9), 12, 16, 20, 24, 32, 48, 64)
NOP = 0x50


class Mode(IntEnum):
    """Register 0x000."""

    STOPPED = 0
    FAULT = 1
    ENABLING = 2
    CALIBRATING = 3
    CALIBRATION_COMPLETE = 4
    PWM = 5
    VOLTAGE = 6
    VOLTAGE_FOC = 7
    VOLTAGE_DQ = 8
    CURRENT = 9
    POSITION = 10
    TIMEOUT = 11
    ZERO_VELOCITY = 12
    STAY_WITHIN = 13
    MEASURE_INDUCTANCE = 14
    BRAKE = 15


class Register(IntEnum):
    """The registers that this module names; see registers.md for the others."""

    MODE = 0x000
    POSITION = 0x001
    VELOCITY = 0x002
    TORQUE = 0x003
    Q_CURRENT = 0x004
    D_CURRENT = 0x005
    POWER = 0x007
    MOTOR_TEMPERATURE = 0x00A
    VOLTAGE = 0x00D
    TEMPERATURE = 0x00E
    FAULT = 0x00F
    COMMAND_POSITION = 0x020
    COMMAND_VELOCITY = 0x021
    COMMAND_TORQUE = 0x022
    COMMAND_KP_SCALE = 0x023
    COMMAND_KD_SCALE = 0x024
    COMMAND_MAX_TORQUE = 0x025
    COMMAND_STOP_POSITION = 0x026
    COMMAND_WATCHDOG = 0x027
    COMMAND_VELOCITY_LIMIT = 0x028
    COMMAND_ACCEL_LIMIT = 0x029
    MODEL_NUMBER = 0x100
    FIRMWARE_VERSION = 0x101
    REGISTER_MAP_VERSION = 0x102
    SERIAL_NUMBER = 0x120


FAULTS = {
    32: "calibration fault",
    33: "motor driver fault",
    34: "over-voltage",
    35: "encoder fault",
    36: "motor not configured",
    37: "pwm cycle overrun",
    38: "over-temperature",
    39: "outside position limits at start",
    40: "under-voltage",
    41: "configuration changed while running",
    42: "theta invalid",
    43: "position invalid",
    44: "driver enable fault",
    45: "stop position is deprecated",
    46: "timing violation",
    47: "bemf feed-forward without acceleration limit",
    48: "invalid limits",
    49: "position error",
    50: "velocity error",
}
"""Register 0x00f in mode 1."""

LIMITED_BY = {
    96: "velocity",
    97: "power",
    98: "bus voltage",
    99: "current",
    100: "board temperature",
    101: "motor temperature",
    102: "maximum torque",
    103: "position bounds",
    104: "flux brake",
    105: "field weakening",
}
"""Register 0x00f in mode 10: not a fault, what limits the torque at the moment."""

READ_ERRORS = {1: "unknown register", 2: "read-only register"}

_POSITION, _VELOCITY, _TORQUE, _GAIN = (
    (0.01, 1e-4, 1e-5),
    (0.1, 2.5e-4, 1e-5),
    (0.5, 0.01, 1e-3),
    (
        1 / 127,
        1 / 32767,
        1 / 2147483647,
    ),
)
_VOLTAGE, _TEMPERATURE, _CURRENT, _TIME = (0.5, 0.1, 1e-3), (1.0, 0.1, 1e-3), (1.0, 0.1, 1e-3), (0.01, 1e-3, 1e-6)
SCALES: dict[int, tuple[float, float, float]] = {
    Register.POSITION: _POSITION,
    Register.VELOCITY: _VELOCITY,
    Register.TORQUE: _TORQUE,
    Register.Q_CURRENT: _CURRENT,
    Register.D_CURRENT: _CURRENT,
    Register.POWER: (10.0, 0.05, 1e-4),
    Register.MOTOR_TEMPERATURE: _TEMPERATURE,
    Register.VOLTAGE: _VOLTAGE,
    Register.TEMPERATURE: _TEMPERATURE,
    Register.COMMAND_POSITION: _POSITION,
    Register.COMMAND_VELOCITY: _VELOCITY,
    Register.COMMAND_TORQUE: _TORQUE,
    Register.COMMAND_KP_SCALE: _GAIN,
    Register.COMMAND_KD_SCALE: _GAIN,
    Register.COMMAND_MAX_TORQUE: _TORQUE,
    Register.COMMAND_STOP_POSITION: _POSITION,
    Register.COMMAND_WATCHDOG: _TIME,
    Register.COMMAND_VELOCITY_LIMIT: _VELOCITY,
    Register.COMMAND_ACCEL_LIMIT: (0.05, 1e-3, 1e-5),
}
"""Value of one step of int8, int16 and int32 for the registers that are scaled; the others are plain integers."""

_VALUES = (struct.Struct("<b"), struct.Struct("<h"), struct.Struct("<i"), struct.Struct("<f"))
UNSET = (-128, -32768, -2147483648)


def describe_fault(code: int) -> str:
    """A fault code of ``JointState.fault`` in words: the servo's own (32 up) or the mode it is in instead of ours."""
    if code in FAULTS:
        return f"fault {code}: {FAULTS[code]}"
    if code in LIMITED_BY:
        return f"limited by {LIMITED_BY[code]}"
    if code == Mode.TIMEOUT:
        return "mode 11: its watchdog ran out; it obeys nothing but stop"
    if code in Mode._value2member_map_:
        return f"mode {code}: {Mode(code).name.lower().replace('_', ' ')}"
    return f"unknown fault {code}"


def pad(data: bytes) -> bytes:
    """``data`` filled with NOP to the next length that CAN-FD can carry.

    Raises:
        ValueError: longer than 64 bytes.
    """
    for length in LEGAL_LENGTHS:
        if len(data) <= length:
            return data + bytes([NOP]) * (length - len(data))
    raise ValueError(f"a frame of {len(data)} bytes: CAN-FD carries 64")


class Registers(NamedTuple):
    """What one frame says, in the units of registers.md; a value is NaN where the sender says "not set"."""

    written: dict[int, float]
    """Registers that a command sets."""
    answered: dict[int, float]
    """Registers that a reply reports."""
    asked: list[tuple[int, int]]
    """(register, resolution 0-3) that a command wants to know, in order."""
    errors: dict[int, int]
    """Register → error code."""


def parse(data: bytes) -> Registers:
    """Walk over the subframes of any frame, command or reply. Not for the tick: ``MoteusCodec.decode`` is.

    Raises:
        CorruptFrame: an unknown subframe, or one that is cut off.
    """
    registers = Registers({}, {}, [], {})
    offset = 0
    try:
        while offset < len(data):
            offset = _parse_subframe(data, offset, registers)
    except (IndexError, struct.error) as error:
        raise CorruptFrame(f"moteus frame {data.hex()} is cut off") from error
    return registers


def _parse_subframe(data: bytes, offset: int, registers: Registers) -> int:
    kind, offset = data[offset], offset + 1
    if kind == NOP:
        return offset
    if kind < 0x30:
        return _parse_values(data, offset, kind, registers)
    if kind in (0x30, 0x31):
        register, offset = _varuint(data, offset)
        registers.errors[register], offset = _varuint(data, offset)
        return offset
    if kind in (0x40, 0x41, 0x42, 0x43, 0x44):
        return _skip_stream(data, offset, kind)
    raise CorruptFrame(f"moteus frame {data.hex()}: unknown subframe 0x{kind:02x} at byte {offset - 1}")


def _parse_values(data: bytes, offset: int, kind: int, registers: Registers) -> int:
    resolution, count = kind >> 2 & 3, kind & 3
    if count == 0:
        count, offset = _varuint(data, offset)
        if count == 0:
            raise CorruptFrame(f"moteus frame {data.hex()}: a subframe of no registers at byte {offset - 2}")
    first, offset = _varuint(data, offset)
    if kind & 0x30 == 0x10:
        if count > 64:
            raise CorruptFrame(f"moteus frame {data.hex()}: asks for {count} registers, 64 fit")
        registers.asked.extend((register, resolution) for register in range(first, first + count))
        return offset
    target = registers.answered if kind & 0x30 == 0x20 else registers.written
    layout = _VALUES[resolution]
    for register in range(first, first + count):
        target[register] = _scale(register, resolution, layout.unpack_from(data, offset)[0])
        offset += layout.size
    return offset


def _scale(register: int, resolution: int, value: float) -> float:
    scales = SCALES.get(register)
    if resolution == 3 or scales is None:
        return value
    return math.nan if value == UNSET[resolution] else value * scales[resolution]


def _varuint(data: bytes, offset: int) -> tuple[int, int]:
    result = 0
    for shift in range(0, 35, 7):
        byte = data[offset]
        offset += 1
        result |= (byte & 0x7F) << shift
        if byte < 0x80:
            return result, offset
    raise CorruptFrame(f"moteus frame {data.hex()}: number longer than 5 bytes at byte {offset - 5}")


def _skip_stream(data: bytes, offset: int, kind: int) -> int:
    _, offset = _varuint(data, offset)
    if kind in (0x43, 0x44):
        _, offset = _varuint(data, offset)
    length, offset = _varuint(data, offset)
    if kind in (0x42, 0x44):
        return offset
    if offset + length > len(data):
        raise CorruptFrame(f"moteus frame {data.hex()} is cut off")
    return offset + length


def encode_varuint(value: int) -> bytes:
    """``value`` in groups of seven bits, least first."""
    result = bytearray()
    while value >= 0x80:
        result.append(value & 0x7F | 0x80)
        value >>= 7
    result.append(value)
    return bytes(result)


def encode_read(first: int, count: int, resolution: int = 2) -> bytes:
    """A query for ``count`` registers from ``first``, int32 unless told otherwise; padded."""
    head = bytes([0x10 | resolution << 2 | count]) if count < 4 else bytes([0x10 | resolution << 2, count])
    return pad(head + encode_varuint(first))
