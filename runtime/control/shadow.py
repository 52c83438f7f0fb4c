"""A policy beside the active one: what it would have asked for in the tick that has just been, added up. Pure.

The candidate sees the same estimate and command, with a memory of its own for what it saw and shifted; nothing of the
active core is written to.
"""

from __future__ import annotations

import numpy as np

from runtime.control.compilation import compiled
from runtime.control.observation import observe
from runtime.control.policy import act
from runtime.control.records import Clamp

SUMS_DTYPE = np.dtype(
    [
        ("ticks", "i8"),
        ("not_finite", "i8"),  # ticks in which the candidate answered with no number
        ("clamped_active", "i8"),  # ticks in which a shift or the wrench was at its bound
        ("clamped_candidate", "i8"),
        ("fell_back", "i8"),  # ticks whose forces were not the first solver's
        ("tilt", "f8"),  # largest foreseen roll or pitch of the body, rad
        ("height", "f8"),  # largest distance of the body from its wanted height, m
        ("shift", "f8"),  # sums of squared differences: m²
        ("force", "f8"),  # N²
        ("moment", "f8"),  # N²·m²
        ("along", "f8"),  # inner products of the two wishes, each number in shares of its bound
        ("active", "f8"),
        ("candidate", "f8"),
    ],
    align=True,
)
"""What a shadow adds up. Shape (1,)."""
NOTABLE = 0.03
"""A smaller wish of the active policy, in shares of the bounds, is not asked whether the candidate agrees."""
_CLAMPS = int(Clamp.SHIFT) | int(Clamp.WRENCH)


@compiled
def shadow(parameters, policies, states, records, state, record, ahead, sums):  # type: ignore[no-untyped-def]
    """Live through one tick as the candidate.

    Args:
        parameters: the core's own, read.
        policies: the candidate. Shape (1,).
        states: the candidate's memory. Shape (1,).
        records: the candidate's working record. Shape (1,).
        state: the core's memory after the tick, read.
        record: what the core computed in the tick, read.
        ahead: how far the tilt is foreseen from the body's rates, s.
        sums: what is added to. Shape (1,).
    """
    p, candidate, s, t = parameters[0], policies[0], states[0], records[0]
    core, u, total = state[0], record[0], sums[0]
    records[0] = record[0]
    s.heading, s.followed[:] = core.heading, core.followed
    t.clamps = 0
    observe(p, candidate, s, t)
    finite = act(p, candidate, candidate, s, t)
    total.ticks += 1
    total.clamped_active += (u.clamps & _CLAMPS) != 0
    total.clamped_candidate += (t.clamps & _CLAMPS) != 0
    total.fell_back += u.solver_status > 1
    for i in range(2):
        total.tilt = max(total.tilt, abs(u.rpy[i] - p.body_pose[i] + ahead * u.twist[3 + i]))
    total.height = max(total.height, abs(u.height - p.walking_height - p.body_pose[3]))
    if not finite:
        total.not_finite += 1
        return
    for a in range(12):
        total.shift += (t.action[a] - u.action[a]) ** 2
    if candidate.direct:
        for leg in range(4):
            for i in range(3):
                total.force += (t.grf[leg, i] - u.grf[leg, i]) ** 2
        return
    along = active = own = 0.0
    for a in range(12, 18):
        bound = p.wrench_bound[a - 12]
        mine, theirs = t.action[a] / bound, u.action[a] / bound
        along += mine * theirs
        active += theirs * theirs
        own += mine * mine
        if a < 15:
            total.force += (t.action[a] - u.action[a]) ** 2
        else:
            total.moment += (t.action[a] - u.action[a]) ** 2
    if active > NOTABLE**2:
        total.along += along
        total.active += active
        total.candidate += own
