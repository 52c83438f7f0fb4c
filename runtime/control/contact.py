"""Foot force from joint torque, and contact from foot force. Method: Contact from torque."""

from __future__ import annotations

from runtime.control.compilation import compiled

SINGULAR = 1e-5
"""A leg whose Jacobian has a smaller determinant (m³) tells no force."""


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
    force that an unloaded leg is given feels like ground until the leg has run away.
    """
    follow = p.dt / (p.dt + p.force_time_constant)
    resting = 0
    for leg in range(4):
        force = t.contact_force[leg, 2] - p.contact_baseline[leg]
        s.pressure[leg] += (force - s.pressure[leg]) * (follow if s.started else 1.0)
        if s.contacts[leg]:
            s.contacts[leg] = force > p.contact_release
        else:
            blind = s.swinging[leg] and s.phase[leg] < p.contact_blanking
            s.contacts[leg] = min(force, s.pressure[leg]) > p.contact_threshold and not blind
        dx, dy = m.odometry[leg, 0] - s.velocity[0], m.odometry[leg, 1] - s.velocity[1]
        dz = m.odometry[leg, 2] - s.velocity[2]
        s.lifted[leg] = dx * dx + dy * dy + dz * dz > p.lift_speed * p.lift_speed
        resting += s.contacts[leg] and not s.lifted[leg]
    for leg in range(4):
        s.lifted[leg] = s.lifted[leg] and resting > 0
        s.contacts[leg] = s.contacts[leg] and not s.lifted[leg]
        t.contacts[leg] = s.contacts[leg]
