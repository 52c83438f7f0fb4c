"""From foot targets and ground reaction forces to what the motors get. Paper Eq. 5-6."""

from __future__ import annotations

from runtime.control.compilation import compiled
from runtime.control.estimator import transposed_times
from runtime.control.kinematics import angles_of_leg
from runtime.control.records import Clamp

_REACH, _JOINT_LIMIT, _JOINT_SPEED = int(Clamp.REACH), int(Clamp.JOINT_LIMIT), int(Clamp.JOINT_SPEED)
GAIN_RISE = 0.5
"""s over which a leg's gains rise to those of standing."""


@compiled
def command_joints(p, g, s, t, m, standing, out):  # type: ignore[no-untyped-def]
    """Joint targets, gains and feed-forward torque of all legs, into ``t`` and ``out`` (5, 4, 3).

    Swing: full gains, no feed-forward. Stance: -Jᵀ f with the scaled gains. The wanted joint speed is the bounded
    difference of the targets, zero on the tick where a leg changes between swing and stance.
    """
    rotation, jacobian, foot, force, target = m.rotation, m.jacobian, m.foot, m.force, m.angles
    for leg in range(4):
        changed = s.stance[leg] != t.stance[leg] or not s.commanded
        transposed_times(rotation, t.foot_targets[leg], foot)
        if not angles_of_leg(g, leg, foot, target):
            t.clamps |= _REACH
        transposed_times(rotation, t.grf[leg], force)
        _schedule_gain(p, s, t, leg, standing)
        for i in range(3):
            bounded = min(g.upper[leg, i], max(g.lower[leg, i], target[i]))
            if bounded != target[i]:
                t.clamps |= _JOINT_LIMIT
            speed = 0.0 if changed else (bounded - s.joint_targets[leg, i]) / p.dt
            if abs(speed) > p.max_joint_speed:
                speed = p.max_joint_speed if speed > 0.0 else -p.max_joint_speed
                t.clamps |= _JOINT_SPEED
            s.joint_targets[leg, i] = bounded
            t.command_position[leg, i] = bounded
            t.command_velocity[leg, i] = speed
            t.command_kp[leg, i] = s.gain_scale[leg] * p.kp[i]
            t.command_kd[leg, i] = s.gain_scale[leg] * p.kd[i]
            t.command_torque[leg, i] = -(
                jacobian[leg, 0, i] * force[0] + jacobian[leg, 1, i] * force[1] + jacobian[leg, 2, i] * force[2]
            )
        s.stance[leg] = t.stance[leg]
    s.commanded = 1
    out[0], out[1], out[2] = t.command_position, t.command_velocity, t.command_kp
    out[3], out[4] = t.command_kd, t.command_torque


@compiled
def damp_joints(p, t, out):  # type: ignore[no-untyped-def]
    """The safe command, only damping without stiffness or feed-forward, into ``t`` and ``out`` (5, 4, 3)."""
    out[:] = 0.0
    for leg in range(4):
        out[3, leg] = p.kd
    t.command_position[:], t.command_velocity[:], t.command_kp[:] = out[0], out[1], out[2]
    t.command_kd[:], t.command_torque[:] = out[3], out[4]


@compiled
def _schedule_gain(p, s, t, leg, standing):  # type: ignore[no-untyped-def]
    if not t.stance[leg]:
        s.gain_scale[leg] = 1.0
    elif standing:
        s.gain_scale[leg] = max(p.stance_scale, s.gain_scale[leg])
        if s.gain_scale[leg] < p.standing_scale:
            s.gain_scale[leg] = min(p.standing_scale, s.gain_scale[leg] + p.dt / GAIN_RISE)
        elif s.gain_scale[leg] > p.standing_scale:
            s.gain_scale[leg] = max(p.standing_scale, s.gain_scale[leg] - p.dt / GAIN_RISE)
    else:
        s.gain_scale[leg] = p.stance_scale
