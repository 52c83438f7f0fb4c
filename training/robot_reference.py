"""The episode D recorded on the simulated robot: the teacher as a live controller, with real legs and real impacts."""

from __future__ import annotations

import numpy as np

from drivers.robot import Array
from runtime.config import Config
from sim.scenario import Scenario
from sim.world import World
from training.mpc_controller import MpcController
from training.provenance import config_hash
from training.randomize import Conditions
from training.reference import TICKS, Commands, Reference, ReferenceMismatch, make_reference, ramp
from training.reward import FEATURES, fill_features
from training.rigid_body import GRAVITY
from training.rollout import walk


def record_reference(config: Config, commands: Commands = ramp, ticks: int = TICKS) -> Reference:
    """Let the teacher walk the robot, without noise, for ``ticks`` ticks.

    Raises:
        ReferenceMismatch: it fell: nothing to imitate.
    """
    control, weight = config.control, config.robot.mass * GRAVITY
    asked = np.array([commands(tick / control.rate_hz) for tick in range(ticks)])
    features = np.empty((ticks, FEATURES))
    world = World(config.robot, control.rate_hz, control.gait.walking_height)
    teacher = MpcController(config)

    def watch(tick: int, _: Array) -> bool:
        truth = world.truth
        fill_features(
            truth.position, truth.linear_velocity, truth.rotation_body_to_world, truth.angular_velocity,
            teacher.record["grf"][0], weight, features[tick],
        )  # fmt: skip
        return True

    try:
        steps, fell = walk(world, teacher, Conditions(Scenario()), asked, watch)
    finally:
        world.close()
    if fell:
        raise ReferenceMismatch(f"the teacher fell after {steps} ticks: there is no walk to imitate")
    return Reference(config.robot.name, config_hash(config), "robot", control.rate_hz, features, asked)


def walked_by(source: str, config: Config) -> Reference:
    """The episode D of either teacher: ``rigid-body``, the MPC's own model, or ``robot``, the MPC on the robot.

    Raises:
        ReferenceMismatch: another name, or a teacher that fell.
    """
    if source == "rigid-body":
        return make_reference(config)
    if source == "robot":
        return record_reference(config)
    raise ReferenceMismatch(f"no teacher {source!r}: rigid-body or robot")
