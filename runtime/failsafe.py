"""What can go wrong, who notices, what the daemon does, how soon, and the test that proves it: one table.

``python -m runtime.failsafe docs/torture.json`` prints ``docs/failsafe.md``; ``make failsafe`` writes it.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from runtime.failsafe_figures import figures
from runtime.reasons import SEATED, WHOLE, WORDS, Reason

LIMITS, PLAUSIBILITY, CYCLE = "tests/test_limits.py", "tests/test_plausibility.py", "tests/test_cycle.py"
ENCODERS, DEGRADE = "tests/test_encoders.py", "tests/test_degrade.py"
TORTURE, DAEMON = "tests/test_torture.py", "tests/test_daemon.py"
CONTACTS = "tests/test_lying_contacts.py"
INJECTED = f"{LIMITS}::test_an_injected_fault_is_named"
WEAK_MOTOR = f"{PLAUSIBILITY}::test_a_motor_that_does_not_give_what_it_is_told_is_found"


@dataclass(frozen=True)
class Fault:
    """One row of the fault matrix."""

    fault: str
    reason: Reason | None
    """How it is named; None where nothing has to be said."""
    judged: str
    """Module and function."""
    ticks: str
    """From its first sign to the answer."""
    test: str
    """``file::name``."""
    does: str = ""
    """What the daemon does, where the reason alone does not say it."""

    @property
    def answer(self) -> str:
        """What the daemon does."""
        if self.does or self.reason is None:
            return self.does
        if self.reason in WHOLE:
            return "standing: sits down; walking: stops, stands, sits down"
        if self.reason in SEATED:
            return "standing: sits down; walking: folds its legs, damps"
        return "damps"


TABLE: tuple[Fault, ...] = (
    Fault(
        "a motor is silent",
        Reason.MOTOR_FAULT,
        "drivers.motors",
        "`coasted_ticks` + 1: 3",
        f"{TORTURE}::test_a_sample_of_the_matrix_holds_its_bounds",
    ),
    Fault("a motor's reply is older than it may be", Reason.STALE_MOTOR, "limits.judge_joint", "`max_age`", INJECTED),
    Fault(
        "no motor answers",
        Reason.BODY_SILENT,
        "drivers.hardware",
        "`coasted_ticks` + 1: 3",
        f"{CYCLE}::test_a_silent_body_damps",
    ),
    Fault("a motor reports a fault", Reason.MOTOR_FAULT, "limits.judge_joint", "1", INJECTED),
    Fault(
        "one reply is late or lost",
        None,
        "limits.judge_joint",
        "1",
        f"{PLAUSIBILITY}::test_a_joint_that_was_silent_for_two_ticks_does_not_jump",
        "the last reading stands in (`COASTED`); nothing is judged by it that needs this tick's",
    ),
    Fault("a motor is too hot", Reason.HOT_MOTOR, "limits.judge_joint", "1", INJECTED),
    Fault(
        "a motor is warm",
        None,
        "derating.derate_joint",
        "1",
        f"{DEGRADE}::test_warm_motors_slow_the_walk_and_bound_its_torque",
        "its torque bound falls (`THERMAL`), and the speed (`SPEED`)",
    ),
    Fault(
        "rms torque near the rating",
        None,
        "derating.derate_joint",
        "1",
        "tests/test_derating.py::test_torque_is_taken_back_as_the_rms_nears_the_rating",
        "its torque bound falls (`CURRENT`)",
    ),
    Fault(
        "rms torque beyond the rating",
        Reason.OVERLOAD,
        "limits.judge_load",
        "1",
        f"{LIMITS}::test_the_continuous_rating_holds_for_the_rms",
    ),
    Fault("a joint is too fast", Reason.JOINT_SPEED, "limits.judge_joint", "1", INJECTED),
    Fault(
        "a walking robot's joint is too fast",
        Reason.JOINT_SPEED,
        "limits.judge_joint",
        "`overspeed_time`; beyond `max_overspeed` 1",
        f"{LIMITS}::test_a_walking_joint_may_be_too_fast_for_a_moment",
    ),
    Fault(
        "a reading is not a number",
        Reason.NOT_FINITE,
        "limits.judge_joint",
        "1",
        f"{LIMITS}::test_whatever_is_not_a_number_is_seen",
    ),
    Fault(
        "an encoder jumps",
        Reason.JUMPING_ENCODER,
        "plausibility.look_at_joint",
        "1",
        f"{PLAUSIBILITY}::test_an_encoder_that_jumps_is_found_at_once_and_named",
    ),
    Fault(
        "an encoder is noisy",
        Reason.NOISY_ENCODER,
        "plausibility.look_at_joint",
        "0.1 s",
        f"{PLAUSIBILITY}::test_a_noisy_encoder_is_found_and_a_quiet_one_is_not",
    ),
    Fault(
        "an encoder is stuck",
        Reason.STUCK_ENCODER,
        "encoders.look_at_encoder",
        "`stuck_time`",
        f"{ENCODERS}::test_an_encoder_that_stands_still_while_its_leg_moves_is_found",
    ),
    Fault(
        "an encoder is stuck, in a walk",
        Reason.STUCK_ENCODER,
        "encoders.look_at_encoder",
        "2 to 20",
        f"{ENCODERS}::test_an_encoder_that_stands_still_while_its_joint_is_told_to_move_is_found_at_once",
    ),
    Fault(
        "an encoder is stuck while the robot stands still",
        Reason.STUCK_ENCODER,
        "encoders.look_at_encoder",
        "at the first tilt of `stuck_tilt` or the first step",
        f"{ENCODERS}::test_an_encoder_that_stands_still_while_the_robot_tilts_is_found",
        "nothing until it shows: its motor holds with the torque that it held with before; then damps",
    ),
    Fault(
        "one foot feels the ground always, or never",
        None,
        "contact.feel_contacts",
        "`lie_strides` strides",
        f"{CONTACTS}::test_a_foot_that_lies_is_found_and_the_robot_walks_on",
        "the gait's schedule says whether it is down (`CONTACT`), an event names the leg",
    ),
    Fault(
        "more than one foot does",
        Reason.LYING_CONTACTS,
        "cycle",
        "1",
        f"{CONTACTS}::test_two_feet_that_lie_end_the_walk",
    ),
    Fault("a motor gives no torque", Reason.TORQUE_LOST, "plausibility.look_at_motor", "0.14 s", WEAK_MOTOR),
    Fault("a motor turns the wrong way", Reason.REVERSED_MOTOR, "plausibility.look_at_motor", "0.05 s", WEAK_MOTOR),
    Fault(
        "a joint does not follow",
        Reason.ASTRAY,
        "plausibility.look_at_motor",
        "`tracking_time`",
        f"{PLAUSIBILITY}::test_a_joint_that_does_not_follow_its_target_is_found",
    ),
    Fault(
        "the IMU misses a sample or two",
        None,
        "plausibility.look_at_imu",
        "1",
        f"{DEGRADE}::test_an_imu_that_misses_samples_is_carried_on",
        "the last one is turned on by its own rate (`EXTRAPOLATED`)",
    ),
    Fault("the IMU is silent", Reason.STALE_IMU, "plausibility.look_at_imu", "`max_age`", INJECTED),
    Fault(
        "the IMU tells what is not a number, or cannot be",
        Reason.IMPLAUSIBLE_IMU,
        "plausibility.look_at_imu",
        "3",
        f"{PLAUSIBILITY}::test_a_missing_sample_is_carried_on_for_as_long_as_the_robot_says",
    ),
    Fault(
        "the IMU is frozen",
        Reason.FROZEN_IMU,
        "plausibility.look_at_imu",
        "`frozen_time` + 2",
        f"{PLAUSIBILITY}::test_an_imu_that_repeats_itself_while_joints_move_is_found",
    ),
    Fault(
        "the IMU's attitude flips or jumps",
        Reason.ATTITUDE_JUMP,
        "plausibility.look_at_imu",
        "3",
        f"{PLAUSIBILITY}::test_a_flip_is_a_jump_while_the_robot_is_up",
    ),
    Fault(
        "the gyro's bias jumps, or its scale is wrong",
        Reason.TURN_ERROR,
        "plausibility.look_at_imu",
        "4 to 40",
        f"{PLAUSIBILITY}::test_a_gyro_that_jumps_is_found",
    ),
    Fault(
        "the accelerometer's bias jumps",
        Reason.GRAVITY_ERROR,
        "plausibility.look_at_imu",
        "about 1 s",
        f"{PLAUSIBILITY}::test_an_accelerometer_that_jumps_is_found",
    ),
    Fault(
        "the supply sags",
        Reason.LOW_VOLTAGE,
        "limits.judge_body",
        "1",
        f"{LIMITS}::test_low_voltage",
    ),
    Fault(
        "it is knocked over, and no step would catch it",
        Reason.FALLING,
        "limits.judge_fall",
        "1",
        "tests/test_soft_fall.py::test_a_robot_that_is_knocked_over_is_low_before_it_lands",
        "folds its legs at once (`posture.tuck_time`), damps",
    ),
    Fault("it tips over", Reason.TILTED, "limits.judge_body", "1", INJECTED),
    Fault(
        "the policy asks for what is not a number, or huge",
        Reason.BAD_POLICY,
        "limits.judge_policy",
        "1",
        f"{PLAUSIBILITY}::test_a_policy_that_asks_for_what_cannot_be_is_found",
    ),
    Fault(
        "one QP solver fails, or both",
        None,
        "solvers.Ladder",
        "1",
        "tests/test_controller.py::test_every_step_of_the_ladder_is_named_in_the_record",
        "the second solver's forces; without them clipped least squares (`FALLBACK`), and it walks on",
    ),
    Fault(
        "no ground reaction forces",
        Reason.SOLVER_FAILED,
        "control.controller",
        "1",
        f"{TORTURE}::test_a_sample_of_the_matrix_holds_its_bounds",
    ),
    Fault(
        "the computed command is not finite",
        Reason.BAD_COMMAND,
        "limits.bound_command",
        "1",
        f"{CYCLE}::test_a_controller_that_finds_nothing_sits_a_standing_robot_down",
    ),
    Fault(
        "the loop is 50 ms late in a walk",
        Reason.LATE_LOOP,
        "limits.judge_body",
        "1",
        f"{PLAUSIBILITY}::test_a_loop_that_stood_still_is_answered_by_its_length",
        "stops and stands; no fault",
    ),
    Fault(
        "the loop stood still for 100 ms",
        Reason.STALLED,
        "limits.judge_body",
        "1",
        f"{PLAUSIBILITY}::test_a_loop_that_stood_still_is_answered_by_its_length",
    ),
    Fault(
        "the host's clock is stepped",
        None,
        "monotonic time only",
        "",
        f"{PLAUSIBILITY}::test_a_step_of_the_bodys_clock_is_nothing",
        "nothing",
    ),
    Fault(
        "the operator is gone",
        Reason.OPERATOR_LOST,
        "modes.lose_operator",
        "1",
        f"{DEGRADE}::test_a_fast_robot_slows_down_before_it_stands",
        "stops and stands; no fault",
    ),
    Fault(
        "velocity commands stop coming",
        Reason.COMMAND_LOST,
        "modes.advance",
        "`command.expiry`, `stand_after`",
        f"{CYCLE}::test_a_velocity_command_is_followed_expires_and_then_the_robot_stands",
        "slows to rest (`EXPIRED`), then stands; no fault",
    ),
    Fault(
        "an exception inside the tick",
        None,
        "daemon",
        "1",
        f"{DAEMON}::test_an_exception_inside_the_tick_ends_in_damp",
        "damps and ends",
    ),
    Fault(
        "SIGTERM, Ctrl-C",
        Reason.STOPPING,
        "daemon",
        "1",
        f"{DAEMON}::test_a_signal_in_the_middle_of_a_walk_ends_in_damp",
        "damps, records and ends",
    ),
)

HEAD = """# What happens when

Written by `make failsafe` from the one table in `runtime/failsafe.py`; a test holds this file to it. Bounds in
`code` are keys of the robot's TOML. Ticks are counted from the first reading that shows the fault to the answer.
"Damps" from standing means with `damp.fall_kd` for the first moments. `limits.sit_down = false` turns every "sits down"
and "stops" of a fault into "damps". A fault stays, with its evidence, until `trotd clear`.

| fault | named | judged in | what the daemon does | ticks | proven by |
|---|---|---|---|---|---|
"""


def document(measured: Path) -> str:
    """The table as Markdown, and behind it what torture wrote to the file ``measured``."""
    rows = []
    for row in TABLE:
        named = "" if row.reason is None else WORDS[row.reason]
        judged = f"`{row.judged}`" if "." in row.judged and " " not in row.judged else row.judged
        rows.append(f"| {row.fault} | {named} | {judged} | {row.answer} | {row.ticks} | `{row.test}` |\n")
    return HEAD + "".join(rows) + figures(measured)


if __name__ == "__main__":
    sys.stdout.write(document(Path(sys.argv[1])))
