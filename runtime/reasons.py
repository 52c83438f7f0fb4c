"""Why the robot does what it does: every reason by its number and its words, and what each fault leads to."""

from __future__ import annotations

from enum import IntEnum


class Reason(IntEnum):
    """Why the mode is what it is, or why a request was refused. ``words`` says it to people."""

    OK = 0
    STARTED = 1
    REQUESTED = 2
    ARMED = 3
    CLEARED = 4
    STOOD_UP = 5
    SAT_DOWN = 6
    COMMAND_LOST = 7
    OPERATOR_LOST = 8
    STOPPING = 9
    LATE_LOOP = 10
    SLOWING = 11
    STOPPED = 12

    NOT_ARMED = 20
    NOT_STANDING = 21
    NOT_DAMPED = 22
    STILL_MOVING = 23
    WALKING = 24
    FAULT_STANDS = 25
    NOT_READY = 26
    ALREADY = 27

    NOT_FINITE = 40
    STALE_MOTOR = 41
    STALE_IMU = 42
    IMPLAUSIBLE_IMU = 43
    TILTED = 44
    MOTOR_FAULT = 45
    HOT_MOTOR = 46
    JOINT_SPEED = 47
    LOW_VOLTAGE = 48
    OVERLOAD = 49
    BAD_COMMAND = 50
    SOLVER_FAILED = 51
    UNREACHABLE = 52
    BODY_SILENT = 53
    FROZEN_IMU = 54
    ATTITUDE_JUMP = 55
    TURN_ERROR = 56
    GRAVITY_ERROR = 57
    JUMPING_ENCODER = 58
    NOISY_ENCODER = 59
    TORQUE_LOST = 60
    REVERSED_MOTOR = 61
    STALLED = 62
    BAD_POLICY = 63
    ASTRAY = 64
    STUCK_ENCODER = 65
    LYING_CONTACTS = 66
    FALLING = 67

    @property
    def words(self) -> str:
        """The reason as a person would say it."""
        return WORDS[self]

    @property
    def is_fault(self) -> bool:
        """Whether it ends what the robot does and stays until cleared."""
        return self >= Reason.NOT_FINITE


WORDS: dict[Reason, str] = {
    Reason.OK: "in order",
    Reason.STARTED: "just started",
    Reason.REQUESTED: "asked for",
    Reason.ARMED: "armed",
    Reason.CLEARED: "fault cleared",
    Reason.STOOD_UP: "stood up",
    Reason.SAT_DOWN: "sat down",
    Reason.COMMAND_LOST: "no velocity command any more",
    Reason.OPERATOR_LOST: "the operator is gone",
    Reason.STOPPING: "the daemon is stopping",
    Reason.LATE_LOOP: "the loop came too late to walk on",
    Reason.SLOWING: "asked to stand: slowing down first",
    Reason.STOPPED: "stopped",
    Reason.NOT_ARMED: "not armed: ask for arm first",
    Reason.NOT_STANDING: "not standing: ask for stand first",
    Reason.NOT_DAMPED: "only in damp",
    Reason.STILL_MOVING: "still moving: wait until it stands or sits",
    Reason.WALKING: "walking: ask for stand first",
    Reason.FAULT_STANDS: "a fault stands: look at it, then ask for clear",
    Reason.NOT_READY: "not ready",
    Reason.ALREADY: "already so",
    Reason.NOT_FINITE: "a reading is not a number",
    Reason.STALE_MOTOR: "a motor's reply is too old",
    Reason.STALE_IMU: "the IMU's sample is too old",
    Reason.IMPLAUSIBLE_IMU: "the IMU tells what cannot be",
    Reason.TILTED: "tilted too far",
    Reason.MOTOR_FAULT: "a motor reports a fault",
    Reason.HOT_MOTOR: "a motor is too hot",
    Reason.JOINT_SPEED: "a joint is too fast",
    Reason.LOW_VOLTAGE: "the supply is too low",
    Reason.OVERLOAD: "rms torque beyond the continuous rating",
    Reason.BAD_COMMAND: "the computed command is not finite",
    Reason.SOLVER_FAILED: "no ground reaction forces found",
    Reason.UNREACHABLE: "a foot target of the posture is out of reach",
    Reason.BODY_SILENT: "the body does not answer",
    Reason.FROZEN_IMU: "the IMU repeats itself while the legs move",
    Reason.ATTITUDE_JUMP: "the IMU's attitude jumped",
    Reason.TURN_ERROR: "the IMU's rate of turn does not fit its attitude",
    Reason.GRAVITY_ERROR: "the IMU does not feel gravity",
    Reason.JUMPING_ENCODER: "a joint's position jumped",
    Reason.NOISY_ENCODER: "a joint's position does not fit its speed",
    Reason.TORQUE_LOST: "a motor does not give its torque",
    Reason.REVERSED_MOTOR: "a motor turns against its command",
    Reason.STALLED: "the loop stood still",
    Reason.BAD_POLICY: "the policy asks for what cannot be",
    Reason.ASTRAY: "a joint does not follow its target",
    Reason.STUCK_ENCODER: "an encoder does not move any more",
    Reason.LYING_CONTACTS: "more than one foot feels what cannot be",
    Reason.FALLING: "falls, and no step would catch it",
}


class Reaction(IntEnum):
    """What a verdict of the guard leads to; the greater takes precedence."""

    NONE = 0
    STAND = 1
    """A walk ends in standing; no fault."""
    STOP_AND_SIT = 2
    """A walk ends in standing first; then down on the legs, then damp."""
    SIT_DOWN = 3
    """Down on the legs where it stands, then damp; in a walk the legs fold at once, joint by joint: without attitude
    or policy nothing keeps a walking robot up until it stands."""
    DAMP = 4


HALTS = frozenset({Reason.OPERATOR_LOST, Reason.LATE_LOOP, Reason.SLOWING})
"""Why a walking robot stops without a fault."""
WHOLE = frozenset({Reason.HOT_MOTOR, Reason.OVERLOAD, Reason.LOW_VOLTAGE, Reason.LYING_CONTACTS})
"""Faults that leave every leg answering and the controller whole."""
SEATED = frozenset(
    {
        Reason.STALE_IMU,
        Reason.IMPLAUSIBLE_IMU,
        Reason.FROZEN_IMU,
        Reason.ATTITUDE_JUMP,
        Reason.TURN_ERROR,
        Reason.GRAVITY_ERROR,
        Reason.BAD_COMMAND,
        Reason.BAD_POLICY,
        Reason.SOLVER_FAILED,
        Reason.FALLING,
    }
)
"""Faults that leave every leg answering."""


def reaction(reason: Reason, sit_down: bool) -> Reaction:
    """What ``reason`` leads to; ``sit_down``: gently where the legs still answer."""
    if reason is Reason.OK:
        return Reaction.NONE
    if reason is Reason.LATE_LOOP:
        return Reaction.STAND
    if sit_down and reason in WHOLE:
        return Reaction.STOP_AND_SIT
    return Reaction.SIT_DOWN if sit_down and reason in SEATED else Reaction.DAMP
