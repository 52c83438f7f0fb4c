"""MTData2, the Xsens measurement message: any of its formats by a walk, the one in use by a precompiled layout.

Source: xsens ``xsdataidentifier.h`` (identifier = group + type + coordinate bits + format bits) and
``xsstatusflag.h``. Acceleration includes gravity: +9.81 m/s² upwards at rest.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from enum import IntEnum
from operator import itemgetter
from typing import Any, NamedTuple

from drivers.errors import CorruptFrame


class Data(IntEnum):
    """Data identifiers without their format bits (xsdataidentifier.h)."""

    TEMPERATURE = 0x0810
    UTC_TIME = 0x1010
    PACKET_COUNTER = 0x1020
    SAMPLE_TIME_FINE = 0x1060
    SAMPLE_TIME_COARSE = 0x1070
    QUATERNION = 0x2010
    ROTATION_MATRIX = 0x2020
    EULER = 0x2030
    PRESSURE = 0x3010
    DELTA_VELOCITY = 0x4010
    ACCELERATION = 0x4020
    FREE_ACCELERATION = 0x4030
    ACCELERATION_HR = 0x4040
    RATE_OF_TURN = 0x8020
    DELTA_QUATERNION = 0x8030
    RATE_OF_TURN_HR = 0x8040
    MAGNETIC_FIELD = 0xC020
    STATUS_BYTE = 0xE010
    STATUS_WORD = 0xE020


STATUS_SELF_TEST = 1 << 0
STATUS_ORIENTATION_VALID = 1 << 1
STATUS_NO_ROTATION = 3 << 3
STATUS_CLIP_ACCELERATION = 7 << 8
STATUS_CLIP_RATE = 7 << 11
STATUS_CLIPPING = 1 << 19
"""Bits of the status word (xsstatusflag.h)."""

_INTEGERS: dict[int, str] = {
    Data.PACKET_COUNTER: "H",
    Data.SAMPLE_TIME_FINE: "I",
    Data.SAMPLE_TIME_COARSE: "I",
    Data.PRESSURE: "I",
    Data.STATUS_BYTE: "B",
    Data.STATUS_WORD: "I",
}
_COUNTS: dict[int, int] = {
    Data.TEMPERATURE: 1,
    Data.QUATERNION: 4,
    Data.ROTATION_MATRIX: 9,
    Data.EULER: 3,
    Data.DELTA_VELOCITY: 3,
    Data.ACCELERATION: 3,
    Data.FREE_ACCELERATION: 3,
    Data.ACCELERATION_HR: 3,
    Data.RATE_OF_TURN: 3,
    Data.DELTA_QUATERNION: 4,
    Data.RATE_OF_TURN_HR: 3,
    Data.MAGNETIC_FIELD: 3,
}
_KIND = 0xFFF0
_FP1632 = struct.Struct(">Ih")
"""Format 2: fraction first, then the whole number."""


def decode_data(data: bytes) -> dict[int, tuple[float, ...]]:
    """All items of an MTData2 message, whatever their format: identifier without format bits → values.

    Items that this module does not know are left out.

    Raises:
        CorruptFrame: an item runs over the end, or has the wrong length.
    """
    return {
        identifier & _KIND: _decode_item(identifier, data[start:end])
        for identifier, start, end in _items(data)
        if identifier & _KIND in _INTEGERS or identifier & _KIND in _COUNTS
    }


def _items(data: bytes) -> Iterator[tuple[int, int, int]]:
    offset = 0
    while offset < len(data):
        if offset + 3 > len(data) or offset + 3 + data[offset + 2] > len(data):
            raise CorruptFrame(f"MTData2 {data.hex()}: the item at byte {offset} runs over the end")
        end = offset + 3 + data[offset + 2]
        yield data[offset] << 8 | data[offset + 1], offset + 3, end
        offset = end


def _decode_item(identifier: int, data: bytes) -> tuple[float, ...]:
    kind, form = identifier & _KIND, identifier & 3
    code = _INTEGERS[kind] if kind in _INTEGERS else f"{_COUNTS[kind]}{'fi?d'[form]}"
    size = struct.calcsize(">" + code) if "?" not in code else _COUNTS[kind] * _FP1632.size
    if len(data) != size:
        raise CorruptFrame(f"MTData2 item 0x{identifier:04x} has {len(data)} bytes: {size} are wanted")
    if "?" in code:
        return tuple(whole + fraction / 2**32 for fraction, whole in _FP1632.iter_unpack(data))
    values: tuple[float, ...] = struct.unpack(">" + code, data)
    return tuple(value / 2**20 for value in values) if "i" in code else values


class Sample(NamedTuple):
    """What the driver wants of one MTData2 message, in the sensor's frame."""

    counter: int
    """Packet counter, wraps at 2^16."""
    ticks: int
    """Sample time, 10 kHz, wraps at 2^32."""
    orientation: tuple[float, ...]
    """Quaternion w x y z sensor → local; empty where the device gives none."""
    acceleration: tuple[float, ...]
    """m/s²."""
    rate: tuple[float, ...]
    """rad/s."""
    status: int
    """Status word."""


class SampleDecoder:
    """MTData2 → ``Sample``: one ``struct`` made from the first message, used for all that look the same."""

    def __init__(self) -> None:
        self._unpack: Callable[[bytes], tuple[Any, ...]] = struct.Struct("").unpack
        self._size = -1
        self._take_heads: Callable[[tuple[Any, ...]], Any] = itemgetter(0)
        self._heads: Any = ()
        self._places = (0, 0, slice(0), slice(0), slice(0), 0)

    def decode(self, data: bytes) -> Sample:
        """One message.

        Raises:
            CorruptFrame: malformed, or without counter, time, acceleration or rate of turn.
        """
        if len(data) == self._size:
            values = self._unpack(data)
            if self._take_heads(values) == self._heads:
                counter, ticks, orientation, acceleration, rate, status = self._places
                return Sample(
                    values[counter],
                    values[ticks],
                    values[orientation],
                    values[acceleration],
                    values[rate],
                    values[status],
                )
        return self._decode_slowly(data)

    def _decode_slowly(self, data: bytes) -> Sample:
        items = decode_data(data)
        try:
            sample = Sample(
                int(items[Data.PACKET_COUNTER][0]),
                int(items[Data.SAMPLE_TIME_FINE][0]),
                items.get(Data.QUATERNION, ()),
                items[Data.ACCELERATION],
                items[Data.RATE_OF_TURN],
                int(items.get(Data.STATUS_WORD, (0.0,))[0]),
            )
        except KeyError as error:
            raise CorruptFrame(f"MTData2 {data.hex()}: without item 0x{error.args[0]:04x}") from error
        if Data.STATUS_WORD in items:
            self._compile(data)
        return sample

    def _compile(self, data: bytes) -> None:
        """Only for messages of integers and float32, which is what the driver asks for."""
        form, places = ">", {}
        heads: list[tuple[int, bytes]] = []
        index = 0
        for identifier, start, _ in _items(data):
            kind = identifier & _KIND
            if kind not in _INTEGERS and (kind not in _COUNTS or identifier & 3):
                return
            count = 1 if kind in _INTEGERS else _COUNTS[kind]
            form += "3s" + _INTEGERS.get(kind, f"{count}f")
            heads.append((index, data[start - 3 : start]))
            places[kind] = (index + 1, index + 1 + count)
            index += 1 + count
        layout = struct.Struct(form)
        self._unpack, self._size = layout.unpack, layout.size
        self._take_heads = itemgetter(*(place for place, _ in heads))
        self._heads = tuple(head for _, head in heads)
        none = (0, 0)
        self._places = (
            places[Data.PACKET_COUNTER][0],
            places[Data.SAMPLE_TIME_FINE][0],
            slice(*places.get(Data.QUATERNION, none)),
            slice(*places[Data.ACCELERATION]),
            slice(*places[Data.RATE_OF_TURN]),
            places[Data.STATUS_WORD][0],
        )
