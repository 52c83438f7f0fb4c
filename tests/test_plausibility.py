"""What only shows from tick to tick, each injected into a stream of readings: found, named, and not found too soon."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from test_limits import healthy, make_guard

from drivers.robot import LEGS
from runtime.control.records import Clamp, Records
from runtime.guard import Guard
from runtime.messages.mode import Mode
from runtime.reasons import Reason

PERIOD = 0.005
Change = Callable[[Records, int], None]


class Stream:
    """Readings of a robot that turns its body and moves its legs, honestly, tick after tick."""

    def __init__(self, mode: Mode = Mode.STAND, turning: float = 0.5, **limits: object) -> None:
        self.guard: Guard = make_guard(**limits)
        self.mode, self.turning, self.index = mode, turning, 0
        self.command = 10.0
        """Feed-forward of every motor, N·m."""
        self.marks = 0

    def reading(self) -> Records:
        tick = healthy()
        seconds = self.index * PERIOD
        angle = 0.2 * math.sin(self.turning * seconds / 0.2)
        rate = self.turning * math.cos(self.turning * seconds / 0.2)
        tick["orientation"][0] = (math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0)
        tick["angular_velocity"][0] = (rate, 0.0, 0.0)
        tick["linear_acceleration"][0] = (0.0, 9.81 * math.sin(angle), 9.81 * math.cos(angle))
        tick["joint_position"] = tick["joint_position"] + 0.3 * math.sin(5.0 * seconds)
        tick["joint_velocity"] = 1.5 * math.cos(5.0 * seconds)
        tick["joint_torque"] = tick["command_torque"] = self.command
        tick["measured_stamp"] = tick["imu_stamp"] = 10.0 + seconds
        tick["mode"] = self.mode
        return tick

    def live(self, ticks: int, change: Change = lambda _tick, _n: None) -> tuple[int, Reason]:
        """Until the guard finds something: in which tick and what; or 0 and OK."""
        for count in range(1, ticks + 1):
            self.index += 1
            tick = self.reading()
            change(tick, count)
            verdict = self.guard.judge(tick)
            self.marks = self.guard.marks
            self.guard.keep_command(tick)
            if verdict is not Reason.OK:
                return count, verdict
        return 0, Reason.OK


def test_an_honest_stream_passes() -> None:
    stream = Stream()
    assert stream.live(2000) == (0, Reason.OK)
    assert stream.marks == 0


# The IMU ---------------------------------------------------------------------------------------------------------


def test_an_imu_that_repeats_itself_while_joints_move_is_found() -> None:
    stream = Stream()
    stream.live(100)
    kept = stream.reading()

    def freeze(tick: Records, _n: int) -> None:
        for name in ("orientation", "angular_velocity", "linear_acceleration"):
            tick[name] = kept[name]

    found, reason = stream.live(100, freeze)
    assert reason is Reason.FROZEN_IMU
    assert 10 <= found <= 16, "50 ms and two ticks carried on"
    evidence = stream.guard.evidence(reason)
    assert evidence.value is not None and evidence.value > evidence.bound == 50.0 and evidence.unit == "ms"


def test_an_imu_that_repeats_itself_while_nothing_moves_is_at_rest() -> None:
    stream = Stream(turning=0.0)

    def rest(tick: Records, _n: int) -> None:
        tick["joint_velocity"] = 0.0
        tick["joint_position"] = 0.0

    assert stream.live(1000, rest) == (0, Reason.OK)


def test_one_sample_seen_twice_is_not_frozen() -> None:
    """A loop that is quicker than its IMU sees every sample several times, with one stamp."""
    stream = Stream()
    held: list[Records] = []

    def hold(tick: Records, n: int) -> None:
        if n % 2:
            held[:] = [tick.copy()]
        for name in ("orientation", "angular_velocity", "linear_acceleration", "imu_stamp"):
            tick[name] = held[0][name]

    assert stream.live(1000, hold) == (0, Reason.OK)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_flip_is_a_jump_while_the_robot_is_up(axis: int) -> None:
    stream = Stream()
    stream.live(50)

    def flip(tick: Records, _n: int) -> None:
        w, x, y, z = tick["orientation"][0]
        turned = ((-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w))[axis]
        tick["orientation"][0] = turned

    found, reason = stream.live(400, flip)
    assert (found, reason) == (3, Reason.ATTITUDE_JUMP), "two ticks are carried on"
    assert stream.live(1, flip) == (1, Reason.ATTITUDE_JUMP), "and stays one"
    assert "3.1" in stream.guard.explain(reason)


def test_a_robot_that_was_turned_by_hand_while_it_lay_is_believed_again() -> None:
    stream = Stream(Mode.DAMP)
    stream.live(50)

    def turned(tick: Records, _n: int) -> None:
        w, x, y, z = tick["orientation"][0]
        c, s = math.cos(0.5), math.sin(0.5)
        tick["orientation"][0] = (c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w)

    assert stream.live(1, turned) == (0, Reason.OK)
    assert stream.marks & Clamp.EXTRAPOLATED
    assert stream.live(200, turned) == (0, Reason.OK)
    assert not stream.marks & Clamp.EXTRAPOLATED


def test_a_sample_that_is_missing_for_two_ticks_is_carried_on_by_its_rate() -> None:
    stream = Stream(turning=2.0)
    stream.live(50)

    def spoil(tick: Records, n: int) -> None:
        if n <= 2:
            tick["orientation"] = math.nan

    truth = stream.reading()
    for _ in range(2):
        assert stream.live(1, spoil) == (0, Reason.OK)
        assert stream.marks & Clamp.EXTRAPOLATED
        truth = stream.reading()
        carried = stream.guard.carried_imu()
        assert carried is not None
        np.testing.assert_allclose(carried.orientation, truth["orientation"][0], atol=2e-3)
    assert stream.live(1) == (0, Reason.OK)
    assert stream.guard.carried_imu() is None


@pytest.mark.parametrize("ticks", [0, 1, 2, 5])
def test_a_missing_sample_is_carried_on_for_as_long_as_the_robot_says(ticks: int) -> None:
    stream = Stream(imu_extrapolation=ticks)
    stream.live(50)

    def spoil(tick: Records, _n: int) -> None:
        tick["angular_velocity"] = math.nan

    assert stream.live(20, spoil) == (ticks + 1, Reason.IMPLAUSIBLE_IMU)


def test_an_old_sample_is_carried_on_and_a_very_old_one_is_stale() -> None:
    stream = Stream()
    stream.live(50)
    stopped = float(stream.reading()["imu_stamp"][0])
    kept = stream.reading()

    def stop(tick: Records, _n: int) -> None:
        for name in ("orientation", "angular_velocity", "linear_acceleration"):
            tick[name] = kept[name]
        tick["imu_stamp"] = stopped

    assert stream.live(3, stop) == (0, Reason.OK)
    assert stream.marks & Clamp.EXTRAPOLATED
    found, reason = stream.live(20, stop)
    assert reason is Reason.STALE_IMU and 3 + found == 7, "7 ticks pass 30 ms"


@pytest.mark.parametrize(("bias", "soonest", "latest"), [(0.3, 0, 0), (1.0, 10, 40), (5.0, 4, 12)])
def test_a_gyro_that_jumps_is_found(bias: float, soonest: int, latest: int) -> None:
    stream = Stream()
    stream.live(100)

    def jump(tick: Records, _n: int) -> None:
        tick["angular_velocity"][0, 1] += bias

    found, reason = stream.live(600, jump)
    assert reason is (Reason.TURN_ERROR if latest else Reason.OK)
    assert soonest <= found <= latest


def test_a_gyro_of_another_scale_is_found() -> None:
    stream = Stream(turning=1.0)
    stream.live(100)

    def scale(tick: Records, _n: int) -> None:
        tick["angular_velocity"] *= 4.0

    assert stream.live(400, scale)[1] is Reason.TURN_ERROR


@pytest.mark.parametrize(("bias", "trips"), [(2.0, False), (8.0, True)])
def test_an_accelerometer_that_jumps_is_found(bias: float, trips: bool) -> None:
    stream = Stream()
    stream.live(100)

    def jump(tick: Records, _n: int) -> None:
        tick["linear_acceleration"][0, 0] += bias

    found, reason = stream.live(1500, jump)
    assert reason is (Reason.GRAVITY_ERROR if trips else Reason.OK)
    assert not trips or found < 160, "8 m/s² pass the bound of 4 within 0.7 s and two ticks"


# Joints ----------------------------------------------------------------------------------------------------------


def test_an_encoder_that_jumps_is_found_at_once_and_named() -> None:
    stream = Stream()
    stream.live(50)

    def jump(tick: Records, _n: int) -> None:
        tick["joint_position"][0, 2, 1] += 0.5

    assert stream.live(1, jump) == (1, Reason.JUMPING_ENCODER)
    assert "BL hip" in stream.guard.explain(Reason.JUMPING_ENCODER)


def test_a_noisy_encoder_is_found_and_a_quiet_one_is_not() -> None:
    for stdev, reason in ((0.004, Reason.OK), (0.1, Reason.NOISY_ENCODER)):
        stream, random = Stream(max_position_jump=3.0), np.random.default_rng(1)
        stream.live(50)

        def shake(tick: Records, _n: int, stdev: float = stdev, random: np.random.Generator = random) -> None:
            tick["joint_position"][0, 3, 0] += random.normal(0.0, stdev)

        assert stream.live(400, shake)[1] is reason
        if reason is not Reason.OK:
            assert "BR abduction" in stream.guard.explain(reason)


def test_a_quick_joint_does_not_jump() -> None:
    stream = Stream()

    def run(tick: Records, n: int) -> None:
        tick["joint_position"][0, 0, 0] = 29.0 * PERIOD * n
        tick["joint_velocity"][0, 0, 0] = 29.0

    assert stream.live(20, run) == (0, Reason.OK)


def test_a_joint_that_was_silent_for_two_ticks_does_not_jump() -> None:
    stream = Stream()
    stream.live(50)
    kept = stream.reading()

    def lose(tick: Records, n: int) -> None:
        tick["joint_velocity"][0, 1, 2] = 20.0
        tick["joint_position"][0, 1, 2] += 20.0 * PERIOD * n
        if n <= 2:
            tick["joint_position"][0, 1, 2] = kept["joint_position"][0, 1, 2]
            tick["joint_age"][0, 1, 2] = PERIOD * (n + 0.5)

    assert stream.live(2, lose) == (0, Reason.OK)
    assert stream.marks & Clamp.COASTED
    assert stream.live(1, lambda tick, _n: lose(tick, 3)) == (0, Reason.OK)
    assert not stream.marks & Clamp.COASTED


# Motors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("share", "reason"),
    [(0.0, Reason.TORQUE_LOST), (0.15, Reason.TORQUE_LOST), (-1.0, Reason.REVERSED_MOTOR), (0.5, Reason.OK)],
)
def test_a_motor_that_does_not_give_what_it_is_told_is_found(share: float, reason: Reason) -> None:
    stream = Stream()
    stream.live(50)

    def weaken(tick: Records, _n: int) -> None:
        tick["joint_torque"][0, 1, 2] *= share

    found, seen = stream.live(200, weaken)
    assert seen is reason
    if reason is not Reason.OK:
        assert found <= 45 and "FR knee" in stream.guard.explain(reason)


@pytest.mark.parametrize("mean", [0.0, -0.3])
def test_a_motor_that_obeys_a_noisy_speed_has_a_noisy_encoder(mean: float) -> None:
    """Its torque is anything; named is what makes it so, not what it looks like."""
    stream, random = Stream(), np.random.default_rng(1)
    stream.live(50)

    def shake(tick: Records, _n: int) -> None:
        tick["joint_velocity"][0, 2, 0] += random.normal(0.0, 3.0)
        tick["joint_torque"][0, 2, 0] *= mean + random.normal(0.0, 1.0)

    _, reason = stream.live(400, shake)
    assert reason is Reason.NOISY_ENCODER
    assert "BL abduction" in stream.guard.explain(reason)


def test_a_motor_that_is_asked_for_little_is_not_judged() -> None:
    stream = Stream()
    stream.command = 4.0

    def idle(tick: Records, _n: int) -> None:
        tick["joint_torque"] = 0.0

    assert stream.live(400, idle) == (0, Reason.OK)


def test_a_motor_that_was_lost_is_believed_again_after_rest() -> None:
    stream = Stream()
    stream.live(50)

    def lose(tick: Records, _n: int) -> None:
        tick["joint_torque"] = 0.0

    assert stream.live(200, lose)[1] is Reason.TORQUE_LOST
    stream.command, stream.mode = 0.0, Mode.DAMP
    for _ in range(400):
        stream.live(1)
    assert stream.live(400) == (0, Reason.OK)


def test_a_joint_that_does_not_follow_its_target_is_found() -> None:
    stream = Stream()
    stream.live(50)

    def stray(tick: Records, _n: int) -> None:
        tick["command_kp"][0, 0, 1] = 20.0
        tick["command_position"][0, 0, 1] = tick["joint_position"][0, 0, 1] + 1.0
        tick["command_torque"][0, 0, 1] = -10.0

    def obey(tick: Records, n: int) -> None:
        stray(tick, n)
        tick["joint_torque"][0, 0, 1] = 10.0

    found, reason = stream.live(100, obey)
    assert reason is Reason.ASTRAY and 30 <= found <= 36, "0.15 s, and two ticks until the first command acts"
    assert f"{LEGS[0]} hip" in stream.guard.explain(reason)


# The loop --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("elapsed", "mode", "reason"),
    [
        (0.005, Mode.WALK, Reason.OK),
        (0.02, Mode.WALK, Reason.OK),
        (0.06, Mode.WALK, Reason.LATE_LOOP),
        (0.06, Mode.STAND, Reason.OK),
        (0.11, Mode.WALK, Reason.STALLED),
        (0.11, Mode.STAND, Reason.STALLED),
        (1.0, Mode.STAND, Reason.STALLED),
    ],
)
def test_a_loop_that_stood_still_is_answered_by_its_length(elapsed: float, mode: Mode, reason: Reason) -> None:
    stream = Stream(mode)
    stream.live(50)

    def stall(tick: Records, _n: int) -> None:
        tick["period"] = elapsed

    assert stream.live(1, stall)[1] is reason


@pytest.mark.parametrize("step", [-3600.0, -1.0, 1.0, 3600.0])
def test_a_step_of_the_bodys_clock_is_nothing(step: float) -> None:
    stream = Stream()
    stream.live(50)

    def shift(tick: Records, _n: int) -> None:
        tick["measured_stamp"] += step + 7200.0 * (step < -10.0)
        tick["imu_stamp"] += step + 7200.0 * (step < -10.0)

    assert stream.live(200, shift) == (0, Reason.OK)


@pytest.mark.parametrize("name", ["position", "force", "moment"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -1e6])
def test_a_policy_that_asks_for_what_cannot_be_is_found(name: str, value: float) -> None:
    guard, tick = make_guard(), healthy()
    assert guard.judge_plan(tick) is Reason.OK
    tick["asked"][0, {"position": 4, "force": 13, "moment": 17}[name]] = value
    assert guard.judge_plan(tick) is Reason.BAD_POLICY
    assert guard.evidence(Reason.BAD_POLICY).bound == {"position": 1.5, "force": 2500.0, "moment": 1000.0}[name]
