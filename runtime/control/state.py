"""The core's memory: what it remembers between ticks and what it was told at the start, each one numpy record.

Plain records instead of objects make a step one call into compiled code, a reset one assignment and a bit-exact replay
a matter of copying bytes. Every field names the room that owns it.
"""

from __future__ import annotations

import numpy as np

from drivers.description import SIDE, RobotDescription, composite_inertia
from runtime.control.gait import GAITS, gait_table
from runtime.control.kinematics import inverse, leg_geometry
from runtime.control.parameters import ControlConfig
from runtime.control.records import Fields, Records

WORK_DTYPE = np.dtype(
    [
        ("imu", "f8", (10,)),  # quaternion, angular velocity, linear acceleration
        ("joints", "f8", (3, 4, 3)),  # position, velocity, torque
        # left by the estimator
        ("to_world", "f8", (3, 3)),  # body to world
        ("rotation", "f8", (3, 3)),  # body to heading frame
        ("jacobian", "f8", (4, 3, 3)),
        ("foot", "f8", (3,)),
        ("gravity", "f8", (3,)),
        ("force", "f8", (3,)),
        ("angles", "f8", (3,)),
        ("foot_in_world", "f8", (4, 3)),
        ("odometry", "f8", (4, 3)),  # velocity of the body that each foot tells, world, m/s
        ("rolling", "f8", (4, 3)),  # velocity of each rolling foot's centre, world, m/s
        ("gain", "f8", (5,)),
        ("across", "f8", (5,)),
        # the force problem
        ("com", "f8", (3,)),  # heading frame
        ("hessian", "f8", (144,)),
        ("gradient", "f8", (12,)),
    ],
    align=True,
)
"""What one tick works with; nothing here is remembered."""
HIDDEN = 32
"""Largest hidden layer of the small fully-connected policy."""

STATE_DTYPE = np.dtype(
    [
        # contact
        ("contacts", "u1", (4,)),
        ("pressure", "f8", (4,)),  # low-passed vertical force, N
        ("lifted", "u1", (4,)),  # the foot moves over the ground
        ("felt", "u1", (4,)),  # contact by force alone
        ("ground", "f8", (4,)),  # height of the foot above the lowest one when it last was down, m
        ("swung", "u1", (4,)),  # swinging, a tick ago
        ("tested", "f8", (4,)),  # s of this swing or stance in which a lie would show
        ("honest", "f8", (4,)),  # s of them in which there was none
        ("lies", "i8", (4, 2)),  # stances, swings, one after the other, in which the foot lied
        ("doubt", "f8", (4,)),  # s for which what the foot feels will not be believed
        # estimator
        ("started", "u1"),
        ("velocity", "f8", (3,)),  # of the body origin in the world, m/s
        ("support", "f8", (4, 3)),  # feet from the body origin, world axes, m
        ("covariance", "f8", (5, 5)),  # of velocity and four feet, the same for x, y and z
        ("rested", "f8", (4,)),  # how long each foot has been in contact, s
        ("height", "f8"),
        ("position", "f8", (3,)),
        ("footholds", "f8", (4, 3)),  # where each foot last rested, dead-reckoned world, m
        ("met_ground", "u1", (4,)),  # feet that have rested since the start
        ("slope", "f8", (2,)),
        # command
        ("followed", "f8", (3,)),  # velocity command after its acceleration bound
        ("integral", "f8", (2,)),  # m/s added to the command
        ("walked", "f8"),  # s since the controller was reset or stood
        ("heading", "f8"),  # rad, where the commanded turn has led
        # observation, policy
        ("previous", "f8", (14,)),
        ("seen", "f8", (28,)),  # the observation before its scales
        ("remembered", "u1"),
        ("shifts", "f8", (4, 3)),
        # gait
        ("clock", "f8"),  # share of the cycle
        ("phase", "f8", (4,)),  # swing progress in [0, pi]
        ("swinging", "u1", (4,)),
        ("searching", "u1", (4,)),
        ("stance", "u1", (4,)),
        # trajectory
        ("foot_targets", "f8", (4, 3)),
        ("posed_yaw", "f8"),  # of the body pose that the foot targets were turned by, rad
        ("depth", "f8", (4,)),  # how far a searching leg has gone down, m
        # torque
        ("joint_targets", "f8", (4, 3)),
        ("gain_scale", "f8", (4,)),
        ("commanded", "u1"),
    ],
    align=True,
)

TUNING_FIELDS: Fields = [
    ("policy_share", "f8"),  # of the active policy; the rest is the outgoing one's
    ("gait_offset", "f8", (4,)),
    ("swing_fraction", "f8"),
    ("cycle_time", "f8"),
    ("swing_time", "f8"),
    ("stance_time", "f8"),
    ("swing_height", "f8"),
    ("walking_height", "f8"),
    ("kp", "f8", (3,)),
    ("kd", "f8", (3,)),
    ("stance_scale", "f8"),
    ("standing_scale", "f8"),
    ("body_pose", "f8", (4,)),  # roll, pitch, yaw, rad, and height, m, beside what is walked with
]
"""What an operator may change while the robot lives. All float64, so that they are one row of numbers too."""
TUNING_DTYPE = np.dtype(TUNING_FIELDS, align=True)
TUNING_SIZE = TUNING_DTYPE.itemsize // 8

PARAMETERS_DTYPE = np.dtype(
    [
        *TUNING_FIELDS,  # first, so that they are the first numbers of the record
        ("dt", "f8"),
        ("mass", "f8"),
        ("com", "f8", (3,)),  # of the whole robot in its stand pose, from the body origin, body frame, m
        ("nominal_footholds", "f8", (4, 2)),
        # gait
        ("early_contact", "u1"),
        ("search_speed", "f8"),
        ("search_depth", "f8"),
        # torque
        ("max_joint_speed", "f8"),
        # contact
        ("contact_threshold", "f8"),
        ("contact_release", "f8"),
        ("contact_blanking", "f8"),
        ("force_time_constant", "f8"),
        ("lift_speed", "f8"),
        ("contact_baseline", "f8", (4,)),
        ("lie_rise", "f8"),
        ("lie_time", "f8", (2,)),  # of stance, swing
        ("lie_strides", "i8"),
        ("doubt_time", "f8"),
        # estimator
        ("acceleration_noise", "f8"),
        ("foot_position_noise", "f8"),
        ("foot_velocity_noise", "f8"),
        ("slip_noise", "f8"),
        ("settling_time", "f8"),
        ("slope_time_constant", "f8"),
        ("height_time_constant", "f8"),
        # grf
        ("friction", "f8"),
        ("min_force", "f8"),
        ("max_force", "f8"),
        ("wrench_weight", "f8", (6,)),
        ("force_weight", "f8"),
        # bounds
        ("shift_bound", "f8"),
        ("wrench_bound", "f8", (6,)),
        ("velocity_bound", "f8", (3,)),
        ("acceleration_bound", "f8", (3,)),
    ],
    align=True,
)

POLICY_DTYPE = np.dtype(
    [
        ("relative", "u1"),  # observation relative to the command
        ("direct", "u1"),  # outputs ground reaction forces instead of a wrench
        ("hidden_size", "i8"),  # 0: linear
        ("observation_scale", "f8", (28,)),
        ("observation_offset", "f8", (28,)),
        ("action_scale", "f8", (24,)),
        ("action_bound", "f8", (24,)),
        ("shift_time_constant", "f8"),
        ("velocity_integral", "f8"),
        ("integral_bound", "f8"),
        ("integral_freeze", "f8"),
        ("integral_delay", "f8"),
        ("capture_point", "f8"),
        ("velocity_error_bound", "f8"),
        ("centripetal", "f8"),
        ("slope_feet", "f8"),
        ("slope_body", "f8"),
        ("swing_lift", "f8"),
        ("matrix", "f8", (28, 24)),  # transposed: the processor takes several actions at a time
        ("hidden", "f8", (HIDDEN, 28)),
        ("readout", "f8", (24, HIDDEN)),
    ],
    align=True,
)


def stand_angles(description: RobotDescription, walking_height: float) -> np.ndarray:
    """Joint angles (4, 3) with the feet below the ends of the abduction links, body level at ``walking_height``."""
    feet = description.hips.copy()
    feet[:, 1] += SIDE * description.abduction_length
    feet[:, 2] = description.foot_radius - walking_height
    angles, _ = inverse(leg_geometry(description), feet)
    return angles


def build_parameters(description: RobotDescription, config: ControlConfig) -> Records:
    """A robot's constants as the compiled core reads them. Shape (1,) of ``PARAMETERS_DTYPE``."""
    parameters = np.zeros(1, PARAMETERS_DTYPE)
    p = parameters[0]
    com, _ = composite_inertia(description, stand_angles(description, config.gait.walking_height))
    p["dt"], p["mass"], p["com"] = 1.0 / config.rate_hz, description.mass, com
    p["nominal_footholds"] = description.hips[:, :2]
    p["nominal_footholds"][:, 0] += com[0]
    p["nominal_footholds"][:, 1] += SIDE * description.abduction_length + com[1]
    set_gait(parameters, config)
    p["policy_share"] = 1.0
    gains, grf, bounds, contact = config.gains, config.grf, config.bounds, config.contact
    p["kp"], p["kd"] = gains.kp, gains.kd
    for name in ("stance_scale", "standing_scale", "max_joint_speed"):
        p[name] = getattr(gains, name)
    p["contact_threshold"], p["contact_release"] = contact.threshold, contact.release * contact.threshold
    p["contact_blanking"] = contact.blanking * np.pi
    p["force_time_constant"], p["lift_speed"] = contact.force_time_constant, contact.lift_speed
    p["contact_baseline"] = contact.baseline
    p["lie_rise"], p["lie_time"], p["lie_strides"] = contact.lie_rise, contact.lie_time, contact.lie_strides
    p["doubt_time"] = contact.doubt_time
    for name in config.estimator.__struct_fields__:
        p[name] = getattr(config.estimator, name)
    for name in ("friction", "min_force", "max_force", "wrench_weight", "force_weight"):
        p[name] = getattr(grf, name)
    p["shift_bound"] = bounds.shift
    p["wrench_bound"] = (*bounds.force, *bounds.moment)
    p["velocity_bound"] = (*bounds.linear_velocity, bounds.yaw_rate)
    p["acceleration_bound"] = (bounds.linear_acceleration, bounds.linear_acceleration, bounds.yaw_acceleration)
    return parameters


def set_gait(parameters: Records, config: ControlConfig) -> None:
    """Write the gait's table and timing into ``parameters``."""
    p, gait = parameters[0], config.gait
    assert gait.name in GAITS
    offsets, swing_time, stance_time = gait_table(gait)
    p["gait_offset"], p["swing_time"], p["stance_time"] = offsets, swing_time, stance_time
    p["cycle_time"] = swing_time + stance_time
    p["swing_fraction"] = 0.0 if gait.name == "stand" else swing_time / (swing_time + stance_time)
    for name in ("swing_height", "walking_height", "early_contact", "search_speed", "search_depth"):
        p[name] = getattr(gait, name)
