"""From the engine's numbers to the exact state and to readings with errors: in numpy it cost as much as a physics step.

Self-contained: numba's own cache looks at this file alone.
"""

from __future__ import annotations

import math

import numba
import numpy as np

GRAVITY = 9.81
"""m/s²."""
STICKING_SPEED = 0.1
"""Dry friction grows linearly up to this joint speed, rad/s: a hard sign would chatter, and a constraint in the physics
engine would cost as much as the rest of the step."""
RAW = 49
"""[joint position 12, velocity 12, motor torque 12, centre of mass 3, orientation x y z w 4, its velocity 3, rate 3],
as the engine gives them: world frame, its own frame of the trunk."""
POSITION, ROTATION, VELOCITY, RATE = slice(0, 3), slice(3, 12), slice(12, 15), slice(15, 18)
BODY = 18
"""The trunk's exact state: origin, rotation body to world, velocity of the origin, rate; world frame."""
READINGS = 46
"""[joint position 12, velocity 12, torque 12, orientation w x y z 4, rate 3, specific force 3]; the last two in the
body frame. Their errors are 45 numbers: three about the body's axes stand for the four of the orientation."""
ERRORS = 45


@numba.njit(cache=True, error_model="numpy")
def read_body(raw, com, principal, before, period, body, exact):  # type: ignore[no-untyped-def]
    """Fill ``body`` (18,) and ``exact`` readings (46,) from ``raw`` (49,).

    Args:
        raw: as ``RAW`` says.
        com: centre of mass in the body frame, m. (3,)
        principal: rotation from the engine's frame of the trunk to the body's. (3, 3)
        before: the origin's velocity one tick ago, world frame, m/s. (3,)
        period: s a tick: the accelerometer reads the mean over the last one.
        body: output.
        exact: output.
    """
    x, y, z, w = raw[39], raw[40], raw[41], raw[42]
    engine = np.empty((3, 3))
    engine[0, 0], engine[0, 1], engine[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    engine[1, 0], engine[1, 1], engine[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    engine[2, 0], engine[2, 1], engine[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    rotation = body[3:12].reshape((3, 3))
    arm = np.empty(3)
    for i in range(3):
        for j in range(3):
            rotation[i, j] = (
                engine[i, 0] * principal[j, 0] + engine[i, 1] * principal[j, 1] + engine[i, 2] * principal[j, 2]
            )
        arm[i] = rotation[i, 0] * com[0] + rotation[i, 1] * com[1] + rotation[i, 2] * com[2]
        body[i] = raw[36 + i] - arm[i]
    p, q, r = raw[46], raw[47], raw[48]
    body[12] = raw[43] - (q * arm[2] - r * arm[1])
    body[13] = raw[44] - (r * arm[0] - p * arm[2])
    body[14] = raw[45] - (p * arm[1] - q * arm[0])
    body[15], body[16], body[17] = p, q, r
    exact[:36] = raw[:36]
    _to_quaternion(rotation, exact[36:40])
    for i in range(3):
        rate = force = 0.0
        for j in range(3):
            rate += rotation[j, i] * body[15 + j]
            force += rotation[j, i] * ((body[12 + j] - before[j]) / period + (GRAVITY if j == 2 else 0.0))
        exact[40 + i], exact[43 + i] = rate, force


@numba.njit(cache=True, error_model="numpy")
def disturb(exact, bias, sigma, draw, out):  # type: ignore[no-untyped-def]
    """Readings ``out`` (46,): ``exact`` ones (46,) with ``bias`` + ``sigma`` · ``draw`` (45,) each on top."""
    for i in range(36):
        out[i] = exact[i] + bias[i] + sigma[i] * draw[i]
    for i in range(39, 45):
        out[i + 1] = exact[i + 1] + bias[i] + sigma[i] * draw[i]
    x, y, z = bias[36] + sigma[36] * draw[36], bias[37] + sigma[37] * draw[37], bias[38] + sigma[38] * draw[38]
    angle = math.sqrt(x * x + y * y + z * z)
    scale = 0.5 if angle < 1e-9 else math.sin(angle / 2) / angle
    _turn(exact[36:40], math.cos(angle / 2), scale * x, scale * y, scale * z, out[36:40])


@numba.njit(cache=True, error_model="numpy")
def _to_quaternion(r, out):  # type: ignore[no-untyped-def]
    """Unit quaternion w x y z, w ≥ 0, from its largest component."""
    a, e, i = r[0, 0], r[1, 1], r[2, 2]
    squares = (1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i)
    p, q, s = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    b, c, d = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    largest = 0
    for k in range(1, 4):
        if squares[k] > squares[largest]:
            largest = k
    if largest == 0:
        out[0], out[1], out[2], out[3] = squares[0], p, q, s
    elif largest == 1:
        out[0], out[1], out[2], out[3] = p, squares[1], b, c
    elif largest == 2:
        out[0], out[1], out[2], out[3] = q, b, squares[2], d
    else:
        out[0], out[1], out[2], out[3] = s, c, d, squares[3]
    scale = 1.0 / (2.0 * math.sqrt(squares[largest]))
    if out[0] < 0.0:
        scale = -scale
    for k in range(4):
        out[k] *= scale


@numba.njit(cache=True, error_model="numpy")
def _turn(orientation, a, b, c, d, out):  # type: ignore[no-untyped-def]
    """``orientation`` w x y z times the quaternion a b c d, normed."""
    w, x, y, z = orientation[0], orientation[1], orientation[2], orientation[3]
    out[0] = w * a - x * b - y * c - z * d
    out[1] = w * b + x * a + y * d - z * c
    out[2] = w * c - x * d + y * a + z * b
    out[3] = w * d + x * c - y * b + z * a
    norm = math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2] + out[3] * out[3])
    for k in range(4):
        out[k] /= norm


@numba.njit(cache=True, error_model="numpy")
def motor_law(position, velocity, kp, kd, torque, law):  # type: ignore[no-untyped-def]
    """A command (five (4, 3)) as the motors run it: torque = constant - kp q - kd q̇, into ``law`` (3, 12).

    Returns whether it is finite.
    """
    total = 0.0
    for leg in range(4):
        for joint in range(3):
            i = 3 * leg + joint
            p, d = kp[leg, joint], kd[leg, joint]
            law[0, i] = torque[leg, joint] + p * position[leg, joint] + d * velocity[leg, joint]
            law[1, i], law[2, i] = p, d
            total += 0.0 * (law[0, i] + p + d)
    return total == 0.0


@numba.njit(cache=True, error_model="numpy")
def warm_motors(torque, temperature, square, ambient, rise, share):  # type: ignore[no-untyped-def]
    """Temperatures (4, 3) °C after a tick in which the motors exerted ``torque`` (n, 12) N·m in its n physics steps.

    ``square`` (4, 3) is the continuous torque squared, ``share`` of the way that a tick goes to the end value.
    """
    warmer = np.empty((4, 3))
    for leg in range(4):
        for joint in range(3):
            mean = 0.0
            for k in range(torque.shape[0]):
                mean += torque[k, 3 * leg + joint] ** 2
            end = ambient + rise * mean / (torque.shape[0] * square[leg, joint])
            warmer[leg, joint] = temperature[leg, joint] + (end - temperature[leg, joint]) * share
    return warmer
