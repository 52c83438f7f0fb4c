"""Who is on the buses: every moteus servo that answers, as it is, before anybody believes any table."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from drivers.bus import Bus, Frame
from drivers.errors import CorruptFrame
from drivers.moteus import REVOLUTION, command_id
from drivers.moteus_registers import Mode, Register, describe_fault, encode_varuint, pad, parse

ALL_IDS = range(1, 127)
SURVEY_TIME = 0.02
"""s that a group of servos may take to answer."""
_GROUP = 8
_TRIES = 2
_QUESTION = pad(bytes.fromhex("11001f01130d") + b"\x19" + encode_varuint(Register.FIRMWARE_VERSION))


@dataclass(frozen=True, slots=True)
class FoundMotor:
    """One servo that answered."""

    bus: int
    """Counted from 1."""
    id: int
    mode: int
    fault: int
    position: float
    """Of its output, rad."""
    voltage: float
    temperature: float
    firmware: str
    replies: int
    """To one question; more than one means that two servos share the id."""

    @property
    def state(self) -> str:
        """Mode and fault in words."""
        return describe_fault(self.fault if self.mode == Mode.FAULT else self.mode)


async def survey(bus: Bus, buses: Iterable[int], ids: Iterable[int] = ALL_IDS) -> list[FoundMotor]:
    """Ask every id on every bus (from 1) how it is; energises nothing. Opens and closes ``bus``.

    Raises:
        DriverError: a bus cannot be opened.
    """
    places = [(number, motor) for motor in ids for number in buses]
    answers: dict[tuple[int, int], list[bytes]] = {}

    def receive(index: int, identifier: int, data: bytes) -> bool:
        place = (index + 1, identifier >> 8 & 0x7F)
        if not identifier & 0x80FF and place in pending:
            answers.setdefault(place, []).append(data)
        return False

    pending: set[tuple[int, int]] = set()
    await bus.open(receive)
    try:
        for _ in range(_TRIES):
            missing = [place for place in places if place not in answers]
            width = _GROUP * max(1, len({number for number, _ in places}))
            for start in range(0, len(missing), width):
                pending = set(missing[start : start + width])
                frames: list[Frame] = [(number - 1, command_id(motor), _QUESTION) for number, motor in pending]
                await bus.cycle(frames, SURVEY_TIME)
    finally:
        await bus.close()
    found = (_read(place, data) for place, data in sorted(answers.items()))
    return [motor for motor in found if motor is not None]


def _read(place: tuple[int, int], answers: list[bytes]) -> FoundMotor | None:
    try:
        said = parse(answers[0]).answered
    except CorruptFrame:
        return None
    version = int(said.get(Register.FIRMWARE_VERSION, 0))
    return FoundMotor(
        *place,
        mode=int(said.get(Register.MODE, 0)),
        fault=int(said.get(Register.FAULT, 0)),
        position=said.get(Register.POSITION, math.nan) * REVOLUTION,
        voltage=said.get(Register.VOLTAGE, math.nan),
        temperature=said.get(Register.TEMPERATURE, math.nan),
        firmware=f"{version >> 16 & 0xFF}.{version >> 8 & 0xFF}.{version & 0xFF}",
        replies=len(answers),
    )
