"""The estimate now and one tick ago as the policy sees it (28,). Paper III.A.1; method: Observation."""

from __future__ import annotations

import math

from runtime.control.command import wrapped
from runtime.control.compilation import compiled
from runtime.control.records import Clamp

OBSERVATION_NAMES = tuple(
    f"{name}{when}"
    for when in ("", "_before")
    for name in (
        *("height", "roll", "pitch", "yaw"),
        *("velocity_x", "velocity_y", "velocity_z"),
        *("rate_x", "rate_y", "rate_z"),
        *("contact_FL", "contact_FR", "contact_BL", "contact_BR"),
    )
)
_OBSERVATION = int(Clamp.OBSERVATION)


@compiled
def observe(p, policy, s, t):  # type: ignore[no-untyped-def]
    """Fill ``observation`` (28,) with 14 numbers now and the same 14 one tick ago, less the policy's offset, scaled.

    The *relative* reading subtracts what is wanted: walking height, commanded heading, commanded velocity and turn. The
    *plain* one is the paper's letter. Both subtract the body pose that the operator asks for. The velocity error is
    bounded where the policy says so (Past the teacher 4).
    """
    now = t.observation
    now[0] = t.height
    now[1], now[2], now[3] = t.rpy[0], t.rpy[1], t.rpy[2]
    for i in range(6):
        now[4 + i] = t.twist[i]
    for leg in range(4):
        now[10 + leg] = t.contacts[leg]
    if policy.relative:
        now[0] -= p.walking_height
        now[1] -= policy.slope_body * math.atan(t.slope[1])
        now[2] += policy.slope_body * math.atan(t.slope[0])
        now[3] = wrapped(t.rpy[2] - s.heading)
        now[9] -= s.followed[2]
        for i in range(2):
            error = t.twist[i] - t.velocity_command[i]
            bound = policy.velocity_error_bound
            now[4 + i] = min(bound, max(-bound, error))
            if now[4 + i] != error:
                t.clamps |= _OBSERVATION
    now[0] -= p.body_pose[3]
    for i in range(3):
        now[1 + i] -= p.body_pose[i]
    for i in range(14):
        before = s.previous[i] if s.remembered else now[i]
        s.previous[i] = now[i]
        s.seen[i], s.seen[14 + i] = now[i], before
        t.observation[i] = (now[i] - policy.observation_offset[i]) * policy.observation_scale[i]
        t.observation[14 + i] = (before - policy.observation_offset[14 + i]) * policy.observation_scale[14 + i]
    s.remembered = 1
