"""A gamepad from its event bytes: Linux input events in, sticks and buttons out. No library, any file descriptor.

Which code is which stick says a TOML, shipped for the usual pads under ``station/pads``.
"""

from __future__ import annotations

import array
import fcntl
import os
import struct
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from drivers.description import UNDECODABLE, Record
from runtime.control.parameters import GaitName
from station.session import StationError

PADS = Path(__file__).parent / "pads"
DEVICES = Path("/dev/input")
EV_SYN, EV_KEY, EV_ABS = 0, 1, 3
SYN_REPORT, SYN_DROPPED = 0, 3
EVENT = struct.Struct("@llHHi")
"""struct input_event: seconds, microseconds, type, code, value."""

Code = Annotated[int, Meta(ge=0, le=0x2FF)]


class Axis(Record, frozen=True, kw_only=True):
    """One stick's direction."""

    code: Code
    sign: Literal[-1, 1] = 1
    low: int = -32768
    """Reading at one end; the device's own word wins where it gives one."""
    high: int = 32767


class Axes(Record, frozen=True, kw_only=True):
    """What the sticks mean."""

    forward: Axis
    left: Axis
    turn: Axis
    rise: Axis | None = None
    """Up and down, for the body's pose alone."""


class Buttons(Record, frozen=True, kw_only=True):
    """What the buttons mean, by event code."""

    idle: Code
    hold: Code
    sit: Code
    stand: Code
    walk: Code
    clear: Code
    dead_man: Code
    pose: Code | None = None
    gait: Code | None = None


GAITS: tuple[GaitName, ...] = ("trot", "walk", "pace")


class PadMapping(Record, frozen=True, kw_only=True):
    """One kind of pad."""

    match: tuple[str, ...] = ()
    """Parts of the names of devices that it fits."""
    dead_zone: Annotated[float, Meta(ge=0, lt=1)] = 0.12
    """Share of a stick's way around its middle that counts as centred."""
    gaits: tuple[GaitName, ...] = GAITS
    """What the gait button goes through."""
    axes: Axes
    buttons: Buttons


@dataclass(frozen=True, slots=True)
class Sticks:
    """Where the operator's hands are, each from -1 to 1."""

    forward: float = 0.0
    left: float = 0.0
    turn: float = 0.0
    rise: float = 0.0
    held: bool = False
    """The dead-man button is down."""

    @property
    def centred(self) -> bool:
        """All that drive in the middle."""
        return self.forward == self.left == self.turn == 0.0

    @property
    def level(self) -> bool:
        """All in the middle, that of the height too."""
        return self.centred and self.rise == 0.0


DRIVING = {"forward", "left", "turn"}


def used_axes(mapping: PadMapping) -> dict[str, Axis]:
    """The axes that a mapping names."""
    found = {name: getattr(mapping.axes, name) for name in mapping.axes.__struct_fields__}
    return {name: axis for name, axis in found.items() if axis is not None}


class SourceLost(StationError):
    """The pad or the terminal is gone."""


class Pad:
    """State of one pad; ``feed`` takes whatever bytes came, whole events or not."""

    def __init__(self, mapping: PadMapping, ranges: dict[int, tuple[int, int]] | None = None) -> None:
        """Start with all sticks unknown, which counts as pushed: nothing moves before they told where they are.

        Args:
            mapping: which code is what.
            ranges: low and high reading by axis code, where the device tells them.
        """
        self.known = False
        """All three axes that drive have been heard since the start or since events were lost."""
        self._mapping = mapping
        self._axes = {axis.code: (name, axis) for name, axis in used_axes(mapping).items()}
        self._ranges = {code: (ranges or {}).get(code, (axis.low, axis.high)) for code, (_, axis) in self._axes.items()}
        codes = ((name, getattr(mapping.buttons, name)) for name in mapping.buttons.__struct_fields__)
        self._names: dict[int, str] = {code: name for name, code in codes if code is not None}
        self._values: dict[str, float] = {}
        self._held = False
        self._rest = b""
        self._skipping = False

    def feed(self, data: bytes) -> list[str]:
        """Take bytes; returns the names of the buttons that were pressed in them, in order."""
        pressed = []
        data = self._rest + data
        whole = len(data) - len(data) % EVENT.size
        self._rest = data[whole:]
        for _, _, kind, code, value in EVENT.iter_unpack(data[:whole]):
            if kind == EV_SYN:
                self._synchronise(code)
            elif not self._skipping and (name := self._take(kind, code, value)):
                pressed.append(name)
        return pressed

    def read_axis(self, code: int, value: int) -> None:
        """Where an axis is now, as the device told when asked."""
        self._take(EV_ABS, code, value)

    def forget(self) -> None:
        """Events were lost: nothing is known of the sticks, and the dead-man counts as released."""
        self._values.clear()
        self._held = self.known = False

    @property
    def sticks(self) -> Sticks | None:
        """Where the sticks are; None while that is not known."""
        if not self.known:
            return None
        return Sticks(**self._values, held=self._held)

    def _synchronise(self, code: int) -> None:
        """After SYN_DROPPED everything up to the next report is stale."""
        if code == SYN_DROPPED:
            self._skipping = True
            self.forget()
        elif code == SYN_REPORT:
            self._skipping = False

    def _take(self, kind: int, code: int, value: int) -> str | None:
        if kind == EV_ABS and code in self._axes:
            name, axis = self._axes[code]
            self._values[name] = axis.sign * _share(value, *self._ranges[code], self._mapping.dead_zone)
            self.known = self._values.keys() >= DRIVING
        elif kind == EV_KEY and code in self._names:
            name = self._names[code]
            if name == "dead_man":
                self._held = value != 0
            elif value == 1:
                return name
        return None


def _share(value: int, low: int, high: int, dead_zone: float) -> float:
    """A reading as -1 to 1 with the dead zone cut out and no step at its edge."""
    middle, half = (low + high) / 2, max(1.0, (high - low) / 2)
    share = max(-1.0, min(1.0, (value - middle) / half))
    beyond = abs(share) - dead_zone
    return 0.0 if beyond <= 0.0 else (beyond / (1.0 - dead_zone)) * (1.0 if share > 0 else -1.0)


def load_mapping(path: Path) -> PadMapping:
    """Read a pad's TOML.

    Raises:
        StationError: unreadable, not TOML, an unknown key or a value out of its bounds.
    """
    try:
        return msgspec.convert(tomllib.loads(path.read_text()), PadMapping)
    except OSError as error:
        raise StationError(f"{path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, *UNDECODABLE) as error:
        raise StationError(f"{path}: {error}") from error


def shipped_mappings() -> Iterator[tuple[str, PadMapping]]:
    """Name and mapping of every shipped kind of pad."""
    for path in sorted(PADS.glob("*.toml")):
        yield path.stem, load_mapping(path)


class PadDevice:
    """A pad on its event device."""

    def __init__(self, path: Path, mapping: PadMapping) -> None:
        """Open the device and ask it where its sticks are.

        Raises:
            SourceLost: it cannot be opened.
        """
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise SourceLost(f"pad {path}: {error.strerror}") from error
        axes = used_axes(mapping).values()
        told = {axis.code: info for axis in axes if (info := _axis_info(self._fd, axis.code)) is not None}
        self.pad = Pad(mapping, {code: (low, high) for code, (_, low, high) in told.items()})
        for code, (value, _, _) in told.items():
            self.pad.read_axis(code, value)
        self.path = path

    def fileno(self) -> int:
        """For select."""
        return self._fd

    def read(self) -> list[str]:
        """Buttons pressed since the last call.

        Raises:
            SourceLost: the pad is gone.
        """
        try:
            data = os.read(self._fd, 64 * EVENT.size)
        except BlockingIOError:
            return []
        except OSError as error:
            raise SourceLost(f"pad {self.path}: {error.strerror}") from error
        if not data:
            raise SourceLost(f"pad {self.path}: closed")
        return self.pad.feed(data)

    @property
    def sticks(self) -> Sticks | None:
        """Where the sticks are."""
        return self.pad.sticks

    def close(self) -> None:
        """Let go of the device."""
        os.close(self._fd)


def find_pad(mapping: PadMapping | None = None) -> tuple[Path, PadMapping]:
    """The first device that a mapping fits.

    Raises:
        SourceLost: none; the message lists the names that were found.
    """
    known = [mapping] if mapping else [shipped for _, shipped in shipped_mappings()]
    names = []
    for path in sorted(DEVICES.glob("event*")):
        name = _device_name(path)
        names.append(name)
        for candidate in known:
            if any(part in name for part in candidate.match):
                return path, candidate
    found = ", ".join(filter(None, names)) or "none at all"
    raise SourceLost(f"no pad that is known among the input devices: {found}; name one with --pad")


def _device_name(path: Path) -> str:
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    except OSError:
        return ""
    try:
        buffer = array.array("B", bytes(256))
        fcntl.ioctl(fd, _ioctl_read(0x06, len(buffer)), buffer)
        return buffer.tobytes().rstrip(b"\0").decode(errors="replace")
    except OSError:
        return ""
    finally:
        os.close(fd)


def _axis_info(fd: int, code: int) -> tuple[int, int, int] | None:
    """Value, low and high of an axis; None where the descriptor is no event device. EVIOCGABS."""
    buffer = array.array("i", [0] * 6)
    try:
        fcntl.ioctl(fd, _ioctl_read(0x40 + code, 24), buffer)
    except OSError:
        return None
    value, low, high = buffer[:3]
    return (value, low, high) if high > low else None


def _ioctl_read(number: int, size: int) -> int:
    """_IOC(_IOC_READ, 'E', number, size)."""
    return (2 << 30) | (size << 16) | (ord("E") << 8) | number
