"""What the guard knows: its bounds, what it remembers from tick to tick, and the worst thing it has found in this one.

Three plain records, so that compiled code reads them, a keyframe keeps them and a replay has the same bits.
"""

from __future__ import annotations

import numpy as np

from runtime.control.compilation import compiled

REASONS = 128
"""Room for the numbers of ``runtime.reasons.Reason``."""

BOUNDS_DTYPE = np.dtype(
    [
        ("reaction", "u1", (REASONS,)),  # runtime.reasons.Reaction to each Reason
        ("period", "f8"),
        ("cos_tilt", "f8"),
        ("age", "f8"),
        ("temperature", "f8"),
        ("voltage", "f8"),
        ("angular_velocity", "f8"),
        ("acceleration", "f8"),
        ("stall_stand", "f8"),
        ("stall_damp", "f8"),
        ("imu_ticks", "f8"),
        ("frozen_time", "f8"),
        ("attitude_jump", "f8"),
        ("turn_error", "f8"),  # rad/s times the time constant: rad
        ("turn_keep", "f8"),  # what a tick leaves of a filter
        ("gravity_error", "f8"),
        ("gravity_share", "f8"),  # what a tick adds to a filter
        ("position_jump", "f8"),
        ("position_noise", "f8"),
        ("noise_share", "f8"),
        ("torque_share", "f8"),
        ("torque_follow", "f8"),
        ("rest_follow", "f8"),
        ("tracking_error", "f8"),
        ("tracking_time", "f8"),
        ("overspeed", "f8"),  # times the largest speed
        ("overspeed_time", "f8"),
        ("thermal_share", "f8"),  # of one tick in the filter of the squared torque
        ("thermal_start", "f8"),
        ("thermal_floor", "f8"),
        ("current_start", "f8"),
        ("speed_floor", "f8"),
        ("voltage_start", "f8"),
        ("soft_start", "f8"),  # ramp gained in a tick
        ("soak_keep", "f8"),
        ("stuck_time", "f8"),
        ("stuck_torque", "f8"),  # share of the peak torque
        ("clamped_torque", "f8"),
        ("stuck_motion", "f8"),
        ("stuck_tilt", "f8"),  # change of gravity's direction in the body
        ("stuck_told", "f8"),
        ("roughness", "f8"),
        ("overreach", "f8", (2,)),  # standing, walking
        ("stop_lower", "f8", (4, 3)),  # between these no end stop holds a joint
        ("stop_upper", "f8", (4, 3)),
        ("action", "f8", (18,)),
        ("joint_velocity", "f8", (3,)),
        ("peak_torque", "f8", (3,)),
        ("continuous_torque", "f8", (3,)),
    ],
    align=True,
)

MEMORY_DTYPE = np.dtype(
    [
        # verdict of this tick
        ("severity", "u1"),
        ("reason", "u2"),
        ("where", "i2"),  # 3·leg + joint, or -1
        ("value", "f8"),  # what was measured
        ("bound", "f8"),  # what it was held against
        ("marks", "u4"),  # Clamp bits that the guard sets
        # torque and speed that are left
        ("mean_square", "f8", (4, 3)),  # squared torque through the thermal low-pass, N²·m²
        ("torque_bound", "f8", (4, 3)),  # N·m
        ("torque_cause", "u4", (4, 3)),  # Clamp bit that a cut at that bound sets
        ("ramp", "f8"),  # of the soft start, 0 to 1
        ("speed_share", "f8"),
        # inertial unit
        ("started", "u1"),
        ("imu_stamp", "f8"),  # of the newest sample
        ("good_stamp", "f8"),  # of the last one that was believed
        ("imu_raw", "f8", (10,)),  # that sample: orientation, angular velocity, linear acceleration
        ("imu", "f8", (10,)),  # what this tick believes
        ("imu_good", "f8", (10,)),  # the last sample that was believed
        ("imu_missing", "f8"),  # ticks without one
        ("imu_same", "f8"),  # s with the same bits while joints moved
        ("turned", "f8", (3,)),  # leaking sum of attitude change less rate of turn, rad
        ("felt", "f8", (3,)),  # low-passed specific force, world frame, m/s²
        # joints
        ("measured_stamp", "f8"),
        ("position", "f8", (4, 3)),
        ("velocity", "f8", (4, 3)),
        ("age", "f8", (4, 3)),
        ("noise", "f8", (4, 3)),  # low-passed unexplained way, rad
        ("rough", "f8", (4, 3)),  # low-passed way that differs from the mean of two speeds, rad
        ("torque_share", "f8", (4, 3)),  # low-passed measured torque over the commanded one
        ("too_fast", "f8", (4, 3)),  # s for which a joint has been beyond its speed
        ("astray", "f8", (4, 3)),  # s for which a joint has been far from its target
        ("still", "f8", (4, 3)),  # s since the reading last changed, negative before the first
        ("lowest", "f8", (4, 3)),  # torque since then, N·m
        ("highest", "f8", (4, 3)),
        ("still_leg", "f8", (4, 3, 3)),  # for each joint, its leg's joints then, rad
        ("still_tilt", "f8", (4, 3)),  # gravity's direction then, along the axis across which it would move the joint
        ("told", "f8", (4, 3)),  # way that its target has gone since then, rad
        ("commands", "f8", (2, 5, 4, 3)),  # of the last tick and the one before
        ("upright", "f8"),  # s for which it has stood or walked
        # punctuality
        ("overruns", "u4"),
        ("missed", "f8"),  # share of missed ticks lately
        ("late", "f8"),  # latest tick lately, s
        ("ran", "f8"),  # s since the start
    ],
    align=True,
)


@compiled
def find(m, b, reason, where, value, bound):  # type: ignore[no-untyped-def]
    """Note ``reason`` with its evidence, unless something at least as bad was found in this tick."""
    if b.reaction[reason] > m.severity:
        m.severity, m.reason, m.where = b.reaction[reason], reason, where
        m.value, m.bound = value, bound
