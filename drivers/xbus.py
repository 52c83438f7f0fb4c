"""The Xsens wire format, sans-I/O: bytes in, checked packets out; partial bytes are kept, garbage skipped and counted.

Frame: ``FA`` bus id, message id, length (``FF`` = two more bytes), data, checksum; big endian; all bytes but the first
sum to 0 modulo 256. Sources: Movella's MTi low-level protocol manual, and the public driver sources named beside the
tables (xsens ``xsxbusmessageid.h``, ``xsresultvalue.h``).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

from drivers.errors import CorruptFrame
from drivers.mtdata2 import decode_data

PREAMBLE, MASTER = 0xFA, 0xFF
_HEAD = bytes([PREAMBLE, MASTER])
MAX_DATA = 2048
"""Longest data that an MTi sends, with room; a longer length is garbage."""


class Message(IntEnum):
    """Message ids (xsxbusmessageid.h); the answer to one is its id + 1."""

    REQUEST_DEVICE_ID = 0x00
    DEVICE_ID = 0x01
    CONFIGURATION = 0x0D
    GO_TO_MEASUREMENT = 0x10
    GO_TO_MEASUREMENT_ACK = 0x11
    REQUEST_FIRMWARE = 0x12
    FIRMWARE = 0x13
    SET_BAUD = 0x18
    REQUEST_PRODUCT_CODE = 0x1C
    PRODUCT_CODE = 0x1D
    SET_NO_ROTATION = 0x22
    GO_TO_CONFIG = 0x30
    GO_TO_CONFIG_ACK = 0x31
    MTDATA2 = 0x36
    WAKE_UP = 0x3E
    WAKE_UP_ACK = 0x3F
    RESET = 0x40
    ERROR = 0x42
    WARNING = 0x43
    SET_OPTION_FLAGS = 0x48
    OPTION_FLAGS = 0x49
    RESET_ORIENTATION = 0xA4
    SET_OUTPUT_CONFIGURATION = 0xC0
    OUTPUT_CONFIGURATION = 0xC1


ERRORS = {
    3: "the period is not one that it can do",
    4: "invalid message, or not in this state",
    30: "timer overflow",
    32: "baud rate out of range",
    33: "invalid parameter",
    35: "transmit buffer overflow",
    36: "transmit buffer overflow",
    40: "device error",
    41: "data overflow: the baud rate is too low for the configured outputs",
    42: "buffer overflow",
    43: "external trigger",
    44: "sample stream",
    45: "power dip",
    47: "too hot",
    49: "no such filter profile",
    53: "output configuration refused",
}
"""Data of the Error message (xsresultvalue.h)."""

BAUD_CODES = {115200: 0x02, 230400: 0x01, 460800: 0x00, 921600: 0x0A, 2000000: 0x0C, 3500000: 0x0E, 4000000: 0x0D}
"""Baud rate → code of SetBaudrate."""

Packet = tuple[int, bytes]
"""Message id and data of one checked message."""


class Output(NamedTuple):
    """One line of an output configuration."""

    identifier: int
    rate_hz: int
    """0xFFFF: with every packet."""


def encode(message: int, data: bytes = b"") -> bytes:
    """A message to the device."""
    length = bytes([len(data)]) if len(data) < 0xFF else b"\xff" + struct.pack(">H", len(data))
    body = bytes([MASTER, message]) + length + data
    return bytes([PREAMBLE]) + body + bytes([-sum(body) & 0xFF])


def encode_outputs(outputs: Sequence[Output]) -> bytes:
    """Data of SetOutputConfiguration."""
    return b"".join(struct.pack(">HH", *output) for output in outputs)


def decode_outputs(data: bytes) -> list[Output]:
    """Data of the answer to SetOutputConfiguration: what the device really does.

    Raises:
        CorruptFrame: not a multiple of four bytes.
    """
    if len(data) % 4:
        raise CorruptFrame(f"output configuration {data.hex()}: not a multiple of 4 bytes")
    return [Output(*pair) for pair in struct.iter_unpack(">HH", data)]


class XbusParser:
    """Finds packets in a stream of bytes."""

    def __init__(self) -> None:
        self._rest = b""
        self.skipped = 0
        """Bytes that belonged to no packet."""
        self.corrupt = 0
        """Candidates whose checksum or length was wrong."""

    def feed(self, data: bytes) -> list[Packet]:
        """The packets that ``data`` completes, in order. Never raises."""
        if not self._rest and 4 < len(data) == data[3] + 5 < 260 and data[:2] == _HEAD and sum(data) & 0xFF == PREAMBLE:
            return [(data[2], data[4:-1])]
        data = self._rest + data
        packets: list[Packet] = []
        position = 0
        while (start := data.find(_HEAD, position)) >= 0:
            self.skipped += start - position
            position = start
            end = _frame_end(data, start)
            if end > len(data) or end == 0:
                overtaking = _overtaking(data, start)
                if overtaking == 0:
                    break
                self._reject(overtaking - start)
                position = overtaking
            elif end < 0 or sum(data[start + 1 : end]) & 0xFF:
                self._reject(1)
                position = start + 1
            else:
                head = 4 if data[start + 3] != 0xFF else 6
                packets.append((data[start + 2], data[start + head : end - 1]))
                position = end
        self._keep(data, position, start)
        return packets

    def _reject(self, skipped: int) -> None:
        self.corrupt += 1
        self.skipped += skipped

    def _keep(self, data: bytes, position: int, start: int) -> None:
        keep = position if start >= 0 else len(data) - 1 if data[position:].endswith(_HEAD[:1]) else len(data)
        self.skipped += keep - position
        self._rest = data[keep:]


def _frame_end(data: bytes, start: int) -> int:
    """Index behind the frame at ``start``; 0: too few bytes to tell; -1: an impossible length."""
    if start + 4 > len(data):
        return 0
    length = data[start + 3]
    if length != 0xFF:
        return start + 5 + length
    if start + 6 > len(data):
        return 0
    length = data[start + 4] << 8 | data[start + 5]
    return start + 7 + length if length <= MAX_DATA else -1


def _overtaking(data: bytes, start: int) -> int:
    """Where a whole, well-formed data packet lies behind an unfinished candidate; 0 where there is none.

    A damaged length byte would otherwise hold back up to 250 bytes of good packets.
    """
    position = start + 1
    while (position := data.find(_HEAD, position)) > 0:
        end = _frame_end(data, position)
        whole = 0 < end <= len(data) and sum(data[position + 1 : end]) & 0xFF == 0
        if whole and data[position + 2] == Message.MTDATA2:
            try:
                decode_data(data[position + 4 : end - 1])
            except CorruptFrame:
                pass
            else:
                return position
        position += 1
    return 0
