"""The pipeline of the paper's Fig. 3, whole: a measurement and a command in, a joint command out."""

from __future__ import annotations

import numpy as np

from drivers.description import RobotDescription
from drivers.robot import Array, JointCommand, Measurement
from runtime.control.command import follow
from runtime.control.compilation import compiled
from runtime.control.estimator import estimate, times
from runtime.control.gait import advance_gait
from runtime.control.grf import GrfProblem, accept, aim_wrench, build_qp, cut_forces, share_forces
from runtime.control.kinematics import GEOMETRY_DTYPE, leg_geometry
from runtime.control.observation import observe
from runtime.control.parameters import ControlConfig
from runtime.control.policy import Policy, act, mix_terms, policy_record
from runtime.control.records import CONTROL_DTYPE, Clamp, Records, SolverStatus, VelocityCommand
from runtime.control.solvers import Ladder, make_solver
from runtime.control.state import (
    PARAMETERS_DTYPE,
    POLICY_DTYPE,
    STATE_DTYPE,
    TUNING_SIZE,
    WORK_DTYPE,
    build_parameters,
)
from runtime.control.torque import command_joints, damp_joints
from runtime.control.trajectory import aim_feet

_CONTACT = int(Clamp.CONTACT)
IDLE, SOLVED, FAILED = int(SolverStatus.IDLE), int(SolverStatus.SOLVED), int(SolverStatus.FAILED)

CORE_DTYPE = np.dtype(
    [
        ("parameters", PARAMETERS_DTYPE),
        ("geometry", GEOMETRY_DTYPE),
        ("policy", POLICY_DTYPE),
        ("outgoing", POLICY_DTYPE),
        ("work", WORK_DTYPE),
    ],
    align=True,
)
CORE_SIZE = CORE_DTYPE.itemsize
"""All that compiled code reads and works on, in one piece; behind it in memory come the state and its last good copy.

A call hands them over as plain bytes and sees records again inside: numba recognises an array of bytes in 0.05 µs and
one of records in 0.25, at every call.
"""


@compiled
def sense(memory, record, orientation, rate, acceleration, position, velocity, torque):  # type: ignore[no-untyped-def]
    """The estimate alone. A measurement that is not finite leaves no trace in the state. Returns whether it is."""
    c, states, t = (
        memory[:CORE_SIZE].view(CORE_DTYPE)[0],
        memory[CORE_SIZE:].view(STATE_DTYPE),
        record.view(CONTROL_DTYPE)[0],
    )
    m = c.work
    m.imu[:4], m.imu[4:7], m.imu[7:] = orientation, rate, acceleration
    m.joints[0], m.joints[1], m.joints[2] = position, velocity, torque
    states[1] = states[0]
    estimate(c.parameters, c.geometry, states[0], t, m)
    finite = np.isfinite(t.height + t.rpy.sum() + t.twist.sum() + t.feet.sum() + t.contact_force.sum())
    if not finite:
        states[0] = states[1]
    return finite


@compiled
def plan(memory, record, linear, yaw_rate, standing):  # type: ignore[no-untyped-def]
    """From the estimate to the force problem. Returns its number of legs, -1 where a number is not finite."""
    c, s, t = (
        memory[:CORE_SIZE].view(CORE_DTYPE)[0],
        memory[CORE_SIZE:].view(STATE_DTYPE)[0],
        record.view(CONTROL_DTYPE)[0],
    )
    p, g, policy, m = c.parameters, c.geometry, c.policy, c.work
    t.clamps = _CONTACT if s.doubt.max() > 0.0 else 0
    if not np.isfinite(linear[0] + linear[1] + yaw_rate):
        return -1
    follow(p, policy, s, t, linear, yaw_rate, standing)
    observe(p, policy, s, t)
    if not act(p, policy, c.outgoing, s, t):
        return -1
    advance_gait(p, s, t, standing)
    aim_feet(p, g, policy, s, t)
    aim_wrench(p, policy, t)
    times(m.rotation, p.com, m.com)
    return build_qp(p, t, m.com, m.hessian, m.gradient)


@compiled
def sense_and_plan(  # type: ignore[no-untyped-def]
    memory, record, orientation, rate, acceleration, position, velocity, torque, linear, yaw_rate, standing
):
    """Both in one call: the way into compiled code is a good part of what each of them costs."""
    if not sense(memory, record, orientation, rate, acceleration, position, velocity, torque):
        record.view(CONTROL_DTYPE)[0].clamps = 0
        return -1
    return plan(memory, record, linear, yaw_rate, standing)


@compiled
def carry_out(memory, record, force, status, standing, out):  # type: ignore[no-untyped-def]
    """From the forces to the joint command, written into ``out`` (5, 4, 3).

    A tick that failed, or whose command is not finite, keeps nothing: the state is as before, the command only damps.
    """
    c, states, t = (
        memory[:CORE_SIZE].view(CORE_DTYPE)[0],
        memory[CORE_SIZE:].view(STATE_DTYPE),
        record.view(CONTROL_DTYPE)[0],
    )
    p, m = c.parameters, c.work
    if status != FAILED:
        if c.policy.direct:
            cut_forces(p, t)
        else:
            share_forces(p, t, force)
        command_joints(p, c.geometry, states[0], t, m, standing, out)
    if status == FAILED or not _finite(out):
        status = FAILED
        states[0] = states[1]
        damp_joints(p, t, out)
    t.solver_status = status


@compiled
def carry_out_accepted(memory, record, force, standing, out):  # type: ignore[no-untyped-def]
    """The same with the first solver's ``force`` (3n,), if it is accepted. Returns whether it is."""
    c = memory[:CORE_SIZE].view(CORE_DTYPE)[0]
    p, m, n = c.parameters, c.work, len(force)
    hessian = m.hessian[: n * n].reshape(n, n)
    if not accept(hessian, m.gradient[:n], p.friction, p.min_force, p.max_force, force):
        return False
    carry_out(memory, record, force, SOLVED, standing, out)
    return True


@compiled
def _finite(out):  # type: ignore[no-untyped-def]
    position, velocity, kp, kd, torque = 0.0, 0.0, 0.0, 0.0, 0.0  # five short chains instead of a long one
    for leg in range(4):
        for i in range(3):
            position += out[0, leg, i]
            velocity += out[1, leg, i]
            kp += out[2, leg, i]
            kd += out[3, leg, i]
            torque += out[4, leg, i]
    return np.isfinite(position + velocity + kp + kd + torque)


def alike(one: Policy, other: Policy) -> bool:
    """Whether two policies see and answer the same kind of thing, so that one can be blended into the other."""
    return one.reading == other.reading and one.output == other.output


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
        memory = np.zeros(CORE_SIZE + 2 * STATE_DTYPE.itemsize, np.uint8)
        core = memory[:CORE_SIZE].view(CORE_DTYPE)
        self.state = memory[CORE_SIZE:].view(STATE_DTYPE)[:1]
        self.parameters = core["parameters"]
        self.geometry = core["geometry"]
        self.policy_record = core["policy"]
        self.tuning = memory[CORE_DTYPE.fields["parameters"][1] :].view(np.float64)[:TUNING_SIZE]  # type: ignore[index]
        """The tunable parameters as one row of numbers, in force from the next step on. Shape (TUNING_SIZE,)."""
        self._outgoing_record = core["outgoing"]
        self._own_record = np.zeros(1, POLICY_DTYPE)
        self._memory = (memory, self.record.view(np.uint8))
        self.parameters[:] = build_parameters(description, config)
        self.geometry[:] = leg_geometry(description)
        self.ladder = Ladder(make_solver(config.grf.solver), make_solver(config.grf.second_solver))
        work = core["work"][0]
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
        self.tuning[0] = 1.0

    def hand_over(self, policy: Policy) -> None:
        """Take another policy with no share yet; what was active goes on as the outgoing one. ``share`` moves on.

        Raises:
            ValueError: the two differ in reading or output, so that there is nothing between them.
        """
        if not alike(self._policy, policy):
            raise ValueError(f"policies {self._policy.name} and {policy.name} differ in reading or output")
        self._outgoing_record[:] = policy_record(self._policy)
        self._policy = policy
        self._own_record[:] = policy_record(policy)
        self.policy_record[:] = self._own_record
        self.share = 0.0

    @property
    def share(self) -> float:
        """Of the active policy in what is asked for; below one while it is handed over to."""
        return float(self.tuning[0])

    @share.setter
    def share(self, share: float) -> None:
        self.tuning[0] = share
        mix_terms(self.policy_record, self._own_record, self._outgoing_record, share)

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

    def warm_up(self, measurement: Measurement) -> None:
        """Take every path of a step once, those of failure too, so that nothing compiles later; ends in a reset.

        ``measurement`` must come from the body that will be used: arrays of another layout in memory would be compiled
        for anew, which takes seconds.
        """
        self.reset(measurement)
        for standing in (False, True):
            self.step(measurement, VelocityCommand(), standing)
        for problem in self.problems[1:]:
            problem.hessian[...] = np.eye(len(problem.gradient))
            problem.gradient[...] = -problem.min_force
            self.ladder.warm_up(problem)
        carry_out(*self._memory, self._no_force, FAILED, False, np.empty((5, 4, 3)))  # in a walk: no stance, no force
        self.reset(measurement)

    def estimate(self, measurement: Measurement) -> None:
        """Keep the estimate warm in modes that do not step."""
        imu, joints = measurement.imu, measurement.joints
        sense(
            *self._memory,
            imu.orientation,
            imu.angular_velocity,
            imu.linear_acceleration,
            joints.position,
            joints.velocity,
            joints.torque,
        )

    def step(self, measurement: Measurement, command: VelocityCommand, standing: bool = False) -> JointCommand:
        """One tick. ``standing`` holds the velocity at zero and begins no new swing.

        The record's ``solver_status`` is ``FAILED`` where a number was not finite or no force could be found: the
        caller damps, the command returned does no more than that, and the next tick starts as if this had not been.
        """
        imu, joints = measurement.imu, measurement.joints
        legs = sense_and_plan(
            *self._memory,
            imu.orientation,
            imu.angular_velocity,
            imu.linear_acceleration,
            joints.position,
            joints.velocity,
            joints.torque,
            command.linear,
            command.yaw_rate,
            standing,
        )
        out = np.empty((5, 4, 3))
        if legs <= 0 or self._direct:
            carry_out(*self._memory, self._no_force, FAILED if legs < 0 else IDLE, standing, out)
        else:
            self._distribute(self.problems[legs], standing, out)
        return JointCommand(out[0], out[1], out[2], out[3], out[4])

    def _distribute(self, problem: GrfProblem, standing: bool, out: Array) -> None:
        force = self.ladder.ask_first(problem)
        if force is None or not carry_out_accepted(*self._memory, force, standing, out):
            force, status = self.ladder.fall_back(problem)
            carry_out(*self._memory, self._no_force if force is None else force, int(status), standing, out)
