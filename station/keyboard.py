"""The terminal's keys as a pad. A terminal tells of presses only, so a held key is one that keeps repeating."""

from __future__ import annotations

import os
import termios
import time
import tty
from collections.abc import Callable

from station.pad import SourceLost, Sticks

HOLD_SECONDS = 0.7
"""A key counts as held for so long after it came: terminals begin to repeat after 0.25-0.66 s."""
MOVES = {
    "w": ("forward", 1.0),
    "s": ("forward", -1.0),
    "a": ("left", 1.0),
    "d": ("left", -1.0),
    "q": ("turn", 1.0),
    "e": ("turn", -1.0),
    "r": ("rise", 1.0),
    "f": ("rise", -1.0),
}
BUTTONS = {"0": "idle", " ": "hold", "x": "sit", "y": "stand", "b": "walk", "c": "clear", "p": "pose", "g": "gait"}
SPEEDS = {str(n): n / 9 for n in range(1, 10)}
HELP = "w s forward/back, a d sideways, q e turn, 1-9 speed; y stand, b walk, space hold, x sit, 0 damp, c clear;"
HELP += " g next gait, p pose: the same keys lean and turn the standing body, r f up and down"


class Keys:
    """State of the keys; ``feed`` takes what the terminal sent."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.speed = 4 / 9
        """Share of the bounds that a held key asks for."""
        self._clock = clock
        self._last: dict[str, tuple[float, float]] = {}

    def feed(self, data: bytes) -> list[str]:
        """Take bytes; returns the buttons pressed in them."""
        pressed = []
        for key in data.decode(errors="ignore"):
            if key in MOVES:
                name, sign = MOVES[key]
                self._last[name] = (sign, self._clock())
            elif key in SPEEDS:
                self.speed = SPEEDS[key]
            elif key in BUTTONS:
                self._last.clear()
                pressed.append(BUTTONS[key])
        return pressed

    @property
    def sticks(self) -> Sticks:
        """What the held keys ask for; a held key is its own dead-man."""
        now = self._clock()
        moving = {name: sign * self.speed for name, (sign, at) in self._last.items() if now - at < HOLD_SECONDS}
        return Sticks(**moving, held=True)


class Keyboard:
    """The terminal in raw mode until ``close``."""

    def __init__(self, fd: int = 0) -> None:
        """Take the terminal.

        Raises:
            SourceLost: ``fd`` is no terminal.
        """
        if not os.isatty(fd):
            raise SourceLost("the keyboard needs a terminal")
        self._fd = fd
        self._before = termios.tcgetattr(fd)
        tty.setcbreak(fd)
        self.keys = Keys()

    def fileno(self) -> int:
        """For select."""
        return self._fd

    def read(self) -> list[str]:
        """Buttons pressed since the last call.

        Raises:
            SourceLost: the terminal is gone.
        """
        try:
            data = os.read(self._fd, 256)
        except OSError as error:
            raise SourceLost(f"keyboard: {error.strerror}") from error
        if not data:
            raise SourceLost("keyboard: closed")
        return self.keys.feed(data)

    @property
    def sticks(self) -> Sticks:
        """What the held keys ask for."""
        return self.keys.sticks

    def close(self) -> None:
        """Give the terminal back as it was."""
        termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)
