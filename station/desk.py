"""The driver's terminal: which pad, and one line that tells how it goes."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.text import Text

from runtime.control.parameters import BoundsConfig
from station import keyboard as terminal
from station.driving import Driving
from station.joystick import Joystick, Source
from station.pad import GAITS, PadDevice, find_pad, load_mapping, shipped_mappings
from station.session import Station


def open_source(keys: bool, pad: Path | None, mapping: Path | None) -> Source:
    """The pad or keyboard that the options mean.

    Raises:
        SourceLost: not there.
        StationError: the mapping cannot be used.
    """
    if keys:
        return terminal.Keyboard()
    chosen = None if mapping is None else load_mapping(mapping)
    if pad is not None:
        return PadDevice(pad, chosen or dict(shipped_mappings())["xpad"])
    return PadDevice(*find_pad(chosen))


def drive(
    station: Station, bounds: BoundsConfig, keys: bool, pad: Path | None, mapping: Path | None, speed: float
) -> None:
    """Drive until Ctrl-C; ``speed`` is the share of the bounds that full sticks ask for."""
    gaits = GAITS if mapping is None else load_mapping(mapping).gaits
    forward, sideways = bounds.linear_velocity
    joystick = Joystick(station, Driving(speed * forward, speed * sideways, speed * bounds.yaw_rate, gaits))
    console = Console(stderr=True)
    if keys:
        console.print(terminal.HELP, highlight=False)
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.suppress(KeyboardInterrupt))
        show = _line(stack.enter_context(Live(console=console, refresh_per_second=5, transient=True)))
        joystick.run(
            lambda: open_source(keys, pad, mapping), show if console.is_terminal else _lines(console), lambda: True
        )


def _line(live: Live) -> Callable[[Joystick], None]:
    """For a terminal: one line that is always up to date."""
    return lambda joystick: live.update(describe(joystick))


def _lines(console: Console) -> Callable[[Joystick], None]:
    """For what is no terminal: a line whenever there is something new to say."""
    last = ""

    def show(joystick: Joystick) -> None:
        nonlocal last
        mode = "the robot is not heard" if joystick.status is None or joystick.deaf else joystick.status.mode
        if (words := f"{mode}: {joystick.words}") != last:
            last = words
            console.print(words, highlight=False)

    return show


def describe(joystick: Joystick) -> Text:
    """One line: the robot's mode, battery and speed, the link's latency, the last answer."""
    status = joystick.status
    if status is None or joystick.deaf:
        return Text(f"the robot is not heard   {joystick.words}", style="bold red")
    latency = "-" if joystick.latency is None else f"{joystick.latency * 1e3:.1f} ms"
    forward, left, turn = status.velocity
    ready = "centred" if joystick.driving.centred else "centre the sticks"
    parts = [
        status.mode + (" armed" if status.armed else ""),
        f"{forward:+.2f} {left:+.2f} m/s {turn:+.2f} rad/s",
        f"{status.voltage:.1f} V",
        f"link {latency}",
        ready if status.mode == "WALK" else "",
        f"FAULT {status.fault}" if status.fault else "",
        "POSE" if joystick.driving.posing else joystick.driving.gaits[0],
        joystick.words,
        f"last refused: {joystick.refusal}" if joystick.refusal and joystick.refusal not in joystick.words else "",
    ]
    return Text("   ".join(filter(None, parts)), style="red" if status.fault else "")
