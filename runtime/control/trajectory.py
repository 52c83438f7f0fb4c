"""Where the feet go: touchdown points, swing and stance paths. Paper Eq. 1-2, as mended by method.md."""

from __future__ import annotations

import math

from runtime.control.compilation import compiled


@compiled
def aim_feet(p, g, policy, s, t):  # type: ignore[no-untyped-def]
    """Fill ``touchdown`` (4, 2) and ``foot_targets`` (4, 3), heading frame from the body origin, m.

    Swing covers the remaining way in the remaining time; stance moves against the commanded velocity at the foot. The
    target is set to the measured foot only at liftoff and at the end of a swing: taken anew every tick it would leave
    the motors an error of one step and no drive.
    """
    ground = g.foot_radius - p.walking_height - p.body_pose[3]
    turn = p.body_pose[2] - s.posed_yaw
    s.posed_yaw = p.body_pose[2]
    for leg in range(4):
        target = s.foot_targets[leg]
        nominal = p.nominal_footholds[leg]
        vx = t.velocity_command[0] - t.velocity_command[2] * nominal[1]
        vy = t.velocity_command[1] + t.velocity_command[2] * nominal[0]
        t.touchdown[leg, 0] = nominal[0] + 0.5 * p.stance_time * vx + t.action[3 * leg]
        t.touchdown[leg, 1] = nominal[1] + 0.5 * p.stance_time * vy + t.action[3 * leg + 1]
        if s.stance[leg] != t.stance[leg]:
            target[:] = t.feet[leg]
        if s.swinging[leg]:
            left = max(p.dt, p.swing_time * (1.0 - t.phase[leg] / math.pi))
            share = p.dt / left
            target[0] += (t.touchdown[leg, 0] - target[0]) * share
            target[1] += (t.touchdown[leg, 1] - target[1]) * share
            target[2] = ground + (p.swing_height + policy.swing_lift) * math.sin(t.phase[leg])
        else:
            vx = t.velocity_command[0] - t.velocity_command[2] * target[1]
            vy = t.velocity_command[1] + t.velocity_command[2] * target[0]
            target[0] -= vx * p.dt
            target[1] -= vy * p.dt
            if turn != 0.0:
                x, y = target[0], target[1]
                target[0] = math.cos(turn) * x + math.sin(turn) * y
                target[1] = math.cos(turn) * y - math.sin(turn) * x
            s.depth[leg] = min(p.search_depth, s.depth[leg] + p.search_speed * p.dt) if s.searching[leg] else 0.0
            target[2] = ground - s.depth[leg]
        t.foot_targets[leg, 0], t.foot_targets[leg, 1] = target[0], target[1]
        rise = policy.slope_feet * (t.slope[0] * target[0] + t.slope[1] * target[1])
        t.foot_targets[leg, 2] = target[2] + rise + t.action[3 * leg + 2]
