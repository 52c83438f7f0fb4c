"""Encoders that stand still and should not.

A reading that does not change by one bit is no fault in itself: a robot at rest has such. It is one where the joint
must have moved: its motor's torque changed by more than could hold it, or its leg went elsewhere while the feet bore
the robot. (One that stands up may hold a joint ideally still beside moving ones.) What could hold it is friction, and
much more where something clamps it: an end stop, on which a folded leg rests, or the ground under a robot that lies on
its legs. A robot that stands on its feet and tilts turns every joint whose axis it tilts about; one that walks moves
every joint that is told to. Judged only while the robot is not damped, since limp joints are moved one at a time, by
hand.

While a robot stands still a stuck encoder cannot be told from a joint at rest, and does no harm: its motor holds with
the torque that it held with before. The first tilt or the first step shows it.
"""

from __future__ import annotations

from runtime.control.compilation import compiled
from runtime.messages.mode import Mode
from runtime.plausibility import PROMPT
from runtime.reasons import Reason
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
    w, x, y, z = m.imu[0], m.imu[1], m.imu[2], m.imu[3]
    lean = 2.0 * (y * z + w * x) if joint == 0 else 2.0 * (x * z - w * y)
    if changed or not bearing:
        m.still_tilt[leg, joint], m.told[leg, joint] = lean, 0.0
    if t.mode == _WALK and free and not changed and t.joint_age[leg, joint] < PROMPT * b.period:
        m.told[leg, joint] += abs(m.commands[1, 1, leg, joint]) * b.period
    tilted = t.mode == _STAND and abs(lean - m.still_tilt[leg, joint]) > b.stuck_tilt
    still = m.still[leg, joint]
    if still >= b.stuck_time and (pushed or tilted or moved > b.stuck_motion):
        find(m, b, _STUCK, 3 * leg + joint, still, b.stuck_time)
    elif m.told[leg, joint] > b.stuck_told:
        find(m, b, _STUCK, 3 * leg + joint, still, 0.0)
