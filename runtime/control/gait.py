"""The phase clock: which legs should swing, how far their swing is, and early and late contact."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drivers.robot import Array
from runtime.control.compilation import compiled
from runtime.control.parameters import GaitConfig


class GaitPattern(NamedTuple):
    """One gait of the table."""

    begins: tuple[float, float, float, float]
    """When FL FR BL BR begin their swing, as a share of the cycle."""
    duty: float | None
    """Share of the cycle in stance; None: the configured times say it."""
    quickness: float = 1.0
    """Swing time over the configured one: pairs on one side or end tip over, and so must step quicker."""


GAITS: dict[str, GaitPattern] = {
    "trot": GaitPattern((0.0, 0.5, 0.5, 0.0), None),
    "walk": GaitPattern((0.25, 0.75, 0.0, 0.5), 0.75),
    "pace": GaitPattern((0.0, 0.5, 0.0, 0.5), 0.5, 0.75),
    "bound": GaitPattern((0.0, 0.0, 0.5, 0.5), 0.6, 0.75),
    "pronk": GaitPattern((0.0, 0.0, 0.0, 0.0), None),
    "stand": GaitPattern((0.0, 0.0, 0.0, 0.0), 1.0),
}


def gait_table(gait: GaitConfig) -> tuple[Array, float, float]:
    """Phase offsets (4,) of a gait, its swing time and its stance time, s."""
    pattern = GAITS[gait.name]
    swing_time = gait.swing_time * pattern.quickness
    stance_time = gait.stance_time
    if pattern.duty is not None and pattern.duty < 1.0:
        stance_time = swing_time * pattern.duty / (1.0 - pattern.duty)
    return (1.0 - np.array(pattern.begins)) % 1.0, swing_time, stance_time


@compiled
def advance_gait(p, s, t, standing):  # type: ignore[no-untyped-def]
    """Move the clock by one tick and decide swing and stance of every leg.

    A leg swings through its window; after mid-swing a felt contact ends the swing early; a leg that found no ground at
    its window's end searches and is not loaded, and so does one whose foot lifted. While ``standing`` no new swing
    begins, and once all legs stand the clock waits at the cycle's start.
    """
    before = s.clock
    s.clock = (before + p.dt / p.cycle_time) % 1.0
    for leg in range(4):
        share = (s.clock + p.gait_offset[leg]) % 1.0
        begun = share < (before + p.gait_offset[leg]) % 1.0
        in_window = share < p.swing_fraction
        t.phase[leg] = math.pi
        if s.swinging[leg]:
            if in_window:
                t.phase[leg] = math.pi * share / p.swing_fraction
            touched = p.early_contact and s.contacts[leg] and t.phase[leg] > 0.5 * math.pi
            if touched or not in_window:
                s.swinging[leg] = 0
                s.searching[leg] = not s.contacts[leg]
        elif in_window and begun and not standing:
            s.swinging[leg] = 1
            s.searching[leg] = 0
            t.phase[leg] = math.pi * share / p.swing_fraction
        elif s.contacts[leg]:
            s.searching[leg] = 0
        elif s.lifted[leg]:
            s.searching[leg] = 1
        s.phase[leg] = t.phase[leg]
        t.stance[leg] = not (s.swinging[leg] or s.searching[leg])
    if standing and not s.swinging.any():
        s.clock = 1.0 - 1e-9
