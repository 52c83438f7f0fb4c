"""The emulated Xsens at the end of a pseudo-terminal, with all that can go wrong on the cable between."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from drivers.robot import Array
from sim.pty_port import PtyPort
from sim.xbus_emulator import Product, XbusEmulator


@dataclass(slots=True)
class CableFaults:
    """Knobs of the cable; each counts down."""

    corrupt: int = 0
    """So many samples get a flipped bit."""
    lose: int = 0
    """So many samples never leave the device, though its counter goes on."""
    garbage: int = 0
    """So many samples have noise before them."""
    split: int = 0
    """So many samples arrive in two writes."""


class SerialImu:
    """One device on one port."""

    def __init__(self, path: Path, product: Product = "MTI-630", baud: int = 115200) -> None:
        self.emulator = XbusEmulator(product, baud)
        self.port = PtyPort(path, self._heard)
        self.faults = CableFaults()

    def plug_in(self) -> None:
        """Power it: it says WakeUp and, unanswered, measures as stored."""
        self.port.plug_in()
        self.port.write(self.emulator.wake_up())

    def unplug(self) -> None:
        """Pull the cable."""
        self.port.unplug()

    def measure(self, seconds: float, orientation: Array, rate: Array, acceleration: Array) -> None:
        """Take a sample and send it, if it measures and the cable and the host's speed let it."""
        faults = self.faults
        if faults.lose:
            faults.lose -= 1
            self.emulator.skip()
            return
        data = self.emulator.measure(seconds, orientation, rate, acceleration)
        if not data or self.port.host_baud != self.emulator.baud:
            return
        if faults.corrupt:
            faults.corrupt -= 1
            data = data[:20] + bytes([data[20] ^ 0x10]) + data[21:]
        if faults.garbage:
            faults.garbage -= 1
            data = b"\x00\xfa\xff\x36\x90\xfa\x13" + data
        if faults.split:
            faults.split -= 1
            self.port.write(data[:11])
            data = data[11:]
        self.port.write(data)

    def _heard(self, data: bytes) -> None:
        if self.port.host_baud == self.emulator.baud:
            self.port.write(self.emulator.feed(data))
