"""The pipeline of the paper's Fig. 3, whole: a measurement and a command in, a joint command out."""

from __future__ import annotations

import numpy as np

from drivers.description import RobotDescription
from drivers.robot import Array, JointCommand, Measurement
from runtime.control.command import follow
from runtime.control.compilation import compiled
from runtime.control.estimator import estimate, times
from runtime.control.gait import advance_gait
from runtime.control.grf import GrfProblem, aim_wrench, build_qp, cut_forces, share_forces
from runtime.control.kinematics import GEOMETRY_DTYPE, leg_geometry
from runtime.control.observation import observe
from runtime.control.parameters import ControlConfig
from runtime.control.policy import Policy, act, policy_record
from runtime.control.records import CONTROL_DTYPE, Records, SolverStatus, VelocityCommand
from runtime.control.solvers import Ladder, make_solver
from runtime.control.state import PARAMETERS_DTYPE, POLICY_DTYPE, STATE_DTYPE, WORK_DTYPE, build_parameters
from runtime.control.torque import command_joints, damp_joints
from runtime.control.trajectory import aim_feet

IDLE, FAILED = int(SolverStatus.IDLE), int(SolverStatus.FAILED)

CORE_DTYPE = np.dtype(
    [
        ("parameters", PARAMETERS_DTYPE),
        ("geometry", GEOMETRY_DTYPE),
        ("policy", POLICY_DTYPE),
        ("work", WORK_DTYPE),
    ],
    align=True,
)
"""All that compiled code reads and works on, in one piece: every array more that a call hands over costs it time."""


@compiled
def sense(core, states, record):  # type: ignore[no-untyped-def]
    """The estimate alone. A measurement that is not finite leaves no trace in the state. Returns whether it is."""
    c, t = core[0], record[0]
    states[1] = states[0]
    estimate(c.parameters, c.geometry, states[0], t, c.work)
    finite = np.isfinite(t.height + t.rpy.sum() + t.twist.sum() + t.feet.sum())
    if not finite:
        states[0] = states[1]
    return finite


@compiled
def plan(core, states, record, standing):  # type: ignore[no-untyped-def]
    """From the measurement to the force problem. Returns its number of legs, -1 where a number is not finite."""
    c, s, t = core[0], states[0], record[0]
    p, g, policy, m = c.parameters, c.geometry, c.policy, c.work
    t.clamps = 0
    if not sense(core, states, record) or not np.isfinite(m.asked.sum()):
        return -1
    follow(p, policy, s, t, m.asked[:2], m.asked[2], standing)
    observe(p, policy, s, t)
    act(p, policy, s, t)
    advance_gait(p, s, t, standing)
    aim_feet(p, g, policy, s, t)
    aim_wrench(p, policy, t)
    times(m.rotation, p.com, m.com)
    return build_qp(p, t, m.com, m.hessian, m.gradient)


@compiled
def carry_out(core, states, record, force, status, standing, out):  # type: ignore[no-untyped-def]
    """From the forces to the joint command, written into ``out`` (5, 4, 3).

    A tick that failed, or whose command is not finite, keeps nothing: the state is as before, the command only damps.
    """
    c, s, t = core[0], states[0], record[0]
    p, m = c.parameters, c.work
    if status != FAILED:
        if c.policy.direct:
            cut_forces(p, t)
        else:
            share_forces(p, t, force)
        command_joints(p, c.geometry, s, t, m.rotation, m.jacobian, standing, out)
    if status == FAILED or not np.isfinite(out.sum()):
        status = FAILED
        states[0] = states[1]
        damp_joints(p, t, out)
    t.solver_status = status


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
        self._core = np.zeros(1, CORE_DTYPE)
        self._states = np.zeros(2, STATE_DTYPE)
        self.state = self._states[:1]
        self.parameters = self._core["parameters"]
        self.geometry = self._core["geometry"]
        self.policy_record = self._core["policy"]
        self.parameters[:] = build_parameters(description, config)
        self.geometry[:] = leg_geometry(description)
        self.ladder = Ladder(make_solver(config.grf.solver), make_solver(config.grf.second_solver))
        work = self._core["work"][0]
        imu = work["imu"]
        self._orientation, self._rate, self._acceleration = imu[:4], imu[4:7], imu[7:]
        self._position, self._velocity, self._torque = work["joints"]
        self._asked = work["asked"]
        hessian, gradient = work["hessian"], work["gradient"]
        grf = config.grf
        self.problems = [
            GrfProblem(hessian[: n * n].reshape(n, n), gradient[:n], grf.friction, grf.min_force, grf.max_force)
            for n in range(0, 13, 3)
        ]
        """The force problem of the last tick, by its number of legs: views of the core's memory."""
        self._no_force = np.zeros(0)
        self.policy = policy

    @property
    def policy(self) -> Policy:
        """The active policy; set it between two ticks."""
        return self._policy

    @policy.setter
    def policy(self, policy: Policy) -> None:
        self._policy = policy
        self._direct = policy.output == "grf"
        self.policy_record[:] = policy_record(policy)

    def reset(self, measurement: Measurement) -> None:
        """Forget everything and start from this measurement, all four feet on the ground, at rest."""
        self.state[:] = 0
        self.state["clock"] = 1.0 - 1e-9
        self.state["phase"] = np.pi
        self.state["stance"] = 1
        self.state["gain_scale"] = 1.0
        self.record["phase"] = np.pi
        self.record["stance"] = 1
        self.estimate(measurement)
        self.state["heading"] = self.record["rpy"][0, 2]
        self.state["foot_targets"] = self.record["feet"]
        self.state["joint_targets"] = measurement.joints.position

    def estimate(self, measurement: Measurement) -> None:
        """Keep the estimate warm in modes that do not step."""
        self._take(measurement)
        sense(self._core, self._states, self.record)

    def step(self, measurement: Measurement, command: VelocityCommand, standing: bool = False) -> JointCommand:
        """One tick. ``standing`` holds the velocity at zero and begins no new swing.

        The record's ``solver_status`` is ``FAILED`` where a number was not finite or no force could be found: the
        caller damps, the command returned does no more than that, and the next tick starts as if this had not been.
        """
        self._take(measurement)
        asked = self._asked
        asked[:2] = command.linear
        asked[2] = command.yaw_rate
        legs = plan(self._core, self._states, self.record, standing)
        force, status = self._distribute(legs)
        out = np.empty((5, 4, 3))
        carry_out(self._core, self._states, self.record, force, status, standing, out)
        return JointCommand(*out)

    def _take(self, measurement: Measurement) -> None:
        """Copy what was measured: compiled code that sees no memory but its own is never compiled anew."""
        imu, joints = measurement.imu, measurement.joints
        self._orientation[:] = imu.orientation
        self._rate[:] = imu.angular_velocity
        self._acceleration[:] = imu.linear_acceleration
        self._position[:] = joints.position
        self._velocity[:] = joints.velocity
        self._torque[:] = joints.torque

    def _distribute(self, legs: int) -> tuple[Array, int]:
        if legs < 0:
            return self._no_force, FAILED
        if legs == 0 or self._direct:
            return self._no_force, IDLE
        force, status = self.ladder.solve(self.problems[legs])
        return (self._no_force, FAILED) if force is None else (force, int(status))
