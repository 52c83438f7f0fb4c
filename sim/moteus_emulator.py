"""A moteus servo behind its frames: registers, modes, watchdog, latches, limits and faults, without any I/O.

Behaviour after mjbots ``fw/bldc_servo_control.h``, ``fw/moteus_controller.cc`` and ``docs/reference/configuration.md``.
It reads frames with the general walk of ``drivers.moteus_registers``, which the tests hold against the maker's package.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from drivers.errors import CorruptFrame
from drivers.moteus_registers import SCALES, UNSET, Mode, Register, encode_varuint, pad, parse
from sim.servo import LIMP, Drive

REVOLUTION = 2.0 * math.pi
_CODES = ("<b", "<h", "<i", "<f")
_MAX = (127, 32767, 2147483647)
_WRITABLE = {int(Register.MODE), *range(0x020, 0x02E)}
_TIMED = (Mode.POSITION, Mode.STAY_WITHIN)
_START_TIME = 0.002
_DAMPING_TORQUE = 5.0


@dataclass(slots=True)
class MoteusSettings:
    """The servo's own configuration."""

    kp: float = 200.0
    """N·m per revolution."""
    kd: float = 10.0
    """N·m per revolution/s."""
    timeout: float = 0.1
    """s, where a command says nothing."""
    position_min: float = math.nan
    """rev; NaN for none."""
    position_max: float = math.nan
    max_voltage: float = 46.0
    fault_temperature: float = 75.0
    """°C."""
    max_torque: float = 60.0
    accel_limit: float = 50.0
    """rev/s², where a command says nothing: the planner that surprises whoever wants plain tracking."""
    velocity_limit: float = 100.0
    """rev/s."""
    encoder_step: float = 1.0 / 16384 / 6
    """rev at the output: 14 bit behind a 6:1 gear."""


class MoteusEmulator:
    """One servo. The knobs may be turned at any time."""

    def __init__(self, motor: int, settings: MoteusSettings | None = None) -> None:
        self.id = motor
        self.settings = settings or MoteusSettings()
        self.voltage = 24.0
        self.stuck_encoder = False
        """Knob: the sensor says the same for ever, to the servo's own law too."""
        self.silent = False
        """Knob: it neither hears nor answers; its watchdog still runs."""
        self.firmware = 0x000106
        self.mode, self.fault = Mode.STOPPED, 0
        self.position, self.velocity, self.torque, self.temperature = 0.0, 0.0, 0.0, 30.0
        """rev, rev/s, N·m, °C."""
        self.watchdogs = 0
        """How often its watchdog ran out."""
        self._shift = 0.0
        self._command: dict[int, float] = {}
        self._commanded_at = self._energised_at = self._now = self._stepped = 0.0
        self._planned = math.nan

    @property
    def energised(self) -> bool:
        """See ``ServoEmulator.energised``."""
        return self.mode not in (Mode.STOPPED, Mode.FAULT)

    def restart(self, shift: float = 0.0) -> None:
        """Knob: the supply breaks down for a moment; it comes back stopped, its count off by ``shift`` rev."""
        self.mode, self.fault, self._command = Mode.STOPPED, 0, {}
        self._shift += shift
        self.position += shift

    def fail(self, fault: int) -> None:
        """Knob: the fault ``fault`` (register 0x00f) happens now."""
        self.mode, self.fault = Mode.FAULT, fault

    def answer(self, identifier: int, data: bytes, now: float) -> tuple[int, bytes] | None:
        """See ``ServoEmulator.answer``. A frame that does not parse is ignored, as the servo does."""
        if self.silent or identifier & 0x7F not in (self.id, 0x7F):
            return None
        self._advance(now)
        try:
            registers = parse(data)
        except CorruptFrame:
            return None
        errors = [register for register in registers.written if register not in _WRITABLE]
        self._obey({k: v for k, v in registers.written.items() if k in _WRITABLE})
        if not identifier & 0x8000:
            return None
        reply = self._reply(registers.asked) + b"".join(b"\x30" + encode_varuint(r) + b"\x02" for r in errors)
        return self.id << 8 | identifier >> 8 & 0x7F, pad(reply[:64])

    def step(self, now: float) -> Drive:
        """See ``ServoEmulator.step``."""
        elapsed, self._stepped = now - self._stepped, now
        self._advance(now)
        if self.mode in (Mode.TIMEOUT, Mode.ZERO_VELOCITY, Mode.BRAKE):
            return self._sensed(Drive(kd=min(self.settings.kd / REVOLUTION, _DAMPING_TORQUE)), math.inf)
        if self.mode != Mode.POSITION:
            return LIMP
        return self._position_mode(now, elapsed)

    def sense(self, position: float, velocity: float, torque: float, temperature: float) -> None:
        """See ``ServoEmulator.sense``."""
        self.torque, self.temperature = torque, temperature
        if not self.stuck_encoder:
            step = self.settings.encoder_step
            self.position = round(position / REVOLUTION / step) * step + self._shift
            self.velocity = velocity / REVOLUTION
        else:
            self.velocity = 0.0

    def _advance(self, now: float) -> None:
        self._now = now
        if self.mode in (Mode.STOPPED, Mode.FAULT):
            return
        self._check()
        if self.mode == Mode.ENABLING and now - self._energised_at >= _START_TIME:
            self.mode = Mode.POSITION

    def _obey(self, written: dict[int, float]) -> None:
        mode = written.pop(Register.MODE, None)
        if mode is None:
            self._command.update(written)
            return
        if mode == Mode.STOPPED:
            self.mode, self.fault, self._command = Mode.STOPPED, 0, {}
        elif self.mode not in (Mode.FAULT, Mode.TIMEOUT):
            self._command, self._commanded_at = written, self._now
            if mode == Mode.POSITION:
                self._energise()
            else:
                self.mode = Mode(int(mode)) if mode in Mode._value2member_map_ else self.mode

    def _energise(self) -> None:
        settings = self.settings
        if self.mode == Mode.STOPPED:
            if self.position < settings.position_min or self.position > settings.position_max:
                self.fail(39)
                return
            self.mode, self._energised_at, self._planned = Mode.ENABLING, self._now, self.position
        elif self.mode in (Mode.ZERO_VELOCITY, Mode.BRAKE, Mode.STAY_WITHIN):
            self.mode = Mode.POSITION

    def _check(self) -> None:
        if self.temperature > self.settings.fault_temperature:
            self.fail(38)
        elif self.voltage > self.settings.max_voltage:
            self.fail(34)
        elif self.voltage < 4.0:
            self.fail(40)
        elif self.mode in (*_TIMED, Mode.ENABLING) and self._now - self._commanded_at > self._watchdog():
            self.mode = Mode.TIMEOUT
            self.watchdogs += 1

    def _watchdog(self) -> float:
        asked = self._command.get(Register.COMMAND_WATCHDOG, 0.0)
        return math.inf if math.isnan(asked) else asked or self.settings.timeout

    def _position_mode(self, now: float, elapsed: float) -> Drive:
        command, settings = self._command, self.settings
        velocity = _or(command.get(Register.COMMAND_VELOCITY), 0.0)
        target = _or(command.get(Register.COMMAND_POSITION), self.position)
        target = self._plan(target + velocity * (now - self._commanded_at), elapsed)
        bound = min(_or(command.get(Register.COMMAND_MAX_TORQUE), settings.max_torque), settings.max_torque)
        torque = _or(command.get(Register.COMMAND_TORQUE), 0.0)
        drive = Drive(
            position=(target - self._shift) * REVOLUTION,
            velocity=velocity * REVOLUTION,
            torque=max(-bound, min(bound, torque)),
            kp=settings.kp / REVOLUTION * _or(command.get(Register.COMMAND_KP_SCALE), 1.0),
            kd=settings.kd / REVOLUTION * _or(command.get(Register.COMMAND_KD_SCALE), 1.0),
        )
        return self._sensed(drive, bound)

    def _sensed(self, drive: Drive, bound: float) -> Drive:
        """What the law makes of the servo's own sensor: with a stuck one a torque that no motion changes."""
        if not self.stuck_encoder:
            return drive
        error = drive.position - (self.position - self._shift) * REVOLUTION
        torque = drive.torque + drive.kp * error + drive.kd * (drive.velocity - self.velocity * REVOLUTION)
        return Drive(torque=max(-bound, min(bound, torque)))

    def _plan(self, target: float, elapsed: float) -> float:
        """The trajectory planner: off where both limits come negative, else it slows every change of position."""
        speed = _or(self._command.get(Register.COMMAND_VELOCITY_LIMIT), self.settings.velocity_limit)
        accel = _or(self._command.get(Register.COMMAND_ACCEL_LIMIT), self.settings.accel_limit)
        if (speed < 0.0 and accel < 0.0) or math.isnan(self._planned):
            self._planned = target
            return target
        way = target - self._planned
        fastest = min(
            speed if speed >= 0.0 else math.inf, math.sqrt(2.0 * accel * abs(way)) if accel >= 0 else math.inf
        )
        self._planned += math.copysign(min(abs(way), fastest * elapsed), way)
        return self._planned

    def _reply(self, asked: Sequence[tuple[int, int]]) -> bytes:
        reply, run = b"", b""
        first, count, previous = 0, 0, (-2, -1)
        for register, resolution in asked:
            read = _READABLE.get(register)
            value = None if read is None else read(self)
            if count and (value is None or (register, resolution) != (previous[0] + 1, previous[1])):
                reply, run, count = reply + _run(first, count, previous[1], run), b"", 0
            if value is None:
                reply += b"\x31" + encode_varuint(register) + b"\x01"
                continue
            first = first if count else register
            count, previous = count + 1, (register, resolution)
            run += _pack(register, resolution, value)
        return reply + _run(first, count, previous[1], run) if count else reply


def _or(value: float | None, default: float) -> float:
    return default if value is None or math.isnan(value) else value


def _run(first: int, count: int, resolution: int, values: bytes) -> bytes:
    head = bytes([0x20 | resolution << 2 | count]) if count < 4 else bytes([0x20 | resolution << 2, count])
    return head + encode_varuint(first) + values


def _pack(register: int, resolution: int, value: float) -> bytes:
    if resolution == 3:
        return struct.pack("<f", value)
    if math.isnan(value):
        return struct.pack(_CODES[resolution], UNSET[resolution])
    scales = SCALES.get(register)
    steps = round(value / scales[resolution]) if scales else int(value)
    return struct.pack(_CODES[resolution], max(-_MAX[resolution], min(_MAX[resolution], steps)))


_READABLE: dict[int, Callable[[MoteusEmulator], float]] = {
    int(register): read
    for register, read in {
        Register.MODE: lambda servo: float(servo.mode),
        Register.POSITION: lambda servo: servo.position,
        Register.VELOCITY: lambda servo: servo.velocity,
        Register.TORQUE: lambda servo: servo.torque,
        Register.Q_CURRENT: lambda servo: servo.torque / 0.6,
        Register.D_CURRENT: lambda _: 0.0,
        Register.MOTOR_TEMPERATURE: lambda _: math.nan,
        Register.VOLTAGE: lambda servo: servo.voltage,
        Register.TEMPERATURE: lambda servo: servo.temperature,
        Register.FAULT: lambda servo: float(servo.fault),
        Register.MODEL_NUMBER: lambda _: 1.0,
        Register.FIRMWARE_VERSION: lambda servo: float(servo.firmware),
        Register.REGISTER_MAP_VERSION: lambda _: 5.0,
        Register.SERIAL_NUMBER: lambda servo: float(0x1000 + servo.id),
    }.items()
}
