"""What a pad sends."""

from __future__ import annotations

import struct

from station.pad import shipped_mappings

XPAD = dict(shipped_mappings())["xpad"]
FORWARD, TURN, LEFT, RISE = 1, 0, 3, 4
BUMPER, B, BACK = 311, 305, 314


def event(kind: int, code: int, value: int) -> bytes:
    return struct.pack("@llHHi", 12, 34, kind, code, value)


def axis(code: int, value: int) -> bytes:
    return event(3, code, value)


def button(code: int, value: int = 1) -> bytes:
    return event(1, code, value)


REPORT, DROPPED = event(0, 0, 0), event(0, 3, 0)
CENTRED = axis(FORWARD, 0) + axis(TURN, 0) + axis(LEFT, 0) + REPORT
