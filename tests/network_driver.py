"""A driver at the desk's end: the real joystick with scripted hands, told line by line on standard input.

``stand``, ``walk``: press the button. ``push``: full forward, dead-man held. ``centre``: let the sticks go, held.
Answers every line on standard output with what the joystick knows then.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from collections import deque
from typing import Any

from runtime import config
from station.driving import Driving
from station.joystick import Joystick
from station.pad import Sticks
from station.session import connected


class Hands:
    """A source whose sticks and buttons another thread sets."""

    def __init__(self) -> None:
        self.sticks: Sticks | None = Sticks(held=True)
        self.buttons: deque[str] = deque()
        self._reader, self._writer = os.pipe()

    def fileno(self) -> int:
        return self._reader

    def read(self) -> list[str]:
        os.read(self._reader, 1)
        return [self.buttons.popleft()]

    def press(self, button: str) -> None:
        self.buttons.append(button)
        os.write(self._writer, b".")

    def close(self) -> None:
        os.close(self._reader)
        os.close(self._writer)


def obey(hands: Hands, joystick: Joystick, done: threading.Event) -> None:
    for line in sys.stdin:
        word = line.strip()
        if word in ("push", "centre"):
            hands.sticks = Sticks(forward=1.0 if word == "push" else 0.0, held=True)
        elif word != "look":
            hands.press(word)
        status: Any = joystick.status
        known = {"mode": status.mode if status else "", "deaf": joystick.deaf, "latency": joystick.latency}
        known["moves"] = bool(status) and any(status.velocity_command)
        print(json.dumps(known | {"words": joystick.words}), flush=True)
    done.set()


def main() -> None:
    endpoint, robot = sys.argv[1:]
    bounds = config.load(config.find_robot("stoch3")).control.bounds
    done, hands = threading.Event(), Hands()
    with connected(robot, endpoint) as station:
        joystick = Joystick(station, Driving(0.5 * bounds.linear_velocity[0], 0.0, 0.0))
        threading.Thread(target=obey, args=(hands, joystick, done), daemon=True).start()
        joystick.run(lambda: hands, lambda _joystick: None, lambda: not done.is_set())


if __name__ == "__main__":
    main()
