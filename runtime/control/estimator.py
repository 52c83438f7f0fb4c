"""Attitude, velocity, feet and height of the body from one measurement: a linear Kalman filter.

State: velocity of the body origin and the four feet relative to it, all in world axes; so nothing unobservable is
carried. Input: the accelerometer. Measurements: for every foot in contact, where it is and how fast the body must move
for it to stay (leg odometry). Noise is isotropic and the axes do not mix, so the 15-state filter is three filters of
five states with one shared covariance, updated by scalars: exact, and a microsecond.
After Bloesch et al., "State Estimation for Legged Robots", with attitude taken from the inertial unit.
"""

from __future__ import annotations

import math

from runtime.control.compilation import compiled
from runtime.control.contact import feel_contacts, foot_force
from runtime.control.kinematics import GRAVITY, foot_from_sines, gravity_from_sines, jacobian_from_sines, sines_of_leg

STEEPEST = 0.4
"""Bound of the estimated slope, rise over run."""


@compiled
def rotation_from(q, rotation):  # type: ignore[no-untyped-def]
    """Rotation body to world (3, 3) of the quaternion w x y z, normalised."""
    scale = 2.0 / (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    w, x, y, z = q[0], q[1], q[2], q[3]
    rotation[0, 0] = 1.0 - scale * (y * y + z * z)
    rotation[0, 1] = scale * (x * y - w * z)
    rotation[0, 2] = scale * (x * z + w * y)
    rotation[1, 0] = scale * (x * y + w * z)
    rotation[1, 1] = 1.0 - scale * (x * x + z * z)
    rotation[1, 2] = scale * (y * z - w * x)
    rotation[2, 0] = scale * (x * z - w * y)
    rotation[2, 1] = scale * (y * z + w * x)
    rotation[2, 2] = 1.0 - scale * (x * x + y * y)


@compiled
def times(rotation, vector, out):  # type: ignore[no-untyped-def]
    """Write rotation (3, 3) times vector (3,) into ``out`` (3,)."""
    for i in range(3):
        out[i] = rotation[i, 0] * vector[0] + rotation[i, 1] * vector[1] + rotation[i, 2] * vector[2]


@compiled
def turned(rotation, x, y, z):  # type: ignore[no-untyped-def]
    """Rotation (3, 3) times the vector x y z, as three numbers."""
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )


@compiled
def transposed_times(rotation, vector, out):  # type: ignore[no-untyped-def]
    """Write rotation transposed times vector (3,) into ``out`` (3,)."""
    for i in range(3):
        out[i] = rotation[0, i] * vector[0] + rotation[1, i] * vector[1] + rotation[2, i] * vector[2]


@compiled
def estimate(p, g, s, t, m):  # type: ignore[no-untyped-def]
    """One tick of contact, filter and height: fills the estimate's fields of the tick record ``t``.

    ``m`` is working memory of ``WORK_DTYPE`` (``state``): the measurement is read there, what later rooms need again
    is left there.
    """
    rotation, to_world = m.rotation, m.to_world
    rotation_from(m.imu[:4], to_world)
    yaw = math.atan2(to_world[1, 0], to_world[0, 0])
    t.rpy[0] = math.atan2(to_world[2, 1], to_world[2, 2])
    t.rpy[1] = -math.asin(min(1.0, max(-1.0, to_world[2, 0])))
    t.rpy[2] = yaw
    c, sn = math.cos(yaw), math.sin(yaw)
    for i in range(3):
        rotation[0, i] = c * to_world[0, i] + sn * to_world[1, i]
        rotation[1, i] = -sn * to_world[0, i] + c * to_world[1, i]
        rotation[2, i] = to_world[2, i]
    for leg in range(4):
        sines = sines_of_leg(m.joints[0, leg])
        foot_from_sines(g, leg, sines, m.foot)
        jacobian_from_sines(g, leg, sines, m.jacobian[leg])
        gravity_from_sines(g, leg, sines, to_world[2], m.gravity)
        times(rotation, m.foot, t.feet[leg])
        times(to_world, m.foot, m.foot_in_world[leg])
        foot_force(m.gravity, m.joints[2, leg], m.jacobian[leg], m.force)
        times(rotation, m.force, t.contact_force[leg])
        _leg_odometry(g, m, leg, sines)
    feel_contacts(p, s, t, m)
    if not s.started:
        _start(p, s, m.foot_in_world)
    _predict(p, s, m)
    for leg in range(4):
        _update(p, s, m, leg)
    _height(p, g, s, t)
    _slope(p, s, t, c, sn)
    t.twist[0] = c * s.velocity[0] + sn * s.velocity[1]
    t.twist[1] = -sn * s.velocity[0] + c * s.velocity[1]
    t.twist[2] = s.velocity[2]
    times(rotation, m.imu[4:7], t.twist[3:6])
    for i in range(3):
        s.position[i] += s.velocity[i] * p.dt
        t.position[i] = s.position[i]


@compiled
def _leg_odometry(g, m, leg, sines):  # type: ignore[no-untyped-def]
    """Velocity that the body has if this foot rolls without slipping, and of the rolling foot's centre, world.

    A sphere's centre moves while its shank turns above the ground: 5 % of the walking speed.
    """
    speed, foot, rate = m.joints[1, leg], m.foot, m.imu[4:7]
    x, y, z = turned(m.jacobian[leg], speed[0], speed[1], speed[2])
    x += rate[1] * foot[2] - rate[2] * foot[1]
    y += rate[2] * foot[0] - rate[0] * foot[2]
    z += rate[0] * foot[1] - rate[1] * foot[0]
    x, y, z = turned(m.to_world, x, y, z)
    bend = speed[1] + speed[2]
    turning = rate[0] + speed[0], rate[1] + bend * sines[1], rate[2] + bend * sines[0]
    about_x, about_y, _ = turned(m.to_world, turning[0], turning[1], turning[2])
    m.rolling[leg, 0] = about_y * g.foot_radius
    m.rolling[leg, 1] = -about_x * g.foot_radius
    m.rolling[leg, 2] = 0.0
    m.odometry[leg, 0] = m.rolling[leg, 0] - x
    m.odometry[leg, 1] = m.rolling[leg, 1] - y
    m.odometry[leg, 2] = -z


@compiled
def _start(p, s, in_world):  # type: ignore[no-untyped-def]
    s.velocity[:] = 0.0
    s.support[:] = in_world
    s.covariance[:] = 0.0
    s.covariance[0, 0] = 0.1
    for leg in range(4):
        s.covariance[leg + 1, leg + 1] = p.foot_position_noise**2
    s.height = p.walking_height
    s.rested[:] = p.settling_time
    s.met_ground[:] = 0
    for leg in range(4):
        for i in range(3):
            s.footholds[leg, i] = s.position[i] + in_world[leg, i]
    s.started = 2


@compiled
def _predict(p, s, m):  # type: ignore[no-untyped-def]
    covariance = s.covariance
    for leg in range(4):
        for i in range(3):
            s.support[leg, i] += p.dt * (m.rolling[leg, i] - s.velocity[i])
    x, y, z = turned(m.to_world, m.imu[7], m.imu[8], m.imu[9])
    s.velocity[0] += p.dt * x
    s.velocity[1] += p.dt * y
    s.velocity[2] += p.dt * (z - GRAVITY)
    for leg in range(1, 5):
        for i in range(5):
            covariance[leg, i] -= p.dt * covariance[0, i]
    for leg in range(1, 5):
        for i in range(5):
            covariance[i, leg] -= p.dt * covariance[i, 0]
        covariance[leg, leg] += p.slip_noise**2 * p.dt
    covariance[0, 0] += (p.acceleration_noise * p.dt) ** 2


@compiled
def _update(p, s, m, leg):  # type: ignore[no-untyped-def]
    """Two scalar updates for a foot at rest; one in the air or just landed is only where kinematics says."""
    covariance = s.covariance
    row = leg + 1
    s.rested[leg] = s.rested[leg] + p.dt if s.contacts[leg] else 0.0
    if s.rested[leg] <= p.settling_time:
        s.support[leg] = m.foot_in_world[leg]
        covariance[row, :] = 0.0
        covariance[:, row] = 0.0
        covariance[row, row] = p.foot_position_noise**2
        return
    gain, across = m.gain, m.across
    for state, noise, measured in (
        (row, p.foot_position_noise, m.foot_in_world[leg]),
        (0, p.foot_velocity_noise, m.odometry[leg]),
    ):
        scale = 1.0 / (covariance[state, state] + noise * noise)
        for i in range(5):
            across[i] = covariance[state, i]
            gain[i] = across[i] * scale
        for axis in range(3):
            known = s.velocity[axis] if state == 0 else s.support[leg, axis]
            innovation = measured[axis] - known
            s.velocity[axis] += gain[0] * innovation
            for i in range(4):
                s.support[i, axis] += gain[i + 1] * innovation
        for i in range(5):
            for k in range(5):
                covariance[i, k] -= gain[i] * across[k]


@compiled
def _slope(p, s, t, c, sn):  # type: ignore[no-untyped-def]
    """Low-passed gradient of the plane through the last foothold of every foot, heading frame.

    Nothing is known of it before every foot has rested: four feet in the air under a tilted body span no ground.
    """
    xx, xy, yy, xz, yz = 0.0, 0.0, 0.0, 0.0, 0.0
    middle_x, middle_y, middle_z = 0.0, 0.0, 0.0
    for leg in range(4):
        if s.rested[leg] > p.settling_time:
            s.met_ground[leg] = 1
            for i in range(3):
                s.footholds[leg, i] = s.position[i] + s.support[leg, i]
        middle_x += 0.25 * s.footholds[leg, 0]
        middle_y += 0.25 * s.footholds[leg, 1]
        middle_z += 0.25 * s.footholds[leg, 2]
    for leg in range(4):
        dx, dy = s.footholds[leg, 0] - middle_x, s.footholds[leg, 1] - middle_y
        dz = s.footholds[leg, 2] - middle_z
        x, y = c * dx + sn * dy, c * dy - sn * dx
        xx, xy, yy, xz, yz = xx + x * x, xy + x * y, yy + y * y, xz + x * dz, yz + y * dz
    determinant = xx * yy - xy * xy
    follow = p.dt / (p.dt + p.slope_time_constant)
    if s.met_ground.all() and determinant > 0.01 * (xx + yy) ** 2:
        for i in range(2):
            raw = (yy * xz - xy * yz) / determinant if i == 0 else (xx * yz - xy * xz) / determinant
            raw = min(STEEPEST, max(-STEEPEST, raw))
            s.slope[i] += (raw - s.slope[i]) * follow
    t.slope[0], t.slope[1] = s.slope[0], s.slope[1]


@compiled
def _height(p, g, s, t):  # type: ignore[no-untyped-def]
    """Low-passed height above the feet in contact; without any, the velocity carries it on."""
    total, count = 0.0, 0
    for leg in range(4):
        if s.contacts[leg]:
            total += g.foot_radius - s.support[leg, 2]
            count += 1
    s.height += s.velocity[2] * p.dt
    if count > 0:
        measured = total / count
        if s.started == 2:
            s.height = measured
            s.started = 1
        s.height += (measured - s.height) * p.dt / (p.dt + p.height_time_constant)
    t.height = s.height
