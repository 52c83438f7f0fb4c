"""One tick's reward from the simulator's truth, compiled whole: in Python it would cost half a physics step."""

from __future__ import annotations

import math

import numpy as np

from runtime.control.compilation import compiled
from runtime.control.kinematics import foot_of_leg, jacobian_of_leg
from training.reward import FEATURES, fill_features, table_terms, task_terms


@compiled
def score_table(table, reference, start_yaw, body, grf, weight, sums):  # type: ignore[no-untyped-def]
    """Add a tick's Table I terms to ``sums`` (5,). ``grf`` (4, 3) N are the forces that the controller asked for.

    ``body`` (18,) is ``World.body``. The reference starts with yaw zero, the robot with ``start_yaw``: the world is
    turned until they agree.
    """
    features, terms, turned = np.empty(FEATURES), np.empty(5), body.copy()
    c, s = math.cos(start_yaw), math.sin(start_yaw)
    for x, y in ((0, 1), (3, 6), (4, 7), (5, 8), (12, 13), (15, 16)):
        turned[x], turned[y] = c * body[x] + s * body[y], -s * body[x] + c * body[y]
    fill_features(turned[:3], turned[12:15], turned[3:12].reshape(3, 3), turned[15:], grf, weight, features)
    table_terms(table, reference, features, terms)
    for i in range(5):
        sums[i] += terms[i]


@compiled
def score_task(  # type: ignore[no-untyped-def]
    table, dt, smoothed, command, height_error, body, joints, contacts, geometry, sums
):
    """Add a tick's task terms to ``sums`` (9,). ``body`` (18,) and ``joints`` (3, 4, 3) are ``World``'s."""
    rotation, velocity, rate = body[3:12].reshape(3, 3), body[12:15], body[15:]
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    c, s = math.cos(yaw), math.sin(yaw)
    rpy = np.array([math.atan2(rotation[2, 1], rotation[2, 2]), -math.asin(min(1.0, max(-1.0, rotation[2, 0]))), yaw])
    heading = np.array([c * velocity[0] + s * velocity[1], -s * velocity[0] + c * velocity[1], rate[2]])
    turning = np.array([c * rate[0] + s * rate[1], -s * rate[0] + c * rate[1], rate[2]])
    slip = slip_speed(geometry, velocity, rotation, rate, joints[0], joints[1], contacts)
    terms = np.empty(9)
    task_terms(table, dt, smoothed, command, heading, rpy, height_error, turning, joints[2], slip, terms)
    for i in range(9):
        sums[i] += terms[i]


@compiled
def slip_speed(geometry, velocity, rotation, rate, q, speed, contacts):  # type: ignore[no-untyped-def]
    """Summed horizontal speed of the feet that touch the ground, m/s."""
    foot, jacobian = np.empty(3), np.empty((3, 3))
    total = 0.0
    for leg in range(4):
        if not contacts[leg]:
            continue
        foot_of_leg(geometry[0], leg, q[leg], foot)
        jacobian_of_leg(geometry[0], leg, q[leg], jacobian)
        x = velocity[0]
        y = velocity[1]
        arm = np.zeros(3)
        for i in range(3):
            for j in range(3):
                arm[i] += rotation[i, j] * foot[j]
        x += rate[1] * arm[2] - rate[2] * arm[1]
        y += rate[2] * arm[0] - rate[0] * arm[2]
        for j in range(3):
            swept = jacobian[j, 0] * speed[leg, 0] + jacobian[j, 1] * speed[leg, 1] + jacobian[j, 2] * speed[leg, 2]
            x += rotation[0, j] * swept
            y += rotation[1, j] * swept
        total += math.hypot(x, y)
    return total
