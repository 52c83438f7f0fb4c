"""The fault matrix: every row with the range of its numbers and what must come of it.

``must``: ``damp``, the robot is in DAMP at the end; ``stay``, it never falls and never leaves its mode; ``any``, the
general bounds of ``faults.watch`` alone hold.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from drivers.moteus_registers import FAULTS
from drivers.motor_faults import NOT_STARTING, RESTARTED
from faults import wire
from faults.computer import (
    ClockStep,
    EmergencyStop,
    Infeasible,
    LostOperator,
    PolicyWhileFalling,
    Push,
    RefusedPolicy,
    SlowSolver,
    SolverFault,
    SpoiltPolicy,
    SpoiltProblem,
    Stall,
    WildPolicy,
)
from faults.imu import FIELDS, BiasJump, ClippedImu, FlippedImu, FrozenImu, NanImu, ReplacedImu, SlowImu
from faults.motors import (
    ALL,
    BatterySag,
    BrownOut,
    DuplicateId,
    FrameLoss,
    HotMotor,
    JammedJoint,
    JumpingEncoder,
    LateReplies,
    LyingFoot,
    MotorFault,
    NoisyEncoder,
    ReversedSign,
    StuckEncoder,
    WeakMotors,
)
from faults.rig import Fault

Draw = np.random.Generator
CODES = (*FAULTS, RESTARTED, NOT_STARTING, 0, 11, 12, 15)
"""What a motor that does not run may report: its faults, the driver's words, and the modes that are not running."""


@dataclass(frozen=True)
class Row:
    """One row of the matrix."""

    name: str
    sim: Callable[[Draw], Fault] | None
    """Draws a fault for the simulated body."""
    wire: Callable[[Draw], Fault] | None = None
    """Draws one for the wire twin."""
    must: Literal["damp", "stay", "any"] = "any"
    within: int | None = None
    """Ticks from the injection to damp, where it must damp."""
    seconds: float = 1.2
    """How long it is watched."""

    def draw(self, body: str) -> Callable[[Draw], Fault]:
        draw = self.sim if body == "sim" else self.wire
        assert draw is not None, f"{self.name} has no fault for {body}"
        return draw


def joint(draw: Draw) -> int:
    return int(draw.integers(12))


def some(draw: Draw, count: int) -> tuple[int, ...]:
    return tuple(sorted(int(place) for place in draw.choice(12, count, replace=False)))


def seed(draw: Draw) -> int:
    return int(draw.integers(2**31))


def within(draw: Draw, low: float, high: float) -> float:
    return round(float(draw.uniform(low, high)), 4)


def vector(draw: Draw, size: float) -> tuple[float, float, float]:
    x, y, z = (round(float(value), 3) for value in draw.uniform(-size, size, 3))
    return x, y, z


def on_one_bus(draw: Draw) -> tuple[int, int]:
    leg = int(draw.integers(4))
    first, second = draw.choice(3, 2, replace=False)
    return 3 * leg + int(first), 3 * leg + int(second)


def silence(servo: Any) -> None:
    servo.silent = True


def knock(draw: Draw) -> Push:
    side = float(draw.choice([-1.0, 1.0]))
    return Push((within(draw, -150, 150), side * within(draw, 250, 600), 0.0), 0.2)


def wild(draw: Draw) -> WildPolicy:
    return WildPolicy(float(10.0 ** draw.uniform(0, 6)), seed(draw))


def failing(code: int) -> Callable[[Any], None]:
    return lambda servo: servo.fail(code)


def restarting(turns: int) -> Callable[[Any], None]:
    return lambda servo: servo.restart(shift=turns / 6)


def at_volts(volts: float) -> Callable[[Any], None]:
    def turn(servo: Any) -> None:
        servo.voltage = volts

    return turn


def draw_code(draw: Draw) -> int:
    return int(draw.choice([code for code in CODES if code]))


def draw_servo_code(draw: Draw) -> int:
    return int(draw.choice(list(FAULTS)))


SILENT_TICKS = 3
"""Two missed replies are coasted over, the third is a fault."""

ROWS: tuple[Row, ...] = (
    Row(
        "motor_silent",
        lambda d: FrameLoss(1.0, (joint(d),)),
        lambda d: wire.Servos((joint(d),), silence, "silent"),
        "damp",
        SILENT_TICKS,
    ),
    Row(
        "motors_silent_two",
        lambda d: FrameLoss(1.0, some(d, 2)),
        lambda d: wire.Servos(some(d, 2), silence, "silent"),
        "damp",
        SILENT_TICKS,
    ),
    Row(
        "motors_silent_all",
        lambda d: FrameLoss(1.0),
        lambda d: wire.Servos(ALL, silence, "silent"),
        "damp",
        SILENT_TICKS,
    ),
    Row(
        "motor_fault",
        lambda d: MotorFault(joint(d), draw_code(d)),
        lambda d: (lambda code: wire.Servos((joint(d),), failing(code), f"fault {code} in "))(draw_servo_code(d)),
        "damp",
        2,
    ),
    Row(
        "encoder_stuck",
        lambda d: StuckEncoder(joint(d)),
        lambda d: StuckEncoder(joint(d)),
        seconds=2.0,
    ),
    Row("encoder_jumping", lambda d: JumpingEncoder(joint(d), within(d, -1.0, 1.0), within(d, 0.01, 1.0), seed(d))),
    Row("encoder_noisy", lambda d: NoisyEncoder(joint(d), within(d, 0.001, 0.1), within(d, 0.1, 10.0), seed(d))),
    Row(
        "foot_stuck_on",
        lambda d: LyingFoot(int(d.integers(4)), round(float(10.0 ** d.uniform(1.6, 3)), 1)),
        must="stay",
        seconds=2.0,
    ),
    Row(
        "foot_stuck_off",
        lambda d: LyingFoot(int(d.integers(4)), -round(float(10.0 ** d.uniform(2, 3)), 1)),
        must="stay",
        seconds=2.0,
    ),
    Row("sign_reversed", lambda d: ReversedSign(joint(d)), lambda d: ReversedSign(joint(d))),
    Row("torque_lost", lambda d: WeakMotors((joint(d),), 0.0), seconds=2.0),
    Row("torque_saturated", lambda d: WeakMotors((joint(d),), within(d, 0.05, 0.6)), seconds=2.0),
    Row("joint_jammed", lambda d: JammedJoint(joint(d), within(d, 5.0, 200.0)), seconds=2.0),
    Row(
        "motor_hot",
        lambda d: HotMotor(joint(d), within(d, 0.0, 60.0), within(d, 60.0, 120.0)),
        lambda d: wire.Overheating(joint(d), within(d, 20.0, 90.0)),
    ),
    Row(
        "bus_off",
        lambda d: (lambda leg: FrameLoss(1.0, (3 * leg, 3 * leg + 1, 3 * leg + 2)))(int(d.integers(4))),
        lambda d: wire.BusOff((int(d.integers(4)),)),
        "damp",
        SILENT_TICKS,
    ),
    Row(
        "duplicate_id",
        lambda d: DuplicateId(*on_one_bus(d), seed(d)),
        lambda d: wire.SameId(*on_one_bus(d)),
        "damp",
        SILENT_TICKS,
    ),
    Row("frame_loss_1", lambda d: FrameLoss(0.01, ALL, seed(d)), lambda d: wire.BadWires(0.01, seed=seed(d)), "stay"),
    Row("frame_loss_5", lambda d: FrameLoss(0.05, ALL, seed(d)), lambda d: wire.BadWires(0.05, seed=seed(d))),
    Row("frame_loss_20", lambda d: FrameLoss(0.2, ALL, seed(d)), lambda d: wire.BadWires(0.2, seed=seed(d))),
    Row("frames_spoilt", None, lambda d: wire.BadWires(spoilt=within(d, 0.001, 0.2), seed=seed(d))),
    Row("replies_late_1", lambda d: LateReplies(1), lambda d: wire.BadWires(late=1)),
    Row("replies_late_2", lambda d: LateReplies(2), lambda d: wire.BadWires(late=2)),
    Row("replies_late_10", lambda d: LateReplies(10), lambda d: wire.BadWires(late=10), "damp", 4),
    Row("imu_frozen", lambda d: FrozenImu(), lambda d: wire.ImuBytes(wire.Freeze(), "frozen"), seconds=2.5),
    Row("imu_silent", lambda d: FrozenImu(False), lambda d: wire.ImuBytes(wire.mute, "silent"), "damp", 8),
    Row(
        "imu_nan",
        lambda d: NanImu(str(d.choice(FIELDS)), int(d.integers(12)), float(d.choice([np.nan, np.inf, -np.inf]))),
        lambda d: wire.ImuBytes(wire.Spoil(int(d.integers(10)), float(d.choice([np.nan, np.inf]))), "not a number"),
        "damp",
        8,
    ),
    Row(
        "imu_flipped",
        lambda d: FlippedImu(int(d.integers(2))),
        lambda d: wire.ImuBytes(wire.Flip(int(d.integers(2))), "flipped"),
        "damp",
        4,
    ),
    Row(
        "imu_bias",
        lambda d: BiasJump(within(d, -0.3, 0.3), int(d.integers(2)), vector(d, 1.0), vector(d, 3.0)),
        seconds=2.0,
    ),
    Row("imu_clipped", lambda d: ClippedImu(within(d, 0.1, 1.0), within(d, 9.9, 15.0)), seconds=2.0),
    Row(
        "imu_replugged",
        lambda d: ReplacedImu(within(d, 0.1, 0.6), within(d, -3.1, 3.1)),
        lambda d: wire.ImuBytes(wire.Gap(int(d.integers(40, 240))), "unplugged for a while"),
        "damp",
        8,
    ),
    Row(
        "imu_slow",
        lambda d: SlowImu(float(d.choice([10.0, 25.0, 50.0, 100.0]))),
        lambda d: (lambda n: wire.ImuBytes(wire.Every(n), f"every sample of {n}"))(int(d.choice([4, 8, 16, 40]))),
    ),
    Row(
        "battery_sag",
        lambda d: BatterySag(within(d, 12.0, 22.0), within(d, 0.1, 1.0)),
        lambda d: (lambda v: wire.Servos(ALL, at_volts(v), f"{v} V at "))(within(d, 12.0, 22.0)),
    ),
    Row(
        "brown_out",
        lambda d: BrownOut(tuple(range(int(d.integers(1, 5)))), within(d, 3.0, 15.0), int(d.integers(1, 20))),
        lambda d: wire.Servos(some(d, int(d.integers(1, 13))), restarting(int(d.integers(6))), "restarted "),
        "damp",
        2,
    ),
    Row(
        "policy_nan",
        lambda d: SpoiltPolicy(
            [(int(d.integers(28)), int(d.integers(12, 18)))], float(d.choice([np.nan, np.inf, -np.inf]))
        ),
        must="damp",
        within=2,
    ),
    Row("policy_huge", wild),
    Row(
        "policy_refused",
        lambda d: RefusedPolicy(
            (('"stoch3"', '"mini_cheetah"'), ('"matrix": [', '"matrix": [NaN, '), ('"format": 1', '"format": 2'))[
                int(d.integers(3))
            ]
        ),
        must="stay",
    ),
    Row("policy_while_falling", lambda d: PolicyWhileFalling(knock(d), within(d, 0.1, 0.4), wild(d)), seconds=2.0),
    Row("qp_infeasible", lambda d: Infeasible(), must="any"),
    Row("qp_nan", lambda d: SpoiltProblem(str(d.choice(["mass", "com", "force_weight"]))), must="damp", within=2),
    Row(
        "qp_first_fails",
        lambda d: SolverFault(str(d.choice(["none", "nan", "raise", "garbage", "off"])), None, seed(d)),
        must="stay",
    ),
    Row(
        "qp_both_fail",
        lambda d: SolverFault(
            str(d.choice(["none", "nan", "raise", "garbage"])), str(d.choice(["none", "nan", "raise"])), seed(d)
        ),
        must="stay",
    ),
    Row("qp_slow", lambda d: SlowSolver(int(d.integers(1, 6)), within(d, 0.05, 0.5))),
    Row("stall_5ms", lambda d: Stall(0.005), lambda d: Stall(0.005), "stay"),
    Row("stall_20ms", lambda d: Stall(0.02), lambda d: Stall(0.02), "stay"),
    Row("stall_100ms", lambda d: Stall(0.1), lambda d: Stall(0.1)),
    Row("stall_1000ms", lambda d: Stall(1.0), lambda d: Stall(1.0), "damp", 2),
    Row("clock_step", lambda d: ClockStep(float(d.choice([-3600.0, -1.0, -0.1, 0.1, 1.0, 3600.0])))),
    Row("operator_stops", lambda d: EmergencyStop(), lambda d: EmergencyStop(), "damp", 1),
    Row("operator_lost", lambda d: LostOperator(), must="stay", seconds=1.5),
    Row(
        "knocked_over",
        lambda d: knock(d),
        lambda d: knock(d),
        seconds=2.0,
    ),
)
BY_NAME = {row.name: row for row in ROWS}
