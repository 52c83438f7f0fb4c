"""The guard's plain bounds: what one measurement and one command may be, each by itself.

The kernels work on the tick's own record: what they judge is what the flight log keeps. ``plausibility`` judges what
only shows from tick to tick.
"""

from __future__ import annotations

import math

from runtime.control.compilation import compiled
from runtime.control.kinematics import GRAVITY
from runtime.control.records import Clamp
from runtime.messages.mode import Mode
from runtime.reasons import Reason
from runtime.verdict import find

_OK, _NOT_FINITE, _STALE_MOTOR, _TILTED, _MOTOR_FAULT, _HOT = (
    int(reason)
    for reason in (
        Reason.OK,
        Reason.NOT_FINITE,
        Reason.STALE_MOTOR,
        Reason.TILTED,
        Reason.MOTOR_FAULT,
        Reason.HOT_MOTOR,
    )
)
_JOINT_SPEED, _LOW_VOLTAGE, _OVERLOAD, _BAD_COMMAND, _BAD_POLICY = (
    int(reason)
    for reason in (
        Reason.JOINT_SPEED,
        Reason.LOW_VOLTAGE,
        Reason.OVERLOAD,
        Reason.BAD_COMMAND,
        Reason.BAD_POLICY,
    )
)
_STAND, _WALK = int(Mode.STAND), int(Mode.WALK)
_FALLING = int(Reason.FALLING)
AHEAD = 0.1
"""s for which the lean is foreseen, from the rate of turn."""
LEVER = 0.5
"""m that the capture point is taken to be further out for each radian of lean."""
SETTLED = 0.5
"""s after standing up for which the estimate's speed is not yet one to fall by."""
LOWEST = 0.2
"""m: no estimate of the height below it makes a pendulum."""
_LATE_LOOP, _STALLED = int(Reason.LATE_LOOP), int(Reason.STALLED)
_TORQUE, _COASTED = int(Clamp.TORQUE), int(Clamp.COASTED)


@compiled
def judge_joint(t, b, m, leg, joint):  # type: ignore[no-untyped-def]
    """One joint's reading against its bounds. Returns whether it is finite."""
    where = 3 * leg + joint
    position, velocity = t.joint_position[leg, joint], t.joint_velocity[leg, joint]
    torque, temperature = t.joint_torque[leg, joint], t.joint_temperature[leg, joint]
    age = t.joint_age[leg, joint]
    if not math.isfinite(position + velocity + torque + temperature + age):
        find(m, b, _NOT_FINITE, where, math.nan, 0.0)
        return False
    if t.joint_fault[leg, joint] != 0:
        find(m, b, _MOTOR_FAULT, where, float(t.joint_fault[leg, joint]), 0.0)
    if age > b.age:
        find(m, b, _STALE_MOTOR, where, age, b.age)
    if age > b.period:
        m.marks |= _COASTED
    _judge_speed(t, b, m, leg, joint, velocity)
    if temperature > b.temperature:
        find(m, b, _HOT, where, temperature, b.temperature)
    return True


@compiled
def _judge_speed(t, b, m, leg, joint, velocity):  # type: ignore[no-untyped-def]
    """A joint beyond its speed: at once, but in a walk only for longer than a foot takes that slips off an edge."""
    bound = b.joint_velocity[joint]
    if abs(velocity) <= bound:
        m.too_fast[leg, joint] = 0.0
        return
    m.too_fast[leg, joint] += b.period
    if t.mode != _WALK or m.too_fast[leg, joint] > b.overspeed_time or abs(velocity) > b.overspeed * bound:
        find(m, b, _JOINT_SPEED, 3 * leg + joint, velocity, bound)


@compiled
def judge_body(t, b, m):  # type: ignore[no-untyped-def]
    """Attitude as it is believed, supply and the loop's own time."""
    w, x, y, z = m.imu[0], m.imu[1], m.imu[2], m.imu[3]
    upright = 1.0 - 2.0 * (x * x + y * y) / (w * w + x * x + y * y + z * z)
    if upright < b.cos_tilt:
        find(m, b, _TILTED, -1, math.acos(max(-1.0, upright)), math.acos(b.cos_tilt))
    m.upright = m.upright + b.period if t.mode == _STAND or t.mode == _WALK else 0.0
    if not math.isfinite(t.voltage):
        find(m, b, _NOT_FINITE, -1, t.voltage, 0.0)
    elif t.voltage < b.voltage:
        find(m, b, _LOW_VOLTAGE, -1, t.voltage, b.voltage)
    if t.period > b.stall_damp:
        find(m, b, _STALLED, -1, t.period, b.stall_damp)
    elif t.period > b.stall_stand and t.mode == _WALK:
        find(m, b, _LATE_LOOP, -1, t.period, b.stall_stand)


@compiled
def judge_load(t, b, m, leg, joint):  # type: ignore[no-untyped-def]
    """Rms torque of one motor against its continuous rating."""
    square = t.joint_torque[leg, joint] ** 2
    m.mean_square[leg, joint] += (square - m.mean_square[leg, joint]) * b.thermal_share
    if m.mean_square[leg, joint] > b.continuous_torque[joint] ** 2:
        find(m, b, _OVERLOAD, 3 * leg + joint, math.sqrt(m.mean_square[leg, joint]), b.continuous_torque[joint])


@compiled
def judge_policy(ticks, bounds, memories):  # type: ignore[no-untyped-def]
    """What the policy asked for in ``ticks`` (1,), before its bounds: OK, or BAD_POLICY with its evidence."""
    t, b, m = ticks[0], bounds[0], memories[0]
    for i in range(18):
        asked = t.asked[i]
        if not abs(asked) <= b.action[i]:
            m.severity = 0
            find(m, b, _BAD_POLICY, -1, asked, b.action[i])
            return _BAD_POLICY
    return _OK


@compiled
def judge_fall(ticks, bounds, memories):  # type: ignore[no-untyped-def]
    """Whether the robot of ``ticks`` (1,) can still be caught, from this tick's estimate: OK, or FALLING.

    The capture point is where a foot would have to be put to bring an inverted pendulum of the body's height and speed
    to rest above it. It may leave the feet by what a step makes good, and no lean makes it worse.
    """
    t, b, m = ticks[0], bounds[0], memories[0]
    speed = math.hypot(t.twist[0], t.twist[1])
    if m.upright < SETTLED:
        return _OK
    x, y = t.twist[0] / speed, t.twist[1] / speed
    reach = -math.inf
    for leg in range(4):
        reach = max(reach, t.feet[leg, 0] * x + t.feet[leg, 1] * y)
    sine, cosine = math.sin(t.rpy[1]), math.cos(t.rpy[1])
    up_x, up_y, up_z = sine * math.cos(t.rpy[0]), -math.sin(t.rpy[0]), cosine * math.cos(t.rpy[0])
    lean = up_x * x + up_y * y
    tipping = (t.twist[4] * up_z - t.twist[5] * up_y) * x + (t.twist[5] * up_x - t.twist[3] * up_z) * y
    overreach = speed * math.sqrt(max(LOWEST, t.height) / GRAVITY) - reach + LEVER * (lean + AHEAD * tipping)
    bound = b.overreach[1 if t.mode == _WALK else 0]
    if not overreach > bound:  # a robot that does not move falls no way at all: not a number
        return _OK
    m.severity = 0
    find(m, b, _FALLING, -1, overreach, bound)
    return _FALLING


@compiled
def bound_command(ticks, bounds, memories):  # type: ignore[no-untyped-def]
    """Cut the feed-forward of ``ticks`` (1,) so that the law's foreseen torque stays within what the motors are given.

    Returns OK, or BAD_COMMAND where a number is not finite or a gain negative.
    """
    t, b, m = ticks[0], bounds[0], memories[0]
    for leg in range(4):
        for joint in range(3):
            kp, kd = t.command_kp[leg, joint], t.command_kd[leg, joint]
            torque = t.command_torque[leg, joint]
            foreseen = (
                torque
                + kp * (t.command_position[leg, joint] - t.joint_position[leg, joint])
                + kd * (t.command_velocity[leg, joint] - t.joint_velocity[leg, joint])
            )
            if not math.isfinite(foreseen) or kp < 0.0 or kd < 0.0:
                m.severity = 0
                find(m, b, _BAD_COMMAND, 3 * leg + joint, foreseen, b.peak_torque[joint])
                return _BAD_COMMAND
            bound = m.torque_bound[leg, joint]
            if abs(foreseen) > bound:
                t.command_torque[leg, joint] = torque + (bound if foreseen > 0.0 else -bound) - foreseen
                m.marks |= m.torque_cause[leg, joint]
                if abs(foreseen) > b.peak_torque[joint]:
                    m.marks |= _TORQUE
    return _OK
