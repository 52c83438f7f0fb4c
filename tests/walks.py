"""A walk in the simulator without a daemon, kept by the flight recorder."""

from __future__ import annotations

from pathlib import Path

from runtime.messages.mode import Mode, Request
from trotd.bench.outing import Outing as Walk

__all__ = ["Walk", "walk_around"]


def walk_around(folder: Path) -> Walk:
    """Stand up, walk a curve, be pushed, stand, sit."""
    walk = Walk(folder)
    walk.stand()
    walk.run(0.3)
    walk.ask(Request.WALK)
    walk.run(1.5, (0.6, 0.0, 0.0))
    walk.run(1.5, (0.4, 0.2, 0.6))
    walk.world.push((0.0, 150.0, 0.0), 0.1)
    walk.run(1.0, (0.4, 0.0, 0.0))
    walk.ask(Request.STAND)
    walk.run(0.8)
    walk.ask(Request.SIT)
    walk.until(lambda: walk.cycle.state.mode is Mode.DAMP)
    walk.run(0.2)
    return walk
