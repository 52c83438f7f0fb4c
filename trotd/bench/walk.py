"""A walk to measure on: what the sensors told of one robot walking in the simulator, tick by tick."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.robot import Measurement
from runtime import config
from runtime.config import Config
from runtime.control.controller import Controller
from runtime.control.policy import Policy
from runtime.control.records import VelocityCommand
from runtime.policies import find_policy, load


@dataclass(frozen=True, slots=True)
class Walked:
    """One robot, its policy and the measurements of its walk."""

    config: Config
    policy: Policy
    measurements: list[Measurement]
    command: VelocityCommand

    def controller(self) -> Controller:
        """A new one, at the walk's beginning."""
        made = Controller(self.config.robot, self.config.control, self.policy)
        made.warm_up(self.measurements[0])
        return made


def record_walk(ticks: int = 600, robot: str = "stoch3") -> Walked:
    """Walk an arc with sensor noise.

    Raises:
        SimulatorMissing: PyBullet is not here.
    """
    from sim.scenario import Noise, Scenario
    from sim.world import World

    path = config.find_robot(robot)
    known = config.load(path)
    policy = load(find_policy(known.control.policy, path.parent), known.robot.name)
    noise = Noise(joint_position=1e-3, joint_velocity=0.1, joint_torque=0.3, linear_acceleration=0.2)
    world = World(known.robot, known.control.rate_hz, known.control.gait.walking_height)
    measured = world.reset(Scenario(noise=noise))
    command = VelocityCommand(0.0, np.array([0.4, 0.1]), 0.3)
    walked = Walked(known, policy, [measured], command)
    controller = walked.controller()
    for _ in range(ticks - 1):
        measured = world.step(controller.step(measured, command))
        walked.measurements.append(measured)
    world.close()
    return walked
