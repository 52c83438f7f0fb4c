"""An Xsens MTi-600 behind its bytes: states, acknowledgements, rates, errors, without any I/O.

After Movella's low-level protocol manual. ``MTI-610`` gives no orientation; ``MTI-620`` and ``MTI-630`` do.
"""

from __future__ import annotations

import struct
from typing import Literal

from drivers import xbus
from drivers.errors import CorruptFrame
from drivers.mtdata2 import STATUS_CLIPPING, STATUS_ORIENTATION_VALID, STATUS_SELF_TEST, Data
from drivers.robot import Array
from drivers.xbus import BAUD_CODES, Message, Output, XbusParser

Product = Literal["MTI-610", "MTI-620", "MTI-630"]
BASE_RATE_HZ = 400
_EVERY = 0xFFFF
_INVALID_MESSAGE, _INVALID_PARAMETER, _DATA_OVERFLOW = 4, 33, 41
_BAUDS = {code: baud for baud, code in BAUD_CODES.items()}
_VECTORS = {int(Data.ACCELERATION), int(Data.RATE_OF_TURN), int(Data.QUATERNION)}
_WITH_EVERY_PACKET = {int(Data.PACKET_COUNTER), int(Data.SAMPLE_TIME_FINE), int(Data.STATUS_WORD)}
_DEFAULT = [Output(Data.PACKET_COUNTER, _EVERY), Output(Data.ACCELERATION, 100), Output(Data.RATE_OF_TURN, 100)]


class XbusEmulator:
    """One device. The knobs may be turned at any time."""

    def __init__(self, product: Product = "MTI-630", baud: int = 115200) -> None:
        self.product, self.baud = product, baud
        self.measuring = True
        """As after power-up with nobody to answer its WakeUp."""
        self.outputs = list(_DEFAULT)
        self.clipping = False
        """Knob: the status word says that a sensor is at its end."""
        self.self_test_ok = True
        """Knob."""
        self.silent = False
        """Knob: it hears and says nothing, as in its bootloader."""
        self.overflowing = False
        """Knob: its line takes less than it has to say."""
        self._parser = XbusParser()
        self._counter = self._measured = 0
        self._overflowed = False
        self._next_baud = baud

    @property
    def rate_hz(self) -> int:
        """Samples a second."""
        rates = [output.rate_hz for output in self.outputs if output.rate_hz != _EVERY]
        return max(rates, default=0)

    def wake_up(self) -> bytes:
        """What it says after power-up or a reset."""
        self.baud, self.measuring = self._next_baud, True
        self._parser, self._overflowed = XbusParser(), False
        return xbus.encode(Message.WAKE_UP)

    def feed(self, data: bytes) -> bytes:
        """Bytes from the host; its answers."""
        if self.silent:
            return b""
        return b"".join(self._answer(message, content) for message, content in self._parser.feed(data))

    def measure(self, seconds: float, orientation: Array, rate: Array, acceleration: Array) -> bytes:
        """What it says to a sample of its base rate, taken at ``seconds`` of its own clock, in the sensor's frame.

        Empty unless it measures, and where its configured rate leaves this sample out.
        """
        if self.silent or not self.measuring:
            return b""
        self._measured += 1
        if self._measured % max(1, BASE_RATE_HZ // max(1, self.rate_hz)):
            return b""
        values = {
            int(Data.PACKET_COUNTER): struct.pack(">H", self._counter),
            int(Data.SAMPLE_TIME_FINE): struct.pack(">I", int(seconds * 1e4) & 0xFFFFFFFF),
            int(Data.QUATERNION): struct.pack(">4f", *orientation),
            int(Data.ACCELERATION): struct.pack(">3f", *acceleration),
            int(Data.RATE_OF_TURN): struct.pack(">3f", *rate),
            int(Data.STATUS_WORD): struct.pack(">I", self._status()),
        }
        self._counter = self._counter + 1 & 0xFFFF
        data = b"".join(
            struct.pack(">HB", output.identifier, len(values[output.identifier])) + values[output.identifier]
            for output in self.outputs
        )
        if self.overflowing or self.rate_hz * (len(data) + 5) * 10 > self.baud:
            first, self._overflowed = not self._overflowed, True
            return xbus.encode(Message.ERROR, bytes([_DATA_OVERFLOW])) if first else b""
        return xbus.encode(Message.MTDATA2, data)

    def skip(self) -> None:
        """Knob: one sample is taken and lost."""
        self._counter = self._counter + 1 & 0xFFFF

    def _status(self) -> int:
        status = STATUS_SELF_TEST if self.self_test_ok else 0
        if self.product != "MTI-610":
            status |= STATUS_ORIENTATION_VALID
        return status | (STATUS_CLIPPING | 1 << 8 if self.clipping else 0)

    def _answer(self, message: int, data: bytes) -> bytes:
        if message == Message.GO_TO_CONFIG:
            self.measuring = False
        elif message == Message.WAKE_UP_ACK:
            self.measuring = False
            return b""
        elif message == Message.RESET:
            return xbus.encode(Message.RESET + 1) + self.wake_up()
        elif self.measuring:
            return xbus.encode(Message.ERROR, bytes([_INVALID_MESSAGE]))
        try:
            return xbus.encode(message + 1, self._in_config(message, data))
        except (KeyError, CorruptFrame):
            return xbus.encode(Message.ERROR, bytes([_INVALID_PARAMETER]))

    def _in_config(self, message: int, data: bytes) -> bytes:
        match message:
            case Message.GO_TO_MEASUREMENT:
                self.measuring, self._overflowed = True, False
            case Message.REQUEST_PRODUCT_CODE:
                return f"{self.product}-8A7G6".encode().ljust(20)
            case Message.REQUEST_DEVICE_ID:
                return bytes.fromhex("0080005412345678")
            case Message.REQUEST_FIRMWARE:
                return bytes.fromhex("0108020000002500011534")
            case Message.SET_BAUD:
                self._next_baud = _BAUDS[data[0] if data else 0xFF]
            case Message.SET_OUTPUT_CONFIGURATION:
                if data:
                    self.outputs = [given for asked in xbus.decode_outputs(data) for given in self._give(asked)]
                return xbus.encode_outputs(self.outputs)
            case Message.SET_OPTION_FLAGS:
                return data[:4].ljust(4, b"\0")
            case Message.GO_TO_CONFIG:
                pass
            case _:
                raise KeyError(message)
        return b""

    def _give(self, asked: Output) -> list[Output]:
        """What it does of one line: its own rates are 400 Hz by a whole number."""
        if asked.identifier in _WITH_EVERY_PACKET:
            return [Output(asked.identifier, _EVERY)]
        if asked.identifier not in _VECTORS or (asked.identifier == Data.QUATERNION and self.product == "MTI-610"):
            return []
        divisor = max(1, -(-BASE_RATE_HZ // max(1, asked.rate_hz)))
        return [Output(asked.identifier, BASE_RATE_HZ // divisor)]
