"""What only shows from tick to tick: sensors that freeze, jump or contradict themselves, motors that do not obey."""

from __future__ import annotations

import math

from runtime.control.compilation import compiled
from runtime.control.kinematics import GRAVITY
from runtime.control.records import Clamp
from runtime.reasons import Reason
from runtime.verdict import find

_OK, _STALE_IMU, _IMPLAUSIBLE, _FROZEN, _JUMP, _TURN, _GRAVITY = (
    int(reason)
    for reason in (
        Reason.OK,
        Reason.STALE_IMU,
        Reason.IMPLAUSIBLE_IMU,
        Reason.FROZEN_IMU,
        Reason.ATTITUDE_JUMP,
        Reason.TURN_ERROR,
        Reason.GRAVITY_ERROR,
    )
)
_JUMPING, _NOISY, _TORQUE_LOST, _REVERSED, _ASTRAY = (
    int(reason)
    for reason in (
        Reason.JUMPING_ENCODER,
        Reason.NOISY_ENCODER,
        Reason.TORQUE_LOST,
        Reason.REVERSED_MOTOR,
        Reason.ASTRAY,
    )
)
_EXTRAPOLATED = int(Clamp.EXTRAPOLATED)
NEW_SAMPLE = 1.5
"""Ticks up to which a sample counts as this tick's."""
LONGEST_GAP = 3.0
"""Ticks between two samples over which rate of turn and attitude can still be compared."""
TURNING_TIME = 0.05
"""s over which a rate of turn explains a change of attitude at most."""
PROMPT = 0.9
"""Ticks within which a motor must have answered for its torque to be held against its command."""
MOVING = 0.3
"""rad/s: a joint that is faster moves."""
PLAY = 0.05
"""rad by which a joint's position may differ from what its speed explains."""
TELLING_TORQUE = 6.0
"""N·m: smaller commands are lost in friction and say nothing about a motor."""


@compiled
def _read_imu(t, b, m, raw):  # type: ignore[no-untyped-def]
    """Copy the sample into ``raw`` (10,). Returns what is wrong with it by itself, the value and its bound."""
    rate = acceleration = total = 0.0
    for i in range(4):
        raw[i] = t.orientation[i]
        total += raw[i]
    for i in range(3):
        raw[4 + i], raw[7 + i] = t.angular_velocity[i], t.linear_acceleration[i]
        total += raw[4 + i] + raw[7 + i]
        rate, acceleration = max(rate, abs(raw[4 + i])), max(acceleration, abs(raw[7 + i]))
    norm = raw[0] * raw[0] + raw[1] * raw[1] + raw[2] * raw[2] + raw[3] * raw[3]
    age = t.measured_stamp - t.imu_stamp
    if not math.isfinite(total + norm + t.imu_stamp):
        return _IMPLAUSIBLE, math.nan, 0.0
    if age > b.age:
        return _STALE_IMU, age, b.age
    if abs(norm - 1.0) > 0.05:
        return _IMPLAUSIBLE, norm, 1.05
    if rate > b.angular_velocity:
        return _IMPLAUSIBLE, rate, b.angular_velocity
    if acceleration > b.acceleration:
        return _IMPLAUSIBLE, acceleration, b.acceleration
    return _OK, 0.0, 0.0


@compiled
def _compare_imu(t, b, m, raw, known, since):  # type: ignore[no-untyped-def]
    """A sample against the one before: jumps, and rates of turn that do not fit. As ``_read_imu``."""
    w, x, y, z = known[0], -known[1], -known[2], -known[3]
    qw = w * raw[0] - x * raw[1] - y * raw[2] - z * raw[3]
    sign = 1.0 if qw >= 0.0 else -1.0
    turn_x = 2.0 * sign * (w * raw[1] + x * raw[0] + y * raw[3] - z * raw[2])
    turn_y = 2.0 * sign * (w * raw[2] - x * raw[3] + y * raw[0] + z * raw[1])
    turn_z = 2.0 * sign * (w * raw[3] + x * raw[2] - y * raw[1] + z * raw[0])
    angle = 2.0 * math.atan2(0.5 * math.sqrt(turn_x**2 + turn_y**2 + turn_z**2), abs(qw))
    fastest = 0.0
    for i in range(4, 7):
        fastest = max(fastest, abs(raw[i]), abs(known[i]))
    explained = 2.0 * fastest * min(TURNING_TIME, max(since, b.period))
    if angle > b.attitude_jump + explained:
        return _JUMP, angle, b.attitude_jump + explained
    if 0.0 < since < LONGEST_GAP * b.period:
        m.turned[0] = m.turned[0] * b.turn_keep + turn_x - 0.5 * (raw[4] + known[4]) * since
        m.turned[1] = m.turned[1] * b.turn_keep + turn_y - 0.5 * (raw[5] + known[5]) * since
        m.turned[2] = m.turned[2] * b.turn_keep + turn_z - 0.5 * (raw[6] + known[6]) * since
    error = math.sqrt(m.turned[0] ** 2 + m.turned[1] ** 2 + m.turned[2] ** 2)
    if error > b.turn_error:
        return _TURN, error, b.turn_error
    return _OK, 0.0, 0.0


@compiled
def _feel_gravity(b, m, raw):  # type: ignore[no-untyped-def]
    """The mean specific force in the world against gravity's. As ``_read_imu``."""
    w, x, y, z = raw[0], raw[1], raw[2], raw[3]
    a, c, d = raw[7], raw[8], raw[9]
    felt_x = a * (1.0 - 2.0 * (y * y + z * z)) + c * 2.0 * (x * y - w * z) + d * 2.0 * (x * z + w * y)
    felt_y = a * 2.0 * (x * y + w * z) + c * (1.0 - 2.0 * (x * x + z * z)) + d * 2.0 * (y * z - w * x)
    felt_z = a * 2.0 * (x * z - w * y) + c * 2.0 * (y * z + w * x) + d * (1.0 - 2.0 * (x * x + y * y))
    m.felt[0] += (felt_x - m.felt[0]) * b.gravity_share
    m.felt[1] += (felt_y - m.felt[1]) * b.gravity_share
    m.felt[2] += (felt_z - m.felt[2]) * b.gravity_share
    error = math.sqrt(m.felt[0] ** 2 + m.felt[1] ** 2 + (m.felt[2] - GRAVITY) ** 2)
    if error > b.gravity_error:
        return _GRAVITY, error, b.gravity_error
    return _OK, 0.0, 0.0


@compiled
def _moving(t):  # type: ignore[no-untyped-def]
    fastest = 0.0
    for leg in range(4):
        for joint in range(3):
            fastest = max(fastest, abs(t.joint_velocity[leg, joint]))
    return fastest > MOVING


@compiled
def _count_same(t, b, m, raw):  # type: ignore[no-untyped-def]
    """How long new samples have brought the same bits while joints move. As ``_read_imu``."""
    same = True
    for i in range(10):
        same = same and raw[i] == m.imu_raw[i]
    if not same:
        m.imu_same = 0.0
    elif t.imu_stamp > m.imu_stamp and _moving(t):
        m.imu_same += b.period
    if m.imu_same >= b.frozen_time:
        return _FROZEN, m.imu_same, b.frozen_time
    return _OK, 0.0, 0.0


@compiled
def _carry(m, seconds):  # type: ignore[no-untyped-def]
    """Believe the last good sample, turned on by its own rate for ``seconds``."""
    w, x, y, z = m.imu_good[0], m.imu_good[1], m.imu_good[2], m.imu_good[3]
    a, c, d = m.imu_good[4] * seconds, m.imu_good[5] * seconds, m.imu_good[6] * seconds
    angle = math.sqrt(a * a + c * c + d * d)
    scale = 0.5 if angle < 1e-9 else math.sin(0.5 * angle) / angle
    pw, px, py, pz = math.cos(0.5 * angle), a * scale, c * scale, d * scale
    m.imu[0] = w * pw - x * px - y * py - z * pz
    m.imu[1] = w * px + x * pw + y * pz - z * py
    m.imu[2] = w * py - x * pz + y * pw + z * px
    m.imu[3] = w * pz + x * py - y * px + z * pw
    m.imu[4:] = m.imu_good[4:]


@compiled
def look_at_imu(t, b, m, raw):  # type: ignore[no-untyped-def]
    """Believe this tick's sample, or carry the last one on, or find that there has been none for too long.

    While the robot is up a sample is held against the last one that was believed, so that one which jumped stays
    unbelieved; in DAMP against the one before, so that a robot that was turned over by hand can be armed again.
    """
    reason, value, bound = _read_imu(t, b, m, raw)
    if m.started and reason == _OK:
        up = t.mode != 0
        reason, value, bound = _count_same(t, b, m, raw)
        if reason == _OK:
            since = t.imu_stamp - (m.good_stamp if up else m.imu_stamp)
            reason, value, bound = _compare_imu(t, b, m, raw, m.imu_good if up else m.imu_raw, since)
        if reason == _OK:
            reason, value, bound = _feel_gravity(b, m, raw)
    if math.isfinite(t.imu_stamp):
        m.imu_stamp = t.imu_stamp
        m.imu_raw[:] = raw
    if reason == _OK:
        m.imu[:] = raw
        m.imu_good[:] = raw
        m.good_stamp, m.imu_missing, m.started = t.imu_stamp, 0.0, 1
        age = t.measured_stamp - t.imu_stamp
        if age > NEW_SAMPLE * b.period and b.imu_ticks > 0.0:
            _carry(m, min(age, b.imu_ticks * b.period))
            m.marks |= _EXTRAPOLATED
        return
    m.imu_missing += 1.0
    if m.started and m.imu_missing <= b.imu_ticks and reason != _STALE_IMU:
        _carry(m, m.imu_missing * b.period)
        m.marks |= _EXTRAPOLATED
        return
    _carry(m, 0.0)
    find(m, b, reason, -1, value, bound)


@compiled
def look_at_joint(t, b, m, leg, joint):  # type: ignore[no-untyped-def]
    """One finite reading against the one before: a position that jumps or is noisy."""
    since = max(b.period, t.measured_stamp - m.measured_stamp) + m.age[leg, joint]
    fastest = max(abs(t.joint_velocity[leg, joint]), abs(m.velocity[leg, joint]))
    way = abs(t.joint_position[leg, joint] - m.position[leg, joint])
    excess = max(0.0, way - 2.0 * fastest * since - PLAY)
    m.noise[leg, joint] += (excess - m.noise[leg, joint]) * b.noise_share
    if excess > b.position_jump:
        find(m, b, _JUMPING, 3 * leg + joint, way, way - excess + b.position_jump)
    if m.noise[leg, joint] > b.position_noise:
        find(m, b, _NOISY, 3 * leg + joint, m.noise[leg, joint], b.position_noise)
    if t.joint_age[leg, joint] < PROMPT * b.period and m.age[leg, joint] < PROMPT * b.period:
        explained = 0.5 * (t.joint_velocity[leg, joint] + m.velocity[leg, joint]) * since
        differs = abs(t.joint_position[leg, joint] - m.position[leg, joint] - explained)
        m.rough[leg, joint] += (differs - m.rough[leg, joint]) * b.noise_share


@compiled
def look_at_motor(t, b, m, leg, joint):  # type: ignore[no-untyped-def]
    """One motor against the command that it ran when it was read, which left two ticks ago."""
    position, velocity, kp, kd, torque = 0, 1, 2, 3, 4
    command = m.commands[1]
    error = command[position, leg, joint] - t.joint_position[leg, joint]
    gain, peak = command[kp, leg, joint], b.peak_torque[joint]
    wanted = (
        command[torque, leg, joint]
        + gain * error
        + command[kd, leg, joint] * (command[velocity, leg, joint] - t.joint_velocity[leg, joint])
    )
    wanted = min(peak, max(-peak, wanted))
    share = 1.0
    if abs(wanted) > TELLING_TORQUE and t.joint_age[leg, joint] < PROMPT * b.period:
        share = min(2.0, max(-1.0, t.joint_torque[leg, joint] / wanted))
        m.torque_share[leg, joint] += (share - m.torque_share[leg, joint]) * b.torque_follow
    else:
        m.torque_share[leg, joint] += (1.0 - m.torque_share[leg, joint]) * b.rest_follow
    if m.torque_share[leg, joint] < b.torque_share and m.rough[leg, joint] > b.roughness:
        find(m, b, _NOISY, 3 * leg + joint, m.rough[leg, joint], b.roughness)
    elif m.torque_share[leg, joint] < b.torque_share:
        against = share < -b.torque_share
        find(m, b, _REVERSED if against else _TORQUE_LOST, 3 * leg + joint, m.torque_share[leg, joint], b.torque_share)
    astray = gain > 0.0 and abs(error) > b.tracking_error
    m.astray[leg, joint] = m.astray[leg, joint] + b.period if astray else 0.0
    if m.astray[leg, joint] > b.tracking_time:
        find(m, b, _ASTRAY, 3 * leg + joint, abs(error), b.tracking_error)


@compiled
def keep_time(t, b, m):  # type: ignore[no-untyped-def]
    """How punctual the loop has been lately."""
    missed = float(t.overruns) - float(m.overruns)
    m.overruns = t.overruns
    m.missed = m.missed * b.soak_keep + (1.0 - b.soak_keep) * missed / (1.0 + missed)
    m.late = max(t.lateness, m.late * b.soak_keep)
    m.ran += b.period
