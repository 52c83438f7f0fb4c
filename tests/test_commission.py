"""A robot put together at random is commissioned over its wires, and then the real driver reads the truth."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest
from twin_walk import LockstepImu

from drivers import calibration
from drivers.bus import InProcessBus
from drivers.commissioning import CommissionError
from drivers.motors import Motors
from drivers.robot import JOINTS, LEGS
from drivers.survey import survey
from runtime import config
from sim.build import lab_build, scrambled
from sim.scenario import Scenario
from sim.twin import RATE_HZ, TwinBody, TwinSetup
from sim.world import World
from trotd.commission import Commission

CONFIG = config.load(config.find_robot("stoch3"))
assert CONFIG.motors is not None
WIRED = CONFIG.motors
LOWER, UPPER = np.array(CONFIG.robot.joints.lower), np.array(CONFIG.robot.joints.upper)
TILTS = {"level": (0.0, 0.0, 0.0), "nose down": (0.0, 0.5, 0.0), "left side down": (-0.5, 0.0, 0.0)}


class Operator:
    """A person with hands on the twin: does what is asked, in the air."""

    def __init__(self, seed: int) -> None:
        self.build = scrambled(lab_build(), seed)
        self.world = World(CONFIG.robot, RATE_HZ, CONFIG.control.gait.walking_height)
        self.joints, self.rpy = np.clip(np.zeros((4, 3)), LOWER + 0.1, UPPER - 0.4), (0.0, 0.0, 0.0)
        self.twin = TwinBody(self.world, TwinSetup(self.build, WIRED, self.scenario()))
        self.bus = InProcessBus(self.twin.wire.answer)
        self.asked: list[str] = []
        self.clumsy = False

    def scenario(self) -> Scenario:
        return Scenario(joint_position=self.joints, rpy=self.rpy, height=5.0)

    def do(self, text: str) -> None:
        self.asked.append(text)
        if text.startswith("IMU"):
            self.rpy = next(rpy for pose, rpy in TILTS.items() if pose in text)
        else:
            leg, joint = LEGS.index(text[:2]), JOINTS.index(text[3:].partition(":")[0])
            if "about 20 degrees" in text:
                self.joints[leg, joint] += 0.01 if self.clumsy else 0.3
            elif "one end stop" in text:
                self.joints[leg, joint] = LOWER[leg, joint]
            elif "other end stop" in text:
                self.joints[leg, joint] = UPPER[leg, joint]
        self.twin._sense(self.world.reset(self.scenario()))

    def motors(self) -> dict[tuple[int, int], float]:
        found = asyncio.run(survey(self.bus, range(1, 5), sorted({int(i) for i in self.build.id.ravel()})))
        return {(motor.bus, motor.id): motor.position for motor in found}

    def force(self) -> np.ndarray:
        imu = LockstepImu((1.0, 0.0, 0.0, 0.0))
        measured = self.world.reset(self.scenario()).imu
        imu.take(1.0, self.twin.felt(measured))
        return imu.latest().linear_acceleration

    def commission(self, path: Path) -> Commission:
        return Commission(CONFIG, WIRED, path, self.motors, self.force, self.do)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_truth_is_recovered_and_the_driver_reads_it(seed, tmp_path):
    operator = Operator(seed)
    found = operator.commission(tmp_path / "progress.json").run()
    build = operator.build
    assert np.array_equal(found.id, build.id)
    assert np.array_equal(found.bus, build.bus)
    assert np.array_equal(found.direction, build.direction)
    assert np.array(found.offset) == pytest.approx(build.offset, abs=2e-3)
    assert abs(float(np.array(found.mount) @ build.mount)) == pytest.approx(1.0, abs=1e-3)
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


def test_it_goes_on_where_it_stopped_and_a_step_can_be_done_again(tmp_path):
    path, operator = tmp_path / "progress.json", Operator(3)
    first = operator.commission(path)
    operator.clumsy = False
    limit = 9

    def tire(text: str) -> None:
        if len(operator.asked) >= limit:
            raise KeyboardInterrupt
        operator.do(text)

    first._ask = tire
    with pytest.raises(KeyboardInterrupt):
        first.run()
    assert sum(len(row) for row in first.progress.joints) == 4
    operator.asked.clear()
    second = operator.commission(path)
    assert second.run().robot == "stoch3"
    assert operator.asked[0].startswith("FR hip")
    second.undo("mount")
    operator.asked.clear()
    operator.commission(path).run()
    assert [text[:3] for text in operator.asked] == ["IMU"] * 3


def test_a_joint_that_did_not_move_is_asked_for_again(tmp_path):
    operator = Operator(4)
    operator.clumsy = True
    with pytest.raises(CommissionError, match="FL abduction: no motor turned"):
        operator.commission(tmp_path / "progress.json").run()


def test_the_progress_of_another_robot_is_refused(tmp_path):
    path, operator = tmp_path / "progress.json", Operator(5)
    path.write_text('{"robot": "spot"}')
    with pytest.raises(CommissionError, match="spot"):
        operator.commission(path)
