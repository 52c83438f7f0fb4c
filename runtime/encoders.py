"""Encoders that stand still and should not.

A reading that does not change by one bit is no fault in itself: a robot at rest has such. It is one where the joint
must have moved: its motor's torque changed by more than could hold it, or its leg went elsewhere while the feet bore
the robot. (One that stands up may hold a joint ideally still beside moving ones.) What could hold it is friction, and
much more where something clamps it: an end stop, on which a folded leg rests, or the ground under a robot that lies on
its legs. Judged only while the robot is not damped, since limp joints are moved one at a time, by hand.
"""

from __future__ import annotations

from runtime.control.compilation import compiled
from runtime.messages.mode import Mode
from runtime.modes import Reason
from runtime.verdict import find

_DAMP, _STAND, _WALK = int(Mode.DAMP), int(Mode.STAND), int(Mode.WALK)
_STUCK = int(Reason.STUCK_ENCODER)


@compiled
def look_at_encoder(t, b, m, leg, joint):  # type: ignore[no-untyped-def]
    """One finite reading against the one before: an encoder that is stuck. ``t.mode`` is still the last tick's."""
    bearing = t.mode == _STAND or t.mode == _WALK
    position, torque = t.joint_position[leg, joint], t.joint_torque[leg, joint]
    changed = t.mode == _DAMP or position != m.position[leg, joint] or m.still[leg, joint] < 0.0
    if changed:
        m.still[leg, joint] = -b.period
        m.lowest[leg, joint] = m.highest[leg, joint] = torque
    m.still[leg, joint] += b.period
    m.lowest[leg, joint] = min(m.lowest[leg, joint], torque)
    m.highest[leg, joint] = max(m.highest[leg, joint], torque)
    moved = 0.0
    for other in range(3):
        if changed or not bearing:
            m.still_leg[leg, joint, other] = t.joint_position[leg, other]
        moved = max(moved, abs(t.joint_position[leg, other] - m.still_leg[leg, joint, other]))
    free = bearing and b.stop_lower[leg, joint] < position < b.stop_upper[leg, joint]
    share = b.stuck_torque if free else b.clamped_torque
    pushed = m.highest[leg, joint] - m.lowest[leg, joint] > share * b.peak_torque[joint]
    if m.still[leg, joint] >= b.stuck_time and (pushed or moved > b.stuck_motion):
        find(m, b, _STUCK, 3 * leg + joint, m.still[leg, joint], b.stuck_time)
