"""``status``: how the robot is, for people."""

from __future__ import annotations

import msgspec

from runtime.messages.fault import Evidence


class Status(msgspec.Struct, frozen=True, kw_only=True):
    """The daemon's state for people: JSON, ten times a second and on every change."""

    robot: str
    mode: str
    armed: bool
    fault: str
    """The fault that stands until it is cleared; empty for none."""
    evidence: Evidence | None = None
    """Of that fault."""
    health: str = ""
    """What the guard says of the last measurement; empty when all is in order."""
    reason: str
    """Why the mode is what it is, in words."""
    policy: str
    rate_hz: float
    ticks: int
    overruns: int
    velocity_command: tuple[float, float, float]
    velocity: tuple[float, float, float]
    """Estimated vx, vy, yaw rate."""
    height: float
    rpy: tuple[float, float, float]
    voltage: float
    max_temperature: float
    speed_share: float = 1.0
    """Share of the commanded velocity that heat and supply leave."""
    torque_share: float = 1.0
    """Share of the peak torque that the most limited motor is given."""
    tick_p50: float
    """Compute time of a tick over the last second, s."""
    tick_p99: float
    clamps: dict[str, int]
    """How often each clamp acted since the start."""
    solver: dict[str, int]
    """How often each solver status came since the start."""
    recordings_refused: dict[str, int] = {}
    """How often the flight recorder could not write, by the reason."""
    refused: dict[str, int] = {}
    """How many messages were refused or shed since the start, by key."""
    wires: dict[str, int] = {}
    """What went wrong on the body's wires since the start, by its name: late and missed replies, frames, samples."""
