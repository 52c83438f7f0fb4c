"""moteus frames, sans-I/O: twelve position-mode commands out in one go, replies in by precompiled layouts.

Facts: mjbots moteus ``docs/protocol/can.md`` (frames) and ``fw/bldc_servo_control.h`` (behaviour). A servo speaks
revolutions and multiples of its own gains; both stop at this module, whose callers see radians, N·m and N·m/rad at the
motor's output.

Four traps that every command disarms: a servo moves its position target along with the commanded velocity, so the
velocity's share of the law goes out as feed-forward torque and the velocity as 0, which is the law of
``drivers.robot.motor_torque`` to the letter; it carries its own watchdog (never NaN, which would mean none); it sends
negative velocity and acceleration limits, because newer firmware otherwise plans a slow trajectory of its own; it is
padded with NOP, because zero padding reads as a write.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drivers.errors import CorruptFrame
from drivers.moteus_registers import READ_ERRORS, Mode, describe_fault, pad, parse
from drivers.robot import Array
from drivers.wiring import Format

Reading = tuple[float, float, float, float, float, float, float]
"""mode, position, velocity, torque, voltage, temperature, fault in wire units; ``MoteusCodec.to_si`` makes them SI."""

Frames = NDArray[np.void]

REVOLUTION = 2.0 * math.pi
REPLY_WANTED = 0x8000
BROADCAST = 0x7F


def command_id(motor: int, host: int = 0) -> int:
    """Arbitration id of a command to servo ``motor`` that wants a reply (can.md: source, destination)."""
    return REPLY_WANTED | host << 8 | motor


def reply_id(motor: int, host: int = 0) -> int:
    """Arbitration id of the reply of servo ``motor``."""
    return motor << 8 | host


_QUERY = {"float": bytes.fromhex("11001f01130d"), "compact": bytes.fromhex("11001701130d")}
"""int8 mode; position, velocity, torque; int8 voltage, temperature, fault."""
_REPLY = {
    "float": (struct.Struct("<HbHfffHbbb"), (0x0021, 0x012F, 0x0D23)),
    "compact": (struct.Struct("<HbHhhhHbbb"), (0x0021, 0x0127, 0x0D23)),
}
_WIRE_UNITS = {
    "float": np.array([1.0, REVOLUTION, REVOLUTION, 1.0, 0.5, 1.0, 1.0]),
    "compact": np.array([1.0, 1e-4 * REVOLUTION, 2.5e-4 * REVOLUTION, 0.01, 0.5, 1.0, 1.0]),
}
_NOT_SET = {
    "float": np.array([np.inf, np.inf, np.inf, np.inf, -128.0, -128.0, np.inf]),
    "compact": np.array([np.inf, -32768.0, -32768.0, -32768.0, -128.0, -128.0, np.inf]),
}
_NO_LIMIT = -1
_VELOCITY, _TORQUE, _KD = 1, 2, 4
_MAX16, _MAX8 = 32767, 127
_ABSURD = 1e6
_CAPACITY = {
    "float": np.full(5, np.inf),
    "compact": np.array([1e-4 * _MAX16, 2.5e-4 * _MAX16, 0.01 * _MAX16, 1.0, 1.0]),
}
"""Revolutions, revolutions/s, N·m, and multiples of the servo's own two gains."""


class MoteusCodec:
    """Commands and replies of the servos ``ids``, in that order.

    Args:
        ids: CAN ids of the servos, 1-126.
        max_torque: bound that goes out with every command, N·m at the motor. Shape (n,).
        servo_kp: ``servo.pid_position.kp`` that the servos are configured with, N·m per revolution.
        servo_kd: ``servo.pid_position.kd`` that the servos are configured with, N·m per revolution/s.
        watchdog: s without a command after which a servo goes limp by itself.
        form: ``float`` (48 byte commands, 24 byte replies) or ``compact`` (32 and 16; gains up to the configured ones).

    Raises:
        ValueError: an id, a torque, a gain or a watchdog out of its bounds.
    """

    fd = True
    running = int(Mode.POSITION)
    """The mode in which a servo obeys; from 0 a command passes through 2, 3 and 4 to it."""
    starting: tuple[int, ...] = (0, 2, 3, 4)
    latches = frozenset(range(int(Mode.PWM), int(Mode.BRAKE) + 1))

    def __init__(
        self,
        ids: Sequence[int],
        *,
        max_torque: Array,
        servo_kp: float,
        servo_kd: float,
        watchdog: float = 0.1,
        form: Format = "float",
        host: int = 0,
    ) -> None:
        _check_settings(ids, max_torque, servo_kp, servo_kd, watchdog)
        self.ids = tuple(ids)
        self.form = form
        self.command_ids = [command_id(motor, host) for motor in ids]
        self.reply_ids = [reply_id(motor, host) for motor in ids]
        self.query = [pad(_QUERY[form])] * len(ids)
        self.stop = [pad(b"\x01\x00\x00" + _QUERY[form])] * len(ids)
        self.enable: list[bytes] | None = None
        self.capacity = _CAPACITY[form] * [REVOLUTION, REVOLUTION, 1.0, servo_kp / REVOLUTION, servo_kd / REVOLUTION]
        """The most that a frame can carry of position rad, velocity rad/s, torque N·m, stiffness N·m/rad and damping
        N·m·s/rad at the motor's output; what is more is clipped. Shape (5,)."""
        self._layout, (self._head1, self._head2, self._head3) = _REPLY[form]
        self._units, self._not_set = _WIRE_UNITS[form], _NOT_SET[form]
        to_wire = np.array([1 / REVOLUTION, 1 / REVOLUTION, 1.0, REVOLUTION / servo_kp, REVOLUTION / servo_kd])
        if form == "float":
            self._to_wire = to_wire
            self._buffer, frames = _float_frames(max_torque, watchdog)
        else:
            self._to_wire = to_wire / [1e-4, 2.5e-4, 0.01, 1 / 127, 1 / 127]
            self._buffer, frames = _compact_frames(max_torque, watchdog)
            self._gains = frames["gains"]
        self._values = frames["values"]
        self._parts = [slice(start, start + frames.itemsize) for start in range(0, len(self._buffer), frames.itemsize)]
        self._damping_to_wire = self._to_wire[_TORQUE] / self._to_wire[_VELOCITY]
        self._wire, self._damped = np.empty((len(ids), 5)), np.empty(len(ids))

    def encode(self, commands: Array) -> list[bytes]:
        """Position-mode commands with a query behind each, one frame a servo.

        Args:
            commands: position rad, velocity rad/s, torque N·m, stiffness N·m/rad, damping N·m·s/rad at the motor's
                output. Shape (n, 5).

        Raises:
            ValueError: a value is not finite (a servo would read NaN as "hold" or "full gain"), or absurd.
        """
        wire, damped = self._wire, self._damped
        np.absolute(commands, wire)
        if not wire.max() < _ABSURD:
            row, column = np.argwhere(~(wire < _ABSURD))[0]
            raise ValueError(f"command to motor {self.ids[row]}: value {column} is {commands[row, column]}")
        np.multiply(commands, self._to_wire, wire)
        np.multiply(wire[:, _VELOCITY], commands[:, _KD], damped)
        damped *= self._damping_to_wire
        wire[:, _TORQUE] += damped
        wire[:, _VELOCITY] = 0.0
        if self.form == "float":
            self._values[:] = wire
        else:
            np.rint(wire, wire)
            self._values[:] = np.clip(wire[:, :3], -_MAX16, _MAX16)
            self._gains[:] = np.clip(wire[:, 3:], -_MAX8, _MAX8)
        data = bytes(self._buffer)
        return [data[part] for part in self._parts]

    def motor_of(self, data: bytes) -> None:
        """The arbitration id of a reply tells its sender, not the data."""

    def decode(self, data: bytes) -> Reading:
        """One reply, in wire units.

        Raises:
            CorruptFrame: not the reply to our query; names the registers that the servo refused.
        """
        layout = self._layout
        if len(data) >= layout.size:
            head1, mode, head2, position, velocity, torque, head3, voltage, temperature, fault = layout.unpack_from(
                data
            )
            if head1 == self._head1 and head2 == self._head2 and head3 == self._head3:
                return mode, position, velocity, torque, voltage, temperature, fault
        raise CorruptFrame(_explain(data))

    def to_si(self, readings: Array) -> Array:
        """Rows of ``decode`` with rad, rad/s, N·m, V and °C; NaN where a servo says "not set". Shape (n, 7)."""
        si: Array = readings * self._units
        unset = readings == self._not_set
        if unset.any():
            si[unset] = np.nan
        return si

    describe_fault = staticmethod(describe_fault)

    def fault(self, mode: int, fault: int) -> int:
        """The fault code of a servo that is not in position mode: its own one (32 up), else the mode that it is in."""
        return fault or mode if mode == Mode.FAULT else mode


def _check_settings(ids: Sequence[int], max_torque: Array, servo_kp: float, servo_kd: float, watchdog: float) -> None:
    for motor in ids:
        if not 1 <= motor < BROADCAST:
            raise ValueError(f"moteus id {motor}: 1 to {BROADCAST - 1}")
    if len(max_torque) != len(ids) or not (np.isfinite(max_torque).all() and (max_torque > 0).all()):
        raise ValueError(f"max_torque {max_torque}: one positive N·m for each of {len(ids)} servos")
    for name, value in (("servo_kp", servo_kp), ("servo_kd", servo_kd)):
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name} = {value}: must be finite and above 0")
    if not 0.01 <= watchdog <= 1.0:
        raise ValueError(f"watchdog = {watchdog} s: 0.01 to 1.0 (a servo that keeps going without us is no option)")


def _explain(data: bytes) -> str:
    registers = parse(data)
    if registers.errors:
        refused = ", ".join(f"0x{r:03x} {READ_ERRORS.get(code, code)}" for r, code in registers.errors.items())
        return f"moteus reply {data.hex()}: the servo refuses {refused}"
    return f"moteus reply {data.hex()}: not the registers that were asked"


def _template(head: bytes, *parts: bytes) -> bytes:
    return pad(head + b"".join(parts))


def _float_frames(max_torque: Array, watchdog: float) -> tuple[bytearray, Frames]:
    """``01 00 0a`` mode, ``0c 06 20`` six floats, ``0d 27`` watchdog, ``02 28`` two int8 limits, then the query: 48."""
    head = b"\x01\x00\x0a\x0c\x06\x20" + bytes(24)
    data = _template(head, b"\x0d\x27", struct.pack("<f", watchdog), _limits(), _QUERY["float"])
    dtype = np.dtype(
        {"names": ["values", "max_torque"], "formats": ["(5,)<f4", "<f4"], "offsets": [6, 26], "itemsize": len(data)}
    )
    buffer = bytearray(data * len(max_torque))
    frames: Frames = np.frombuffer(buffer, dtype)
    frames["max_torque"] = max_torque
    return buffer, frames


def _compact_frames(max_torque: Array, watchdog: float) -> tuple[bytearray, Frames]:
    """``07 20`` three int16, ``02 23`` two int8 gains, ``05 25`` int16 torque, ``03 27`` watchdog and limits: 32."""
    head = b"\x01\x00\x0a\x07\x20" + bytes(6) + b"\x02\x23" + bytes(2) + b"\x05\x25" + bytes(2)
    data = _template(
        head, b"\x03\x27", struct.pack("<3b", round(watchdog * 100), _NO_LIMIT, _NO_LIMIT), _QUERY["compact"]
    )
    dtype = np.dtype(
        {
            "names": ["values", "gains", "max_torque"],
            "formats": ["(3,)<i2", "(2,)i1", "<i2"],
            "offsets": [5, 13, 17],
            "itemsize": len(data),
        }
    )
    buffer = bytearray(data * len(max_torque))
    frames: Frames = np.frombuffer(buffer, dtype)
    frames["max_torque"] = np.clip(np.rint(max_torque / 0.01), 1, _MAX16)
    return buffer, frames


def _limits() -> bytes:
    return b"\x02\x28" + struct.pack("<2b", _NO_LIMIT, _NO_LIMIT)
