"""Who is on the buses: every motor that answers, as it is, before anybody believes any table."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from drivers.bus import Bus, Frame
from drivers.errors import CorruptFrame
from drivers.mit import DISABLE, MitCodec, highest_id
from drivers.moteus import REVOLUTION, command_id
from drivers.moteus_registers import Mode, Register, describe_fault, encode_varuint, pad, parse
from drivers.wiring import MotorsConfig

ALL_IDS = range(1, 127)
SURVEY_TIME = 0.02
"""s that a group of motors may take to answer."""
_GROUP = 8
_TRIES = 3
_MOTEUS_QUESTION = pad(bytes.fromhex("11001f01130d") + b"\x19" + encode_varuint(Register.FIRMWARE_VERSION))
_MIT_HOST = 0


@dataclass(frozen=True, slots=True)
class FoundMotor:
    """One motor that answered."""

    bus: int
    """Counted from 1."""
    id: int
    mode: int
    """As moteus names them: 0 stopped, 1 fault, 10 running, and so on."""
    state: str
    """Mode and fault in words."""
    position: float
    """As it reports it, rad."""
    voltage: float
    """V; NaN where its protocol does not tell."""
    temperature: float
    """°C; NaN where it does not tell."""
    firmware: str
    """Empty where its protocol does not tell."""
    replies: int
    """To one question; more than one means that two motors share the id."""


class Question(Protocol):
    """How one protocol is asked without energising anything."""

    ids: range
    """All that a motor of this protocol can have."""

    def frame(self, motor: int) -> tuple[int, bytes]:
        """Arbitration id and data."""
        ...

    def sender(self, identifier: int, data: bytes) -> int | None:
        """Whose reply a frame is; None where it is none."""
        ...

    def read(self, bus: int, motor: int, answers: Sequence[bytes]) -> FoundMotor:
        """What the answers of one motor say.

        Raises:
            CorruptFrame: nothing that is understood.
        """
        ...


class MoteusQuestion:
    """A query with the firmware's version behind it."""

    ids = ALL_IDS

    def frame(self, motor: int) -> tuple[int, bytes]:
        """See ``Question.frame``."""
        return command_id(motor), _MOTEUS_QUESTION

    def sender(self, identifier: int, data: bytes) -> int | None:
        """See ``Question.sender``."""
        return None if identifier & 0x80FF else identifier >> 8 & 0x7F

    def read(self, bus: int, motor: int, answers: Sequence[bytes]) -> FoundMotor:
        """See ``Question.read``."""
        said = parse(answers[0]).answered
        mode, fault = (_whole(said.get(register, 0.0)) for register in (Register.MODE, Register.FAULT))
        version = _whole(said.get(Register.FIRMWARE_VERSION, 0.0))
        return FoundMotor(
            bus,
            motor,
            mode=mode,
            state=describe_fault(fault if mode == Mode.FAULT else mode),
            position=said.get(Register.POSITION, math.nan) * REVOLUTION,
            voltage=said.get(Register.VOLTAGE, math.nan),
            temperature=said.get(Register.TEMPERATURE, math.nan),
            firmware=f"{version >> 16 & 0xFF}.{version >> 8 & 0xFF}.{version & 0xFF}",
            replies=len(answers),
        )


class MitQuestion:
    """The disable frame: all that an MIT motor answers without being energised. It also ends a fault that it tells.

    Raises:
        ValueError: an unknown model.
    """

    def __init__(self, model: str) -> None:
        self._codec = MitCodec([1], model=model, host=_MIT_HOST)
        self.ids = range(1, highest_id(model) + 1)

    def frame(self, motor: int) -> tuple[int, bytes]:
        """See ``Question.frame``."""
        return motor, DISABLE

    def sender(self, identifier: int, data: bytes) -> int | None:
        """See ``Question.sender``."""
        return self._codec.motor_of(data) if identifier == _MIT_HOST and data else None

    def read(self, bus: int, motor: int, answers: Sequence[bytes]) -> FoundMotor:
        """See ``Question.read``."""
        reading = self._codec.decode(answers[0])
        (si,) = self._codec.to_si(np.array([reading]))
        mode, fault = int(reading[0]), int(reading[6])
        faulty = mode == Mode.FAULT
        return FoundMotor(
            bus,
            motor,
            mode=int(Mode.FAULT if faulty else Mode.STOPPED),  # a CubeMars motor tells none, and was just disabled
            state=self._codec.describe_fault(fault) if faulty else "disabled",
            position=float(si[1]),
            voltage=math.nan,
            temperature=float(si[5]),
            firmware="",
            replies=len(answers),
        )


def build_question(motors: MotorsConfig) -> Question:
    """How the motors of ``motors`` are asked.

    Raises:
        ValueError: an unknown model.
    """
    return MitQuestion(motors.model) if motors.protocol == "mit" else MoteusQuestion()


async def survey(
    bus: Bus, buses: Iterable[int], question: Question, ids: Iterable[int] | None = None
) -> list[FoundMotor]:
    """Ask every id on every bus (from 1) how it is; energises nothing. Opens and closes ``bus``.

    Args:
        bus: back-end, closed.
        buses: numbers from 1.
        question: of the motors' protocol.
        ids: which are tried; all that the protocol has where none are named.

    Raises:
        DriverError: a bus cannot be opened.
    """
    places = [(number, motor) for motor in (question.ids if ids is None else ids) for number in buses]
    answers: dict[tuple[int, int], list[bytes]] = {}

    def receive(index: int, identifier: int, data: bytes) -> bool:
        motor = question.sender(identifier, data)
        if motor is not None and (place := (index + 1, motor)) in pending:
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
                frames: list[Frame] = [(number - 1, *question.frame(motor)) for number, motor in pending]
                await bus.cycle(frames, SURVEY_TIME)
    finally:
        await bus.close()
    found = []
    for place, data in sorted(answers.items()):
        try:
            found.append(question.read(*place, data))
        except CorruptFrame:
            continue
    return found


def _whole(value: float) -> int:
    return int(value) if math.isfinite(value) else 0
