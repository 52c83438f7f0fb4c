"""A robot put together at random is commissioned over its wires, and then the real driver reads the truth."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers import calibration
from drivers.bus import InProcessBus
from drivers.calibration import Calibration
from drivers.commissioning import CommissionError
from drivers.motors import Motors
from drivers.robot import JOINTS, LEGS
from drivers.survey import MoteusQuestion, survey
from drivers.wiggle import ENOUGH, wiggle
from runtime import config
from sim.build import Build, lab_build, scrambled
from sim.scenario import Scenario
from sim.twin import RATE_HZ, TwinBody, TwinSetup
from sim.world import World
from trotd.commission.baseline import carried_over, with_baseline
from trotd.commission.steps import Commission, Task
from trotd.lockstep import LockstepImu

CONFIG = config.load(config.find_robot("stoch3"))
assert CONFIG.motors is not None
WIRED = CONFIG.motors
LOWER, UPPER = np.array(CONFIG.robot.joints.lower), np.array(CONFIG.robot.joints.upper)
TILTS = ((0.0, 0.0, 0.0), (0.0, 0.5, 0.0), (-0.5, 0.0, 0.0))
JIG = (0.0, 0.9, -1.8)


class Operator:
    """A person with hands on the twin: does what is asked, in the air. Also what the wires tell meanwhile."""

    def __init__(self, seed: int) -> None:
        self.build = scrambled(lab_build(), seed)
        self.now = 1.0
        self.world = World(CONFIG.robot, RATE_HZ, CONFIG.control.gait.walking_height)
        self.joints, self.rpy = np.clip(np.zeros((4, 3)), LOWER + 0.1, UPPER - 0.4), (0.0, 0.0, 0.0)
        self.twin = TwinBody(self.world, TwinSetup(self.build, WIRED, Scenario()), lambda: self.now)
        self.bus = InProcessBus(self.twin.wire.answer)
        self.asked: list[str] = []
        self.turn = 0.3
        self.said = ""

    def do(self, task: Task) -> str:
        self.asked.append(task.words)
        leg, joint = task.leg, task.joint
        if task.act == "turn":
            self.joints[leg, joint] += self.turn
        elif task.act == "stop":
            self.joints[leg, joint] = (LOWER, UPPER)[task.index][leg, joint]
        elif task.act == "jig":
            self.joints[:] = task.angles
        elif task.act == "tilt":
            self.rpy = TILTS[task.index]
        elif task.act == "say":
            return self.said
        self.world.hold(self.rpy, None if task.act == "watch" else self.joints)
        if task.act == "watch":
            self.live(3.0)
        self.live(1 / RATE_HZ)
        return ""

    def live(self, seconds: float) -> None:
        for _ in range(max(1, round(seconds * RATE_HZ))):
            self.now += 1 / RATE_HZ
            self.twin.step()

    def motors(self) -> dict[tuple[int, int], float]:
        ids = sorted({int(i) for i in self.build.id.ravel()})
        found = asyncio.run(survey(self.bus, range(1, 5), MoteusQuestion(), ids))
        return {(motor.bus, motor.id): motor.position for motor in found}

    def wiggle(self, place: tuple[int, int]) -> float:
        before, furthest = self.world.truth.joint_position, [np.zeros((4, 3))]

        async def sleep(seconds: float) -> None:
            self.live(seconds)
            furthest.append(self.world.truth.joint_position - before)

        turned = asyncio.run(wiggle(self.bus, WIRED, place, sleep))
        way = max(furthest, key=lambda moved: np.abs(moved).max())
        leg, joint = (int(index[0]) for index in np.nonzero(np.abs(way) > 0.5 * np.abs(way).max()))
        self.said = f"{LEGS[leg]} {JOINTS[joint]} {'+' if way[leg, joint] > 0 else '-'}"
        return turned

    def force(self) -> np.ndarray:
        imu = LockstepImu((1.0, 0.0, 0.0, 0.0))
        imu.take(1.0, self.twin.felt(self.twin.measurement.imu))
        return imu.latest().linear_acceleration

    def commission(self, path: Path, **choices: object) -> Commission:
        return Commission(CONFIG, WIRED, path, self, self.do, **choices)  # type: ignore[arg-type]


def assert_true(found: Calibration, build: Build, zero: float = 2e-3) -> None:
    assert np.array_equal(found.id, build.id)
    assert np.array_equal(found.bus, build.bus)
    assert np.array_equal(found.direction, build.direction)
    assert np.array(found.offset) == pytest.approx(build.offset, abs=zero)
    assert abs(float(np.array(found.mount) @ build.mount)) == pytest.approx(1.0, abs=1e-3)


def test_the_truth_is_recovered_by_hand_and_the_driver_reads_it(tmp_path):
    operator = Operator(1)
    found = operator.commission(tmp_path / "progress.json").run()
    assert_true(found, operator.build)
    calibration.save(found, tmp_path / "c.json")
    loaded = calibration.load(tmp_path / "c.json", CONFIG.robot, WIRED)
    assert CONFIG.imu is not None
    wired, _ = calibration.apply(loaded, WIRED, CONFIG.imu)
    motors = Motors(wired, operator.bus, 0.003)

    async def read() -> np.ndarray:
        await motors.open()
        await motors.query()
        return motors.joint_state().position

    assert asyncio.run(read()) == pytest.approx(operator.joints, abs=2e-3)
    assert {servo.mode for servo in operator.twin.servos} == {0}


def test_the_truth_is_recovered_by_gentle_power_and_a_jig(tmp_path):
    operator = Operator(2)
    torques: list[float] = []
    step = operator.twin.step

    def watch() -> object:
        torques.append(float(np.abs(operator.world.truth.joint_torque).max()))
        return step()

    operator.twin.step = watch  # type: ignore[method-assign,assignment]
    found = operator.commission(tmp_path / "progress.json", wiggle=True, jig=JIG).run()
    assert_true(found, operator.build)
    assert 0.05 < max(torques) <= WIRED.wiggle_torque
    assert {servo.mode for servo in operator.twin.servos} == {0}


def test_it_goes_on_where_it_stopped_and_a_step_can_be_done_again(tmp_path):
    path, operator = tmp_path / "progress.json", Operator(3)
    first = operator.commission(path)
    limit = 9

    def tire(task: Task) -> str:
        if len(operator.asked) >= limit:
            raise KeyboardInterrupt
        return operator.do(task)

    first._ask = tire
    with pytest.raises(KeyboardInterrupt):
        first.run()
    assert len(first.progress.joints) == 4
    operator.asked.clear()
    second = operator.commission(path)
    found = second.run()
    assert operator.asked[0].startswith("FR hip")
    assert second.complete
    for step, questions in (("mount", 3), ("zeros", 24), ("joints", 48)):
        operator.asked.clear()
        again = operator.commission(path)
        again.undo(step)
        assert not operator.commission(path).complete
        assert operator.commission(path).run().offset == pytest.approx(np.array(found.offset), abs=1e-3)
        assert len(operator.asked) == questions


def test_a_joint_that_did_not_move_is_asked_for_again(tmp_path):
    operator = Operator(4)
    operator.turn = 0.01
    with pytest.raises(CommissionError, match="FL abduction: no motor turned"):
        operator.commission(tmp_path / "progress.json").run()
    operator.turn = 0.3
    operator.commission(tmp_path / "progress.json").run()


def test_a_range_that_is_not_the_models_is_refused_at_once_and_asked_again(tmp_path):
    operator = Operator(5)
    work = operator.commission(tmp_path / "progress.json")
    do, short = operator.do, [True]

    def stop_short(task: Task) -> str:
        answer = do(task)
        if task.words.startswith("FR knee: bring it to the other") and short.pop():
            operator.joints[1, 2] -= 0.6
            do(Task("let go", ""))
        return answer

    work._ask = stop_short
    with pytest.raises(CommissionError, match=r"FR knee: turned 2\.27 rad from stop to stop, the model says 2\.87"):
        work.run()
    operator.asked.clear()
    assert_true(operator.commission(tmp_path / "progress.json").run(), operator.build)
    assert operator.asked[0] == "FR knee: bring it to one end stop and hold it"


def test_a_motor_that_is_jammed_is_named_and_left_without_torque(tmp_path):
    operator = Operator(6)
    operator.world.hold((0.0, 0.0, 0.0), operator.joints)
    place = int(operator.build.bus[0, 0]), int(operator.build.id[0, 0])
    with pytest.raises(CommissionError, match=rf"bus {place[0]} id {place[1]} did not turn with 3 N·m either way"):
        operator.wiggle(place)
    assert {servo.mode for servo in operator.twin.servos} == {0}
    operator.twin.servos[0].fail(38)  # type: ignore[attr-defined]
    operator.twin.servos[0].silent = True  # type: ignore[attr-defined]
    with pytest.raises(CommissionError, match="does not answer"):
        operator.wiggle(place)


def test_a_wiggle_turns_no_further_than_it_must(tmp_path):
    operator = Operator(7)
    operator.do(Task("watch", ""))
    place = int(operator.build.bus[2, 2]), int(operator.build.id[2, 2])
    assert ENOUGH <= abs(operator.wiggle(place)) < 2 * ENOUGH


def test_a_motor_that_falls_silent_for_a_while_is_let_go_and_turned_anew(tmp_path):
    operator = Operator(7)
    operator.do(Task("watch", ""))
    servo, answer = operator.twin.servos[8], operator.bus._answer
    asked = 0

    def falls_silent(frame):
        nonlocal asked
        asked += 1
        servo.silent = 20 <= asked < 23
        return answer(frame)

    operator.bus._answer = falls_silent
    assert ENOUGH <= abs(operator.wiggle((int(operator.build.bus[2, 2]), int(operator.build.id[2, 2])))) < 2 * ENOUGH
    assert asked > 23
    assert {servo.mode for servo in operator.twin.servos} == {0}


def test_nonsense_for_an_answer_is_asked_again_and_then_given_up(tmp_path):
    operator = Operator(8)
    answers = iter(["FL knee", "left leg +", "FL elbow +"])
    operator.wiggle = lambda place: 0.1  # type: ignore[method-assign]
    work = operator.commission(tmp_path / "progress.json", wiggle=True)
    work._ask = lambda task: next(answers) if task.act == "say" else ""
    with pytest.raises(CommissionError, match="no answer like 'FL knee \\+'"):
        work.run()
    assert work.progress.joints == {}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ('{"version": 2, "robot": "spot"}', "spot"),
        ('{"version": 9, "robot": "stoch3"}', "version 9, this program writes 2"),
        ('{"robot": "stoch3", "joints": [[[1, 11, 1]]]}', "anew"),
        ('{"version": 2, "robot": "stoch3", "joints": {"FL elbow": [1, 11, 1]}}', "FL elbow"),
        ("nonsense", "anew"),
    ],
)
def test_the_progress_of_another_robot_or_version_is_refused(tmp_path, content, words):
    path = tmp_path / "progress.json"
    path.write_text(content)
    with pytest.raises(CommissionError, match=words):
        Commission(CONFIG, WIRED, path, None, None)  # type: ignore[arg-type]


def test_a_baseline_outlives_a_new_mount_and_not_a_new_zero(tmp_path):
    operator = Operator(9)
    work = operator.commission(tmp_path / "progress.json", jig=JIG)
    before = with_baseline(work.run(), (1.0, -2.0, 3.0, 0.5))
    work.undo("mount")
    assert carried_over(before, operator.commission(tmp_path / "progress.json").run()).contact_baseline[2] == 3.0
    work = operator.commission(tmp_path / "progress.json", jig=(0.1, 0.9, -1.8))
    work.undo("zeros")
    work._ask = lambda task: operator.do(replace(task, angles=JIG))
    assert carried_over(before, work.run()).contact_baseline == (0.0,) * 4
