"""Foot force from joint torque, and contact from foot force. Method: Contact from torque."""

from __future__ import annotations

import math

from runtime.control.compilation import compiled

SINGULAR = 1e-5
"""A leg whose Jacobian has a smaller determinant (m³) tells no force."""
AT_REST = 0.3
"""m/s: a foot that is slower over the ground may stand on it."""
BEARING = 1.5
"""Of the threshold: a leg that presses harder must feel the ground that it presses on."""
BEGUN = 0.5
"""s of a walk in which its commands may still be blended with those before: what a leg was told is not what it does."""
HONEST = 0.2
"""Share of a swing or a stance in which a foot must have told what its leg knows."""


@compiled
def foot_force(gravity, torque, jacobian, force):  # type: ignore[no-untyped-def]
    """Ground on foot of one leg, body frame, N, written into ``force`` (3,): f = -J⁻ᵀ (torque - gravity).

    ``gravity`` (3,) holds the leg's own links (``kinematics``). Inertial forces of a swinging leg are not modelled.
    """
    r0, r1, r2 = gravity[0] - torque[0], gravity[1] - torque[1], gravity[2] - torque[2]
    determinant = 0.0
    for i in range(3):
        a, b = jacobian[(i + 1) % 3], jacobian[(i + 2) % 3]
        # rows of J⁻ᵀ are cross products of the rows of J over the determinant
        c0, c1, c2 = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
        force[i] = c0 * r0 + c1 * r1 + c2 * r2
        determinant = jacobian[i, 0] * c0 + jacobian[i, 1] * c1 + jacobian[i, 2] * c2
    scale = 0.0 if abs(determinant) < SINGULAR else 1.0 / determinant
    for i in range(3):
        force[i] *= scale


@compiled
def feel_contacts(p, s, t, m):  # type: ignore[no-untyped-def]
    """Contact of every foot from the vertical force, with hysteresis; early in a swing none can begin, only end.

    Contact begins on the low-passed force: the inertia of a swinging leg tells forces of its own that change sign from
    tick to tick, a landing does not. What commissioning found a leg to feign (``contact_baseline``) is taken off first.
    A foot that moves over the ground while another one rests is in the air whatever its torque says (``lifted``): the
    force that an unloaded leg is given feels like ground until the leg has run away. Of a foot that lies (``_doubt``)
    the gait's schedule says whether it is down.
    """
    follow = p.dt / (p.dt + p.force_time_constant)
    resting = 0
    feet = m.foot_in_world
    lowest = min(feet[0, 2], feet[1, 2], feet[2, 2], feet[3, 2])
    for leg in range(4):
        force = t.contact_force[leg, 2] - p.contact_baseline[leg]
        s.pressure[leg] += (force - s.pressure[leg]) * (follow if s.started else 1.0)
        if s.felt[leg]:
            s.felt[leg] = force > p.contact_release
        else:
            blind = s.swinging[leg] and s.phase[leg] < p.contact_blanking
            s.felt[leg] = min(force, s.pressure[leg]) > p.contact_threshold and not blind
        dx, dy = m.odometry[leg, 0] - s.velocity[0], m.odometry[leg, 1] - s.velocity[1]
        dz = m.odometry[leg, 2] - s.velocity[2]
        speed = dx * dx + dy * dy + dz * dz
        s.lifted[leg] = speed > p.lift_speed * p.lift_speed
        _doubt(p, s, t, m, leg, feet[leg, 2] - lowest, speed < AT_REST * AT_REST)
        s.contacts[leg] = not s.swinging[leg] if s.doubt[leg] > 0.0 else s.felt[leg]
        resting += s.contacts[leg] and not s.lifted[leg]
    for leg in range(4):
        s.lifted[leg] = s.lifted[leg] and resting > 0
        s.felt[leg] = s.felt[leg] and not s.lifted[leg]
        s.contacts[leg] = s.contacts[leg] and not s.lifted[leg]
        t.contacts[leg] = s.contacts[leg]


@compiled
def _doubt(p, s, t, m, leg, height, at_rest):  # type: ignore[no-untyped-def]
    """How long what this foot feels is not to be believed, from what its leg does.

    It lies if in swing after swing it bears while it rises (``height`` is above the lowest foot, whatever the body
    does), or if in stance after stance it rests where its leg presses, and feels nothing. Once is no proof: a foot is
    caught, slips off an edge, or stands beside stiffer legs on uneven ground. A lie is the same in every stride.
    """
    s.doubt[leg] = max(0.0, s.doubt[leg] - p.dt)
    if s.swinging[leg] != s.swung[leg]:
        ended = s.swung[leg]
        if s.tested[leg] >= p.lie_time[ended]:
            s.lies[leg, ended] = s.lies[leg, ended] + 1 if s.honest[leg] < HONEST * s.tested[leg] else 0
            if s.lies[leg, ended] >= p.lie_strides:
                s.lies[leg, ended], s.doubt[leg] = p.lie_strides, p.doubt_time
        s.swung[leg] = s.swinging[leg]
        s.tested[leg] = s.honest[leg] = 0.0
    if s.swinging[leg]:
        risen = s.phase[leg] < 0.5 * math.pi and height - s.ground[leg] > p.lie_rise
        shows = risen and not at_rest
        honest = s.pressure[leg] < p.contact_threshold  # a quick swing's inertia feigns half of it
    else:
        s.ground[leg] = height
        pressed = _press(p, s, t, m, leg) if s.searching[leg] else t.grf[leg, 2]
        shows = at_rest and s.walked > BEGUN and pressed > BEARING * p.contact_threshold
        honest = s.felt[leg]
    if shows:
        s.tested[leg] += p.dt
        s.honest[leg] += p.dt if honest else 0.0


@compiled
def _press(p, s, t, m, leg):  # type: ignore[no-untyped-def]
    """Vertical force with which the springs of this leg's joints press its foot down, N."""
    for i in range(3):
        m.angles[i] = s.gain_scale[leg] * p.kp[i] * (s.joint_targets[leg, i] - m.joints[0, leg, i])
    m.gravity[:] = 0.0
    foot_force(m.gravity, m.angles, m.jacobian[leg], m.force)
    rotation = m.rotation
    return rotation[2, 0] * m.force[0] + rotation[2, 1] * m.force[1] + rotation[2, 2] * m.force[2]
