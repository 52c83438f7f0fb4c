"""The pipeline of the paper's Fig. 3, whole: a measurement and a command in, a joint command out."""

from __future__ import annotations

import numpy as np

from drivers.description import RobotDescription
from drivers.robot import JointCommand, Measurement
from runtime.control.command import follow
from runtime.control.compilation import compiled
from runtime.control.estimator import estimate, times
from runtime.control.gait import advance_gait
from runtime.control.grf import GrfProblem, aim_wrench, build_qp, cut_forces, share_forces
from runtime.control.kinematics import leg_geometry
from runtime.control.observation import observe
from runtime.control.parameters import ControlConfig
from runtime.control.policy import Policy, act, policy_record
from runtime.control.records import CONTROL_DTYPE, Records, SolverStatus, VelocityCommand
from runtime.control.solvers import Ladder, make_solver
from runtime.control.state import STATE_DTYPE, build_parameters
from runtime.control.torque import command_joints
from runtime.control.trajectory import aim_feet

SCRATCH_DTYPE = np.dtype(
    [
        ("imu", "f8", (10,)),
        ("joints", "f8", (3, 4, 3)),
        ("rotation", "f8", (3, 3)),  # body to heading frame
        ("jacobian", "f8", (4, 3, 3)),
        ("com", "f8", (3,)),  # heading frame
        ("hessian", "f8", (144,)),
        ("gradient", "f8", (12,)),
    ],
    align=True,
)


@compiled
def sense(parameters, geometry, state, record, scratch, orientation, rate, acceleration, position, velocity, torque):  # type: ignore[no-untyped-def]
    """The estimate alone."""
    p, g, s, t, m = parameters[0], geometry[0], state[0], record[0], scratch[0]
    m.imu[:4], m.imu[4:7], m.imu[7:] = orientation, rate, acceleration
    m.joints[0], m.joints[1], m.joints[2] = position, velocity, torque
    estimate(p, g, s, t, m.rotation, m.imu, m.joints, m.jacobian)


@compiled
def plan(parameters, geometry, policies, state, record, scratch, linear, yaw_rate, standing):  # type: ignore[no-untyped-def]
    """From the estimate to the force problem. Returns its number of legs, -1 where a number is not finite."""
    p, g, policy, s, t, m = parameters[0], geometry[0], policies[0], state[0], record[0], scratch[0]
    t.clamps = 0
    follow(p, policy, s, t, linear, yaw_rate, standing)
    observe(p, policy, s, t)
    act(p, policy, s, t)
    advance_gait(p, s, t, standing)
    aim_feet(p, g, policy, s, t)
    aim_wrench(p, policy, t)
    times(m.rotation, p.com, m.com)
    return build_qp(p, t, m.com, m.hessian, m.gradient)


@compiled
def carry_out(parameters, geometry, policies, state, record, scratch, force, standing, out):  # type: ignore[no-untyped-def]
    """From the forces to the joint command, written into ``out`` (5, 4, 3)."""
    p, g, s, t, m = parameters[0], geometry[0], state[0], record[0], scratch[0]
    if policies[0].direct:
        cut_forces(p, t)
    else:
        share_forces(p, t, force)
    command_joints(p, g, s, t, m.rotation, m.jacobian, standing, out)


class Controller:
    """Estimator → policy → trajectory generator → wrench distribution → joint command, once a tick.

    Pure: no clock, no input or output. All it remembers is one numpy record, all it computes another.
    """

    def __init__(
        self, description: RobotDescription, config: ControlConfig, policy: Policy, record: Records | None = None
    ) -> None:
        """Build for one robot; ``record`` (1,) of ``CONTROL_DTYPE`` is where results go (own memory if not given).

        Raises:
            ValueError: a solver's name that is not installed.
        """
        self.record = np.zeros(1, CONTROL_DTYPE) if record is None else record
        self.parameters = build_parameters(description, config)
        self.geometry = leg_geometry(description)
        self.state = np.zeros(1, STATE_DTYPE)
        self.ladder = Ladder(make_solver(config.grf.solver), make_solver(config.grf.second_solver))
        self._scratch = np.zeros(1, SCRATCH_DTYPE)
        hessian, gradient = self._scratch["hessian"][0], self._scratch["gradient"][0]
        grf = config.grf
        self._problems = [
            GrfProblem(hessian[: n * n].reshape(n, n), gradient[:n], grf.friction, grf.min_force, grf.max_force)
            for n in range(0, 13, 3)
        ]
        self._no_force = np.zeros(0)
        self.policy = policy

    @property
    def policy(self) -> Policy:
        """The active policy; set it between two ticks."""
        return self._policy

    @policy.setter
    def policy(self, policy: Policy) -> None:
        self._policy = policy
        self.policy_record = policy_record(policy)

    def reset(self, measurement: Measurement) -> None:
        """Forget everything and start from this measurement, all four feet on the ground, at rest."""
        self.state[:] = 0
        self.state["clock"] = 1.0 - 1e-9
        self.state["stance"] = 1
        self.state["gain_scale"] = 1.0
        self.record["phase"] = np.pi
        self.record["stance"] = 1
        self.estimate(measurement)
        self.state["foot_targets"] = self.record["feet"]
        self.state["joint_targets"] = measurement.joints.position

    def estimate(self, measurement: Measurement) -> None:
        """Keep the estimate warm in modes that do not step."""
        imu, joints = measurement.imu, measurement.joints
        sense(
            self.parameters,
            self.geometry,
            self.state,
            self.record,
            self._scratch,
            imu.orientation,
            imu.angular_velocity,
            imu.linear_acceleration,
            joints.position,
            joints.velocity,
            joints.torque,
        )

    def step(self, measurement: Measurement, command: VelocityCommand, standing: bool = False) -> JointCommand:
        """One tick. ``standing`` holds the velocity at zero and begins no new swing.

        The record's ``solver_status`` is ``FAILED`` where nothing finite could be found: the caller then damps.
        """
        self.estimate(measurement)
        legs = plan(
            self.parameters,
            self.geometry,
            self.policy_record,
            self.state,
            self.record,
            self._scratch,
            command.linear,
            command.yaw_rate,
            standing,
        )
        force, status = self._distribute(legs)
        self.record["solver_status"] = status
        out = np.empty((5, 4, 3))
        carry_out(
            self.parameters,
            self.geometry,
            self.policy_record,
            self.state,
            self.record,
            self._scratch,
            force,
            standing,
            out,
        )
        return JointCommand(out[0], out[1], out[2], out[3], out[4])

    def _distribute(self, legs: int) -> tuple[np.ndarray, SolverStatus]:
        if self._policy.output == "grf":
            return self._no_force, SolverStatus.IDLE
        if legs == 0:
            return self._no_force, SolverStatus.IDLE
        if legs < 0:
            return np.zeros(12), SolverStatus.FAILED
        force, status = self.ladder.solve(self._problems[legs])
        return (np.zeros(3 * legs) if force is None else force), status
