"""What an operator's program asks of a robot's modes: once, or again and again until it is there."""

from __future__ import annotations

import time

from runtime.messages.mode import Mode, ModeReply, Request
from station.session import Station, StationError

PATIENCE = 60.0
"""s for which a robot may refuse, or be on its way: its arming list wants to have seen the loop run."""
AGAIN = 0.05
"""s between two questions."""
CENTRED = b'{"linear": [0.0, 0.0], "yaw_rate": 0.0}'
"""The velocity of sticks that nobody touches."""
OUTSET = ((Request.ARM, Mode.DAMP), (Request.STAND, Mode.STAND), (Request.WALK, Mode.WALK))
"""From DAMP to WALK: what is asked, and the mode that it leads to."""


def request(station: Station, wish: Request) -> ModeReply:
    """Ask once.

    Raises:
        StationError: nobody answers.
    """
    return station.ask_for(ModeReply, station.keys.mode, wish.value.encode())


def reach(station: Station, wish: Request, mode: Mode, patience: float = PATIENCE) -> ModeReply:
    """Ask, with centred sticks, until the wish is granted and the robot is in ``mode``.

    Raises:
        StationError: it is not within ``patience`` seconds; the message says what spoke against it.
    """
    end = time.monotonic() + patience
    while True:
        station.session.put(station.keys.velocity, CENTRED)
        reply = request(station, wish)
        if reply.accepted and reply.mode == mode.name:
            return reply
        if time.monotonic() > end:
            raise StationError(f"{wish.value}: {reply.reason} (in {reply.mode}, for {patience:g} s)")
        time.sleep(AGAIN)


def set_off(station: Station, patience: float = PATIENCE) -> None:
    """Arm, stand up and walk on the spot, with ``patience`` seconds for each.

    Raises:
        StationError: as ``reach``.
    """
    for wish, mode in OUTSET:
        reach(station, wish, mode, patience)
