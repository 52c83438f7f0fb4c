"""How much torque and speed are left: heat, rms torque, supply and soft start take back before anything gives up."""

from __future__ import annotations

import math

from runtime.control.compilation import compiled
from runtime.control.records import Clamp

_TORQUE, _THERMAL, _CURRENT = int(Clamp.TORQUE), int(Clamp.THERMAL), int(Clamp.CURRENT)
_SOFT_START = int(Clamp.SOFT_START)
CONTINUOUS_SHARE = 0.9
"""Of the continuous rating: what a motor is given whose rms torque has reached that rating."""


@compiled
def _left(value, start, end, floor):  # type: ignore[no-untyped-def]
    """1 up to ``start``, on a straight line down to ``floor`` at ``end``."""
    if value <= start or end <= start:
        return 1.0
    return 1.0 - (1.0 - floor) * min(1.0, (value - start) / (end - start))


@compiled
def derate_joint(t, b, m, leg, joint):  # type: ignore[no-untyped-def]
    """This tick's torque bound of one motor, N·m, and the Clamp bit of whatever sets it."""
    peak, continuous = b.peak_torque[joint], b.continuous_torque[joint]
    bound, cause = peak, _TORQUE
    heat = peak * _left(t.joint_temperature[leg, joint], b.thermal_start, b.temperature, b.thermal_floor)
    if heat < bound:
        bound, cause = heat, _THERMAL
    rms = math.sqrt(m.mean_square[leg, joint])
    floor = min(1.0, CONTINUOUS_SHARE * continuous / peak)
    current = peak * _left(rms, b.current_start * continuous, continuous, floor)
    if current < bound:
        bound, cause = current, _CURRENT
    if m.ramp * peak < bound:
        bound, cause = m.ramp * peak, _SOFT_START
    m.torque_bound[leg, joint], m.torque_cause[leg, joint] = bound, cause


@compiled
def derate_speed(t, b, m):  # type: ignore[no-untyped-def]
    """Share of the commanded velocity that heat and supply leave."""
    hottest = t.joint_temperature[0, 0]
    for leg in range(4):
        for joint in range(3):
            hottest = max(hottest, t.joint_temperature[leg, joint])
    share = _left(hottest, b.thermal_start, b.temperature, b.speed_floor)
    if b.voltage_start > 0.0:
        share = min(share, _left(-t.voltage, -b.voltage_start, -b.voltage, b.speed_floor))
    m.speed_share = share


@compiled
def ramp_up(t, b, m):  # type: ignore[no-untyped-def]
    """The soft start's share: none in DAMP, growing from the tick on that left it."""
    m.ramp = 0.0 if t.mode == 0 else min(1.0, m.ramp + b.soft_start)
