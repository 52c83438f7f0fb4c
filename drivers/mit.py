"""MIT mini-cheetah frames, sans-I/O: eight bytes of fixed point, spoken by T-Motor/CubeMars AK and Damiao motors.

Command: position 16 bit, velocity 12, kp 12, kd 12, torque 12, most significant first, each over the motor's own range
(CubeMars AK manual 1.0.18 p. 63; Damiao motor manual, MIT mode). Reply: motor id, position 16, velocity 12, torque 12,
then two bytes that differ by maker. There is no query: a motor answers commands, and the enable and disable frames. Nor
does a frame carry a watchdog: set the motor's own (CubeMars "CAN timeout", Damiao register TIMEOUT) when commissioning.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from drivers.errors import CorruptFrame
from drivers.moteus import Reading
from drivers.robot import Array

Maker = Literal["cubemars", "damiao"]

ENABLE = b"\xff\xff\xff\xff\xff\xff\xff\xfc"
DISABLE = b"\xff\xff\xff\xff\xff\xff\xff\xfd"
SET_ZERO = b"\xff\xff\xff\xff\xff\xff\xff\xfe"
KP_MAX, KD_MAX = 500.0, 5.0
"""N·m/rad and N·m·s/rad, the same for every motor."""


class Range(NamedTuple):
    """What full scale means: plus and minus this."""

    position: float
    """rad."""
    velocity: float
    """rad/s."""
    torque: float
    """N·m."""
    maker: Maker


RANGES = {
    "AK10-9": Range(12.5, 50.0, 65.0, "cubemars"),
    "AK40-10": Range(12.5, 45.5, 5.0, "cubemars"),
    "AK45-10": Range(12.5, 20.0, 8.0, "cubemars"),
    "AK45-36": Range(12.5, 6.0, 34.0, "cubemars"),
    "AK60-6": Range(12.5, 45.0, 15.0, "cubemars"),
    "AK70-10": Range(12.5, 50.0, 25.0, "cubemars"),
    "AK80-6": Range(12.5, 76.0, 12.0, "cubemars"),
    "AK80-8": Range(12.5, 37.5, 32.0, "cubemars"),
    "AK80-9": Range(12.5, 50.0, 18.0, "cubemars"),
    "AK80-64": Range(12.5, 8.0, 144.0, "cubemars"),
    "DM4310": Range(12.5, 30.0, 10.0, "damiao"),
    "DM4340": Range(12.5, 8.0, 28.0, "damiao"),
    "DM6006": Range(12.5, 45.0, 20.0, "damiao"),
    "DM8006": Range(12.5, 45.0, 40.0, "damiao"),
    "DM8009": Range(12.5, 45.0, 54.0, "damiao"),
}
"""Factory ranges by model. The ranges are settings of the motor: a changed one must be changed here too."""

CUBEMARS_FAULTS = {
    1: "motor over-temperature",
    2: "over-current",
    3: "over-voltage",
    4: "under-voltage",
    5: "encoder fault",
    6: "driver over-temperature",
    7: "motor stalled",
}
DAMIAO_FAULTS = {
    0: "disabled",
    8: "over-voltage",
    9: "under-voltage",
    10: "over-current",
    11: "driver over-temperature",
    12: "motor over-temperature",
    13: "lost communication",
    14: "overload",
}
_DAMIAO_ENABLED = 1
_DISABLED = 0
_LOST_COMMUNICATION = 13
_RUNNING = 10
_FAULT = 1
_HALF = 0.5 + 1e-9
"""Half a step rounds down: zero, which lies between two steps, becomes the 7fff 7ff of the makers' examples."""


def highest_id(model: str) -> int:
    """The highest CAN id that a motor of ``model`` can have.

    Raises:
        ValueError: an unknown model.
    """
    if model not in RANGES:
        raise ValueError(f"motors.model = {model!r}: the known ones are {', '.join(RANGES)}")
    return 15 if RANGES[model].maker == "damiao" else 126


class MitCodec:
    """Commands and replies of motors ``ids`` (1-15 for Damiao, 1-126 for CubeMars), all of one ``model``.

    Raises:
        ValueError: an unknown model or an id out of its bounds.
    """

    fd = False
    running = _RUNNING
    """Modes are named like moteus': 0 disabled, 1 fault, 10 running. A CubeMars motor does not tell: 10."""
    starting: tuple[int, ...] = (_DISABLED,)
    latches = frozenset([_LOST_COMMUNICATION])

    def __init__(self, ids: Sequence[int], *, model: str, host: int = 0) -> None:
        highest = highest_id(model)
        self.range = RANGES[model]
        for motor in ids:
            if not 1 <= motor <= highest:
                raise ValueError(f"motor id {motor}: 1 to {highest} for {model}")
        self.ids = tuple(ids)
        self.command_ids = list(ids)
        self.reply_ids = [host] * len(ids)
        self.query = [DISABLE] * len(ids)
        """The only question that energises nothing."""
        self.stop = [DISABLE] * len(ids)
        self.enable: list[bytes] | None = [ENABLE] * len(ids)
        full = np.array([self.range.position, self.range.velocity, self.range.torque])
        self._low = np.array([*-full, 0.0, 0.0])
        self._high = np.array([*full, KP_MAX, KD_MAX])
        self._steps = np.array([65535.0, 4095.0, 4095.0, 4095.0, 4095.0])
        self._per_unit = self._steps / (self._high - self._low)
        self.capacity = self._high
        """The most that a frame can carry of position rad, velocity rad/s, torque N·m, stiffness N·m/rad and damping
        N·m·s/rad; what is more is clipped. Shape (5,)."""
        self._scale = np.array([1.0, *(1.0 / self._per_unit[:3]), 1.0, 1.0, 1.0])
        self._bias = np.array([0.0, *self._low[:3], 0.0, 0.0, 0.0])
        self._decode = _decode_damiao if self.range.maker == "damiao" else _decode_cubemars

    def encode(self, commands: Array) -> list[bytes]:
        """One frame a motor.

        Args:
            commands: position rad, velocity rad/s, torque N·m, stiffness N·m/rad, damping N·m·s/rad; clipped to the
                motor's range. Shape (n, 5).

        Raises:
            ValueError: a value is not finite.
        """
        if not np.isfinite(commands).all():
            row, column = np.argwhere(~np.isfinite(commands))[0]
            raise ValueError(f"command to motor {self.ids[row]}: value {column} is {commands[row, column]}")
        clipped = np.clip(commands, self._low, self._high)
        steps = np.ceil((clipped - self._low) * self._per_unit - _HALF).astype(np.int64)
        words = steps[:, 0] << 48 | steps[:, 1] << 36 | steps[:, 3] << 24 | steps[:, 4] << 12 | steps[:, 2]
        data = words.astype(np.uint64).astype(">u8").tobytes()
        return [data[start : start + 8] for start in range(0, len(data), 8)]

    def motor_of(self, data: bytes) -> int:
        """Which motor sent a reply: its id is the first byte, since all answer to the host's arbitration id.

        Raises:
            CorruptFrame: an empty frame.
        """
        if not data:
            raise CorruptFrame("MIT reply without a byte")
        return data[0] & 0x0F if self.range.maker == "damiao" else data[0]

    def decode(self, data: bytes) -> Reading:
        """One reply, in wire units: mode, position, velocity, torque, voltage (NaN), temperature, fault.

        Raises:
            CorruptFrame: not 8 bytes (6 from the oldest CubeMars firmware).
        """
        if len(data) not in (6, 8) or (len(data) == 6 and self.range.maker == "damiao"):
            raise CorruptFrame(f"MIT reply {data.hex()}: 8 bytes are wanted")
        return self._decode(data)

    def to_si(self, readings: Array) -> Array:
        """Rows of ``decode`` with rad, rad/s, N·m and °C. Shape (n, 7)."""
        si: Array = readings * self._scale + self._bias
        return si

    def fault(self, mode: int, fault: int) -> int:
        """The fault code of a motor that is not running: its own one, or 1 where it gives none."""
        return fault or _FAULT

    def describe_fault(self, code: int) -> str:
        """A fault code in words."""
        names = DAMIAO_FAULTS if self.range.maker == "damiao" else CUBEMARS_FAULTS
        return f"fault {code}: {names.get(code, 'unknown')}"


def _decode_cubemars(data: bytes) -> Reading:
    word = int.from_bytes(data[1:6], "big")
    celsius, fault = (data[6], data[7]) if len(data) == 8 else (0, 0)
    temperature = float(celsius - 256 if celsius > 127 else celsius) if len(data) == 8 else np.nan
    mode = _FAULT if fault else _RUNNING
    return mode, word >> 24, word >> 12 & 0xFFF, word & 0xFFF, np.nan, temperature, fault


def _decode_damiao(data: bytes) -> Reading:
    word = int.from_bytes(data[1:6], "big")
    state = data[0] >> 4
    mode = _RUNNING if state == _DAMIAO_ENABLED else _FAULT if state else _DISABLED
    fault = 0 if state <= _DAMIAO_ENABLED else state
    return mode, word >> 24, word >> 12 & 0xFFF, word & 0xFFF, np.nan, max(data[6], data[7]), fault
