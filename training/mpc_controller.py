"""The teacher as a live controller: the same estimator, gait, feet and motor level; forces from the MPC.

It stands beside any policy in every test (``--controller mpc``), walks the reference when that is recorded on the
robot, and with the fixed terms on (``mpc-tuned``) it is the honest opponent.
"""

from __future__ import annotations

import numpy as np

from drivers.robot import Array, JointCommand, Measurement
from runtime.config import Config
from runtime.control.command import wrapped
from runtime.control.compilation import compiled
from runtime.control.controller import Controller
from runtime.control.kinematics import jacobian_of_leg
from runtime.control.records import Records, SolverStatus, VelocityCommand
from runtime.control.state import stand_angles
from training.contact_plan import plan_contacts, plan_path
from training.mpc import HORIZON, Horizon, MpcConfig, MpcError, solve_mpc
from training.reference import SOLVE_EVERY
from training.rigid_body import STATES, P, R, V, W, rigid_body, rotation_from_rpy
from training.variants import Variant, make_policy

LEASH = 0.1
"""How far the wanted position may lead or trail the body, m: a push is not run after for ever."""


class MpcController:
    """``Controller`` with a policy of zeros, whose forces are then the teacher's."""

    def __init__(self, config: Config, mpc: MpcConfig | None = None, terms: bool = False) -> None:
        """Build for one robot; ``terms`` turns on the fixed terms that the policy has (method: Past the teacher)."""
        control = config.control
        height = control.gait.walking_height
        policy = make_policy(config.robot, height, Variant(), terms, "mpc-tuned" if terms else "mpc")
        self._core = Controller(config.robot, control, policy)
        self._body = rigid_body(config.robot, stand_angles(config.robot, height))
        self._mpc = mpc or MpcConfig(
            friction=control.grf.friction, min_force=control.grf.min_force, max_force=control.grf.max_force
        )
        self._height, self._radius = height, config.robot.foot_radius
        self._dt = 1.0 / control.rate_hz
        self._every = max(1, round(SOLVE_EVERY * control.rate_hz))
        self._tick = 0
        self._stance = np.ones(4, dtype=np.bool_)
        self._forces = np.zeros((4, 3))
        self._wanted = np.zeros(2)

    @property
    def record(self) -> Records:
        """What the last step computed, (1,) of ``CONTROL_DTYPE``, with the teacher's forces in it."""
        return self._core.record

    @property
    def geometry(self) -> Records:
        """The legs' geometry, (1,)."""
        return self._core.geometry

    def reset(self, measurement: Measurement) -> None:
        """Forget everything and start from this measurement."""
        self._core.reset(measurement)
        self._forget()

    def step(self, measurement: Measurement, command: VelocityCommand, standing: bool = False) -> JointCommand:
        """One tick. ``solver_status`` is ``FAILED`` where the teacher has no answer."""
        asked = self._core.step(measurement, command, standing)
        t = self.record[0]
        self._follow(t["velocity_command"], float(t["rpy"][2]))
        stance = t["stance"].astype(np.bool_)
        if self._tick % self._every == 0 or (stance != self._stance).any():
            try:
                self._forces = solve_mpc(self._look_ahead(stance, standing), self._body, self._mpc)[0]
            except MpcError:
                t["solver_status"] = SolverStatus.FAILED
        self._tick += 1
        self._stance = stance
        forces = np.where(stance[:, None], self._forces, 0.0)
        t["grf"] = forces
        put_forces(self._core.geometry, measurement.joints.position, t["rpy"], forces, asked.torque)
        t["command_torque"] = asked.torque
        return asked

    def _forget(self) -> None:
        self._tick = 0
        self._stance = np.ones(4, dtype=np.bool_)
        self._forces = np.zeros((4, 3))
        self._wanted = np.zeros(2)

    def _follow(self, command: Array, yaw: float) -> None:
        """Move the wanted position with the command, on a leash about the dead-reckoned one, world frame."""
        c, s = np.cos(yaw), np.sin(yaw)
        self._wanted += self._dt * np.array([c * command[0] - s * command[1], s * command[0] + c * command[1]])
        here = self.record[0]["position"][:2]
        ahead = self._wanted - here
        self._wanted = here + ahead * min(1.0, LEASH / max(float(np.hypot(*ahead)), 1e-9))

    def _look_ahead(self, stance_now: Array, standing: bool) -> Horizon:
        """The problem in the heading frame of this moment, its origin on the ground under the body.

        Who stands keeps on the ground what stands there.
        """
        t, s, p = self.record[0], self._core.state[0], self._core.parameters[0]
        yaw = float(t["rpy"][2])
        state = centre_state(t["rpy"], t["height"], t["twist"], self._body.com)
        c, si = np.cos(yaw), np.sin(yaw)
        dx, dy = self._wanted - t["position"][:2]
        wanted = np.array([c * dx + si * dy, -si * dx + c * dy, self._height])
        commands = np.tile(t["velocity_command"], (HORIZON, 1))
        path, expected = np.empty((HORIZON, STATES)), np.empty((HORIZON, 3))
        feet, stance = np.empty((HORIZON, 4, 3)), np.empty((HORIZON, 4), dtype=np.bool_)
        plan_path(wanted, wrapped(s["heading"] - yaw), commands, self._body.com, self._mpc.dt, path, state, expected)
        feet_now = t["feet"] + [0.0, 0.0, float(t["height"]) - self._radius]
        plan_contacts(
            p, float(s["clock"]), stance_now, feet_now, t["touchdown"], np.zeros(3), 0.0, commands[0], self._mpc.dt,
            feet, stance,
        )  # fmt: skip
        if standing:
            feet[:], stance[:] = feet_now, stance_now
        return Horizon(state, path, expected, feet, stance)


def centre_state(rpy: Array, height: float, twist: Array, com: Array) -> Array:
    """The rigid body's state (12,) from an estimate of the body origin, in its heading frame."""
    rotation = np.empty((3, 3))
    level = np.array([rpy[0], rpy[1], 0.0])
    rotation_from_rpy(level, rotation)
    arm = rotation @ com
    state = np.empty(STATES)
    state[P:V] = arm
    state[P + 2] += height
    state[V:R] = twist[:3] + np.cross(twist[3:], arm)
    state[R:W] = level
    state[W:] = twist[3:]
    return state


@compiled
def put_forces(geometry, q, rpy, forces, torque):  # type: ignore[no-untyped-def]
    """Feed-forward -Jᵀ f (4, 3) N·m of forces in the heading frame into ``torque``. Paper Eq. 6."""
    rotation, jacobian = np.empty((3, 3)), np.empty((3, 3))
    rotation_from_rpy(np.array([rpy[0], rpy[1], 0.0]), rotation)
    for leg in range(4):
        jacobian_of_leg(geometry[0], leg, q[leg], jacobian)
        torque[leg] = -(jacobian.T @ (rotation.T @ forces[leg]))
