"""What the pipeline follows: the operator's velocity with bounded acceleration, plus the integral of its error."""

from __future__ import annotations

import math

from runtime.control.compilation import compiled
from runtime.control.records import Clamp

_COMMAND = int(Clamp.COMMAND)
HEADING_SLACK = 0.5
"""The commanded heading never leads or trails the body by more, rad: a blocked robot does not wind up."""


@compiled
def follow(p, policy, s, t, linear, yaw_rate, standing):  # type: ignore[no-untyped-def]
    """Fill ``velocity_command`` (3,) from the asked ``linear`` (2,) and ``yaw_rate``. Method: Past the teacher 1.

    The integral freezes while the error is large (a push is not an offset) and in the first moments of a walk.
    """
    for i in range(3):
        asked = yaw_rate if i == 2 else linear[i]
        bounded = min(p.velocity_bound[i], max(-p.velocity_bound[i], asked))
        if bounded != asked:
            t.clamps |= _COMMAND
        wanted = 0.0 if standing else bounded
        step = p.acceleration_bound[i] * p.dt
        s.followed[i] += min(step, max(-step, wanted - s.followed[i]))
        t.velocity_command[i] = s.followed[i]
    s.walked = 0.0 if standing else s.walked + p.dt
    ex, ey = s.followed[0] - t.twist[0], s.followed[1] - t.twist[1]
    if standing:
        s.integral[:] = 0.0
    elif s.walked > policy.integral_delay and math.hypot(ex, ey) < policy.integral_freeze:
        bound = policy.integral_bound
        s.integral[0] = min(bound, max(-bound, s.integral[0] + policy.velocity_integral * ex * p.dt))
        s.integral[1] = min(bound, max(-bound, s.integral[1] + policy.velocity_integral * ey * p.dt))
    t.velocity_command[0] += s.integral[0]
    t.velocity_command[1] += s.integral[1]
    s.heading += s.followed[2] * p.dt
    error = wrapped(t.rpy[2] - s.heading)
    if s.walked == 0.0 and not s.remembered:
        error = 0.0
    error = min(HEADING_SLACK, max(-HEADING_SLACK, error))
    s.heading = wrapped(t.rpy[2] - error)


@compiled
def wrapped(angle):  # type: ignore[no-untyped-def]
    """The same angle in [-pi, pi), rad."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))
