"""Where the teacher is told to go and which feet will carry it: the horizon's reference path and contact schedule."""

from __future__ import annotations

import math

from runtime.control.compilation import compiled
from training.rigid_body import STATES, P, R, V, W


@compiled
def x_and_y(origin, yaw, com):  # type: ignore[no-untyped-def]
    """Centre of mass of a level body whose origin is at ``origin``."""
    c, s = math.cos(yaw), math.sin(yaw)
    return origin[0] + c * com[0] - s * com[1], origin[1] + s * com[0] + c * com[1]


@compiled
def plan_path(position, yaw, command, com, dt, path, here, expected):  # type: ignore[no-untyped-def]
    """Fill ``path`` (steps, 12) with a level body that follows ``command`` (steps, 3) = vx, vy, yaw rate from here.

    ``position`` (3,) is where the body origin is wanted now, its height included, m; ``com`` (3,) the centre of mass
    from the origin, body frame: the states are the centre of mass's. ``expected`` (steps, 3) is the same way taken from
    where the centre of mass is, ``here`` (3,): arms of forces must be the ones that will be, not the wanted ones.
    """
    start_x, start_y = x_and_y(position, yaw, com)
    x, y = position[0], position[1]
    for k in range(path.shape[0]):
        now_x, now_y = x_and_y((x, y), yaw, com)
        expected[k, 0], expected[k, 1], expected[k, 2] = here[0] + now_x - start_x, here[1] + now_y - start_y, here[2]
        vx, vy, rate = command[k]
        middle = yaw + 0.5 * dt * rate
        x += dt * (vx * math.cos(middle) - vy * math.sin(middle))
        y += dt * (vx * math.sin(middle) + vy * math.cos(middle))
        yaw += dt * rate
        c, s = math.cos(yaw), math.sin(yaw)
        cx, cy = c * com[0] - s * com[1], s * com[0] + c * com[1]
        path[k, :STATES] = 0.0
        path[k, P], path[k, P + 1], path[k, P + 2] = x + cx, y + cy, position[2] + com[2]
        path[k, V] = vx * c - vy * s - rate * cy
        path[k, V + 1] = vx * s + vy * c + rate * cx
        path[k, R + 2] = yaw
        path[k, W + 2] = rate


@compiled
def foothold(position, yaw, command, touchdown, after, foot):  # type: ignore[no-untyped-def]
    """Point (3,) on level ground where a foot lands ``after`` s from now, into ``foot``.

    ``touchdown`` (2,) is the landing point from the body origin in the heading frame of that moment, m.
    """
    middle = yaw + 0.5 * after * command[2]
    then = yaw + after * command[2]
    foot[0] = position[0] + after * (command[0] * math.cos(middle) - command[1] * math.sin(middle))
    foot[1] = position[1] + after * (command[0] * math.sin(middle) + command[1] * math.cos(middle))
    foot[0] += touchdown[0] * math.cos(then) - touchdown[1] * math.sin(then)
    foot[1] += touchdown[0] * math.sin(then) + touchdown[1] * math.cos(then)
    foot[2] = 0.0


@compiled
def plan_contacts(  # type: ignore[no-untyped-def]
    p, clock, stance_now, feet_now, touchdown, position, yaw, command, dt, feet, stance
):
    """Fill ``stance`` (steps, 4) and contact points ``feet`` (steps, 4, 3) in the world from the gait's clock.

    The first step is what the legs do now (``stance_now`` (4,), ``feet_now`` (4, 3)), the others what the gait of
    ``p`` says at their middle. A foot stays where it is until its next swing; then it stands on its foothold, about
    ``position`` as it moves on with ``command``. A leg that landed early stays down until its next swing.
    """
    for leg in range(4):
        share = (clock + p.gait_offset[leg]) % 1.0
        early = stance_now[leg] and share < p.swing_fraction
        planted = stance_now[leg]
        for k in range(feet.shape[0]):
            middle = (k + 0.5) * dt
            share = (clock + p.gait_offset[leg] + middle / p.cycle_time) % 1.0
            carries = share >= p.swing_fraction
            early = early and not carries
            stands = stance_now[leg] if k == 0 else carries or early
            stance[k, leg] = stands
            planted = planted and stands
            if planted:
                feet[k, leg] = feet_now[leg]
            else:
                since = (share - p.swing_fraction) * p.cycle_time if carries else 0.0
                foothold(position, yaw, command, touchdown[leg], max(0.0, middle - since), feet[k, leg])
