"""A motor that speaks the MIT protocol, behind its frames: enable, disable, faults, the makers' different replies."""

from __future__ import annotations

from drivers.mit import DISABLE, ENABLE, KD_MAX, KP_MAX, RANGES, SET_ZERO
from sim.servo import LIMP, Drive

_DAMIAO_ENABLED = 1


class MitEmulator:
    """One motor of ``model``. The knobs may be turned at any time."""

    def __init__(self, motor: int, model: str, host: int = 0, timeout: float = 0.1) -> None:
        """``timeout`` is the motor's own setting: s without a command after which it disables itself."""
        self.id, self.host, self.timeout = motor, host, timeout
        self.range = RANGES[model]
        self.silent = False
        """Knob: it neither hears nor answers."""
        self.fault = 0
        """Knob: the maker's fault code; it gives no torque while it is not 0."""
        self.stuck_encoder = False
        """Knob: the sensor says the same for ever, to the motor's own law too."""
        self.enabled = False
        self.position, self.velocity, self.torque, self.temperature = 0.0, 0.0, 0.0, 30.0
        self._zero = 0.0
        self._drive = LIMP
        self._commanded_at = 0.0

    @property
    def energised(self) -> bool:
        """See ``ServoEmulator.energised``."""
        return self.enabled

    def answer(self, identifier: int, data: bytes, now: float) -> tuple[int, bytes] | None:
        """See ``ServoEmulator.answer``."""
        if self.silent or identifier != self.id or len(data) != 8:
            return None
        self.step(now)
        self._commanded_at = now
        if data == ENABLE:
            self.enabled, self._drive = True, LIMP
        elif data == DISABLE:
            self.enabled = False
            reply, self.fault = self._reply(), 0  # it tells once what it then forgets
            return self.host, reply
        elif data == SET_ZERO:
            self._zero, self.position = self._zero + self.position, 0.0
        else:
            self._drive = self._unpack(data)
        return self.host, self._reply()

    def step(self, now: float) -> Drive:
        """See ``ServoEmulator.step``."""
        if self.enabled and now - self._commanded_at > self.timeout:
            self.enabled = False
            self.fault = 13 if self.range.maker == "damiao" else 0
        if not self.enabled or self.fault:
            return LIMP
        drive = self._drive
        if self.stuck_encoder:
            torque = drive.torque + drive.kp * (drive.position - self.position) + drive.kd * drive.velocity
            return Drive(torque=max(-self.range.torque, min(self.range.torque, torque)))
        return drive._replace(position=drive.position + self._zero)

    def sense(self, position: float, velocity: float, torque: float, temperature: float) -> None:
        """See ``ServoEmulator.sense``."""
        if self.stuck_encoder:
            self.velocity = 0.0
        else:
            self.position, self.velocity = position - self._zero, velocity
        self.torque, self.temperature = torque, temperature

    def _unpack(self, data: bytes) -> Drive:
        word, span = int.from_bytes(data, "big"), self.range

        def field(shift: int, bits: int, low: float, high: float) -> float:
            return low + (word >> shift & (1 << bits) - 1) * (high - low) / ((1 << bits) - 1)

        return Drive(
            position=field(48, 16, -span.position, span.position),
            velocity=field(36, 12, -span.velocity, span.velocity),
            kp=field(24, 12, 0.0, KP_MAX),
            kd=field(12, 12, 0.0, KD_MAX),
            torque=field(0, 12, -span.torque, span.torque),
        )

    def _reply(self) -> bytes:
        span = self.range
        damiao = span.maker == "damiao"
        state = self.fault or (_DAMIAO_ENABLED if self.enabled else 0)
        word = self.id | (state << 4 if damiao else 0)
        for value, full, bits in (
            (self.position, span.position, 16),
            (self.velocity, span.velocity, 12),
            (self.torque, span.torque, 12),
        ):
            share = (max(-full, min(full, value)) + full) / (2 * full)
            word = word << bits | round(share * ((1 << bits) - 1))
        celsius = round(self.temperature) & 0xFF
        return word.to_bytes(6, "big") + bytes([celsius, celsius if damiao else self.fault])
