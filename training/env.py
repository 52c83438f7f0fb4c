"""The same episode as a Gymnasium environment: the action is what a policy of this shape would put out.

Estimator, gait, feet, wrench distribution and motor level stay the runtime's own; only M s is replaced by the agent's
action, in scaled units, at the very tick whose observation it answers.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from drivers.robot import Array
from runtime.config import Config
from runtime.control.controller import Controller
from runtime.control.policy import set_parameters
from runtime.control.records import SolverStatus, VelocityCommand
from sim.world import World
from training.plan import PHYSICS_RATE_HZ
from training.randomize import TASK, Randomization, draw
from training.reward import TASK_TERMS, TaskReward, named
from training.rollout import LOWEST, standing_command
from training.score import score_task
from training.variants import Variant, make_policy

Observation = NDArray[np.float32]
LIMIT = 50.0
"""Bound of every scaled observation: beyond it the robot has long fallen."""


class WalkEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """Follow a velocity command through pushes, noise and slippery ground."""

    metadata = {"render_modes": []}  # noqa: RUF012  (Gymnasium's own form)

    def __init__(
        self,
        config: Config,
        bounds: Randomization = TASK,
        ticks: int = 520,
        reward: TaskReward | None = None,
        terms: bool = True,
        physics_rate_hz: float = PHYSICS_RATE_HZ,
    ) -> None:
        """Build one robot in its own simulator.

        Args:
            config: the robot.
            bounds: what each episode's conditions are drawn from; must draw a command.
            ticks: after which an episode is truncated.
            reward: weights of the task's terms.
            terms: whether the fixed terms act around the action.
            physics_rate_hz: of the simulator.
        """
        control = config.control
        height = control.gait.walking_height
        self._world = World(config.robot, control.rate_hz, height, physics_rate_hz)
        self._controller = Controller(config.robot, control, make_policy(config.robot, height, Variant(), terms))
        self._bounds, self._ticks, self._height = bounds, ticks, height
        self._table = (reward or TaskReward()).table()
        self.observation_space = spaces.Box(-LIMIT, LIMIT, (28,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (18,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Draw conditions and stand; ``options["command"]`` (vx, vy, yaw rate) replaces the drawn command."""
        super().reset(seed=seed)
        conditions = draw(self._bounds, self.np_random)
        asked = (options or {}).get("command", conditions.command or (0.0, 0.0, 0.0))
        self._asked: Array = np.array(asked, dtype=np.float64)
        self._command = VelocityCommand(linear=self._asked[:2], yaw_rate=float(self._asked[2]))
        self._ground, self._standing = conditions.scenario.terrain, conditions.standing
        self._smoothed, self._tick = np.zeros(3), 0
        measurement = self._world.reset(conditions.scenario)
        self._controller.reset(measurement)
        self._measurement = self._world.step(standing_command(measurement, self._world))
        return self._look(), {"command": tuple(self._asked)}

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Answer the last observation with ``action`` (18,) in scaled units, and live for one tick."""
        controller = self._controller
        self._answer(np.asarray(action, dtype=np.float64))
        command = controller.step(self._measurement, self._command, self._standing)
        failed = controller.record["solver_status"][0] == SolverStatus.FAILED
        self._measurement = self._world.step(command)
        terms, upright = self._score()
        self._tick += 1
        terminated = bool(failed or not upright or self._world.fallen())
        return self._look(), float(terms.sum()), terminated, self._tick >= self._ticks, named(TASK_TERMS, terms)

    def close(self) -> None:
        """Release the simulator."""
        self._world.close()

    def _look(self) -> Observation:
        """What the policy will see of the last measurement; the controller is as before."""
        state, record = self._controller.state, self._controller.record
        kept = state.copy(), record.copy()
        self._controller.step(self._measurement, self._command, self._standing)
        self._seen: Array = record["observation"][0].copy()
        state[:], record[:] = kept
        return np.asarray(np.clip(self._seen, -LIMIT, LIMIT), dtype=np.float32)

    def _answer(self, action: Array) -> None:
        """Choose the matrix that maps what was seen to ``action``: a sᵀ / (sᵀ s)."""
        square = float(self._seen @ self._seen)
        matrix = np.outer(action, self._seen) / square if square > 1e-12 else np.zeros((18, 28))
        set_parameters(self._controller.policy_record, self._controller.policy, matrix.ravel())

    def _score(self) -> tuple[Array, bool]:
        x, y, z = self._world.body[:3].tolist()
        above = z - self._ground.height_at(x, y)
        terms = np.zeros(len(TASK_TERMS))
        score_task(
            self._table, self._world.period, self._smoothed, self._asked, above - self._height, self._world.body,
            self._world.joints, self._world.foot_contacts, self._controller.geometry, terms,
        )  # fmt: skip
        return terms, above > LOWEST * self._height
