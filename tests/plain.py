"""The whole control pipeline in plain numpy, written from the method and for reading: what the core must equal.

Slow on purpose: matrices instead of loops by hand, a new array for every value, no shared memory. ``PlainController``
answers as ``runtime.control.controller.Controller`` does; ``record`` holds every field of ``CONTROL_DTYPE`` by name.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from drivers.description import END, SIDE, RobotDescription, composite_inertia
from drivers.robot import Array, JointCommand, Measurement
from runtime.control.gait import gait_table
from runtime.control.grf import GrfProblem
from runtime.control.parameters import ControlConfig
from runtime.control.policy import Policy
from runtime.control.records import Clamp, SolverStatus, VelocityCommand
from runtime.control.solvers import DaqpSolver

GRAVITY = 9.81


def about_x(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def about_y(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def about_z(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def skew(v: Array) -> Array:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


class Leg:
    """Geometry of one serial 3R leg, by chains of rotations."""

    def __init__(self, description: RobotDescription, leg: int) -> None:
        self.body = description
        self.hip = description.hips[leg]
        self.side = SIDE[leg]
        self.mirror = np.array([1.0, SIDE[leg], 1.0])
        self.end = np.array([END[leg], 1.0, 1.0])

    def points(self, q: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Hip joint, knee, foot; and the rotations of abduction link and thigh."""
        first = about_x(q[0])
        second = first @ about_y(q[1])
        third = first @ about_y(q[1] + q[2])
        hip = self.hip + first @ [0, self.side * self.body.abduction_length, 0]
        knee = hip - second @ [0, 0, self.body.thigh_length]
        foot = knee - third @ [0, 0, self.body.shank_length]
        return hip, knee, foot, first, second

    def foot(self, q: Array) -> Array:
        return self.points(q)[2]

    def columns(self, q: Array, point: Array, joints: int) -> Array:
        """Jacobian of a body point carried by the first ``joints`` joints: axis × arm, column by column."""
        hip, knee, _, first, _ = self.points(q)
        axes = ([1.0, 0.0, 0.0], first[:, 1], first[:, 1])
        columns = [np.cross(axis, point - origin) for axis, origin in zip(axes, (self.hip, hip, knee), strict=True)]
        return np.array([column if i < joints else np.zeros(3) for i, column in enumerate(columns)]).T

    def jacobian(self, q: Array) -> Array:
        return self.columns(q, self.foot(q), 3)

    def gravity(self, q: Array, up: Array) -> Array:
        """Torque against the weight of the three links: Σ m g Jᵀ up."""
        hip, knee, _, first, second = self.points(q)
        third = first @ about_y(q[1] + q[2])
        links = self.body.links
        parts = (
            (links.abduction, self.hip + first @ (self.mirror * self.end * links.abduction.com), 1),
            (links.thigh, hip + second @ (self.mirror * links.thigh.com), 2),
            (links.shank, knee + third @ (self.mirror * links.shank.com), 3),
        )
        return sum(link.mass * GRAVITY * (self.columns(q, com, joints).T @ up) for link, com, joints in parts)

    def angles(self, foot: Array) -> tuple[Array, bool]:
        """Inverse kinematics on the stand branch by the law of cosines."""
        l1, l2, l3 = self.side * self.body.abduction_length, self.body.thigh_length, self.body.shank_length
        x, y, z = foot - self.hip
        square = y * y + z * z - l1 * l1
        reached = square > 1e-8
        c = np.sqrt(square) if reached else 1e-4
        abduction = wrapped(np.arctan2(z, y) - np.arctan2(-c, l1))
        length = np.hypot(x, c)
        bounded = np.clip(length, abs(l2 - l3) + 0.002 * (l2 + l3), 0.998 * (l2 + l3))
        if bounded != length:
            reached, x, c, length = False, x * bounded / length, c * bounded / length, bounded
        knee = -np.arccos(np.clip((length**2 - l2**2 - l3**2) / (2 * l2 * l3), -1, 1))
        hip = np.arctan2(-x, c) - np.arctan2(l3 * np.sin(knee), l2 + l3 * np.cos(knee))
        return np.array([abduction, hip, knee]), bool(reached)


class PlainController:
    """``Controller``, plainly."""

    def __init__(self, description: RobotDescription, config: ControlConfig, policy: Policy) -> None:
        self.body, self.config, self.policy = description, config, policy
        self.legs = [Leg(description, leg) for leg in range(4)]
        self.dt = 1.0 / config.rate_hz
        stand = description.hips + np.outer(SIDE, [0, description.abduction_length, 0])
        stand[:, 2] = description.foot_radius - config.gait.walking_height
        pose = np.array([leg.angles(foot)[0] for leg, foot in zip(self.legs, stand, strict=True)])
        self.com, _ = composite_inertia(description, pose)
        self.nominal = stand[:, :2] + self.com[:2]
        self.solver = DaqpSolver()
        self.record: dict[str, Any] = {}

    # --- life ---------------------------------------------------------------------------------------------------------

    def reset(self, measurement: Measurement) -> None:
        zero = np.zeros
        self.contacts, self.swinging, self.searching = zero(4, bool), zero(4, bool), zero(4, bool)
        self.pressure, self.lifted, self.x = zero(4), zero(4, bool), zero((5, 3))
        self.stance, self.phase, self.clock = np.ones(4, bool), np.full(4, np.pi), 1.0 - 1e-9
        self.started, self.first_height = False, True
        self.position, self.slope, self.rested = zero(3), zero(2), zero(4)
        self.met_ground = zero(4, bool)
        self.followed, self.integral, self.walked, self.heading = zero(3), zero(2), 0.0, 0.0
        self.previous: Array | None = None
        self.shifts, self.depth, self.gain = zero(12), zero(4), np.ones(4)
        self.commanded = False
        self.clamps = Clamp(0)
        self.estimate(measurement)
        self.heading = self.record["rpy"][2]
        self.foot_targets = self.record["feet"].copy()
        self.joint_targets = measurement.joints.position.copy()

    def step(self, measurement: Measurement, command: VelocityCommand, standing: bool = False) -> JointCommand:
        self.clamps = Clamp(0)
        self.estimate(measurement)
        self.follow(command, standing)
        self.observe()
        direct = self.act()
        self.advance_gait(standing)
        self.aim_feet()
        grf, status = self.distribute(direct)
        result = self.command_joints(grf, standing)
        self.record.update(clamps=int(self.clamps), solver_status=int(status))
        return result

    # --- estimator ----------------------------------------------------------------------------------------------------

    def estimate(self, measurement: Measurement) -> None:
        imu, joints, dt, noise = measurement.imu, measurement.joints, self.dt, self.config.estimator
        w, v = imu.orientation[0], imu.orientation[1:]
        norm = imu.orientation @ imu.orientation
        self.to_world = np.eye(3) + 2.0 / norm * (w * skew(v) + skew(v) @ skew(v))
        up = self.to_world[2]
        yaw = np.arctan2(self.to_world[1, 0], self.to_world[0, 0])
        rpy = np.array([np.arctan2(up[1], up[2]), -np.arcsin(np.clip(up[0], -1, 1)), yaw])
        self.rotation = about_z(yaw).T @ self.to_world
        q, rate = joints.position, imu.angular_velocity
        feet = np.array([leg.foot(angles) for leg, angles in zip(self.legs, q, strict=True)])
        self.jacobians = np.array([leg.jacobian(angles) for leg, angles in zip(self.legs, q, strict=True)])
        gravity = np.array([leg.gravity(angles, up) for leg, angles in zip(self.legs, q, strict=True)])
        force = np.array(
            [
                -np.linalg.solve(jacobian.T, torque - weight) if abs(np.linalg.det(jacobian)) >= 1e-5 else np.zeros(3)
                for jacobian, torque, weight in zip(self.jacobians, joints.torque, gravity, strict=True)
            ]
        )
        self.record["contact_force"] = force @ self.rotation.T
        in_world = feet @ self.to_world.T
        odometry, rolling = self.leg_odometry(q, joints.velocity, rate, feet)
        self.feel_contacts(self.record["contact_force"][:, 2] - self.config.contact.baseline, odometry)
        if not self.started:
            self.x = np.vstack([np.zeros(3), in_world])  # rows: velocity, then the four feet; columns: world axes
            self.covariance = np.diag([0.1] + [noise.foot_position_noise**2] * 4)
            self.height = self.config.gait.walking_height
            self.rested = np.full(4, noise.settling_time)
            self.footholds = self.position + in_world
            self.started = True
        model = np.eye(5)
        model[1:, 0] = -dt
        self.x = model @ self.x + dt * np.vstack([self.to_world @ imu.linear_acceleration - [0, 0, GRAVITY], rolling])
        process = np.diag([(noise.acceleration_noise * dt) ** 2] + [noise.slip_noise**2 * dt] * 4)
        self.covariance = model @ self.covariance @ model.T + process
        for leg in range(4):
            self.rested[leg] = self.rested[leg] + dt if self.contacts[leg] else 0.0
            if self.rested[leg] > noise.settling_time:
                self.correct(leg + 1, in_world[leg], noise.foot_position_noise)
                self.correct(0, odometry[leg], noise.foot_velocity_noise)
            else:
                self.x[leg + 1] = in_world[leg]
                self.covariance[leg + 1, :] = self.covariance[:, leg + 1] = 0.0
                self.covariance[leg + 1, leg + 1] = noise.foot_position_noise**2
        velocity = self.x[0]
        self.measure_height()
        self.fit_slope(yaw)
        self.position = self.position + velocity * dt
        self.record.update(
            height=self.height,
            rpy=rpy,
            twist=np.concatenate([about_z(yaw).T @ velocity, self.rotation @ rate]),
            contacts=self.contacts.astype(float),
            feet=feet @ self.rotation.T,
            position=self.position,
            slope=self.slope,
        )

    def feel_contacts(self, force: Array, odometry: Array) -> None:
        contact = self.config.contact
        follow = self.dt / (self.dt + contact.force_time_constant) if self.started else 1.0
        self.pressure = self.pressure + (force - self.pressure) * follow
        blind = self.swinging & (self.phase < contact.blanking * np.pi)
        begins = (np.minimum(force, self.pressure) > contact.threshold) & ~blind
        felt = np.where(self.contacts, force > contact.release * contact.threshold, begins)
        moving = np.linalg.norm(odometry - self.x[0], axis=1) > contact.lift_speed
        self.lifted = moving & (felt & ~moving).any()
        self.contacts = felt & ~self.lifted

    def leg_odometry(self, q: Array, speed: Array, rate: Array, feet: Array) -> tuple[Array, Array]:
        """Velocity of the body that each rolling foot tells, and that of the rolling foot's centre; world. (4, 3)."""
        odometry, rolling = np.empty((4, 3)), np.empty((4, 3))
        for leg in range(4):
            relative = self.to_world @ (self.jacobians[leg] @ speed[leg] + np.cross(rate, feet[leg]))
            axis = about_x(q[leg, 0])[:, 1]
            turning = self.to_world @ (rate + [speed[leg, 0], 0, 0] + (speed[leg, 1] + speed[leg, 2]) * axis)
            rolling[leg] = np.cross(turning, [0, 0, self.body.foot_radius])
            odometry[leg] = rolling[leg] - relative
        return odometry, rolling

    def correct(self, row: int, measured: Array, noise: float) -> None:
        gain = self.covariance[:, row] / (self.covariance[row, row] + noise**2)
        self.x = self.x + np.outer(gain, measured - self.x[row])
        self.covariance = self.covariance - np.outer(gain, self.covariance[row])

    def measure_height(self) -> None:
        self.height += self.x[0, 2] * self.dt
        if self.contacts.any():
            measured = float(np.mean(self.body.foot_radius - self.x[1:][self.contacts, 2]))
            if self.first_height:
                self.height, self.first_height = measured, False
            self.height += (measured - self.height) * self.dt / (self.dt + self.config.estimator.height_time_constant)

    def fit_slope(self, yaw: float) -> None:
        resting = self.rested > self.config.estimator.settling_time
        self.footholds = np.where(resting[:, None], self.position + self.x[1:], self.footholds)
        spread = (self.footholds - self.footholds.mean(axis=0)) @ about_z(yaw)
        moments = spread[:, :2].T @ spread[:, :2]
        self.met_ground |= resting
        if self.met_ground.all() and np.linalg.det(moments) > 0.01 * np.trace(moments) ** 2:
            raw = np.clip(np.linalg.solve(moments, spread[:, :2].T @ spread[:, 2]), -0.4, 0.4)
            follow = self.dt / (self.dt + self.config.estimator.slope_time_constant)
            self.slope = self.slope + (raw - self.slope) * follow

    # --- command, observation, policy ---------------------------------------------------------------------------------

    def follow(self, command: VelocityCommand, standing: bool) -> None:
        bounds, terms, r = self.config.bounds, self.policy.terms, self.record
        limit = np.array([*bounds.linear_velocity, bounds.yaw_rate])
        asked = np.array([*command.linear, command.yaw_rate])
        bounded = np.clip(asked, -limit, limit)
        if (bounded != asked).any():
            self.clamps |= Clamp.COMMAND
        step = self.dt * np.array([bounds.linear_acceleration, bounds.linear_acceleration, bounds.yaw_acceleration])
        self.followed = self.followed + np.clip((0 if standing else 1) * bounded - self.followed, -step, step)
        self.walked = 0.0 if standing else self.walked + self.dt
        error = self.followed[:2] - r["twist"][:2]
        if standing:
            self.integral = np.zeros(2)
        elif self.walked > terms.integral_delay and np.hypot(*error) < terms.integral_freeze:
            grown = self.integral + terms.velocity_integral * error * self.dt
            self.integral = np.clip(grown, -terms.integral_bound, terms.integral_bound)
        r["velocity_command"] = self.followed + np.array([*self.integral, 0])
        self.heading += self.followed[2] * self.dt
        lag = wrapped(r["rpy"][2] - self.heading)
        if standing and self.previous is None:
            lag = 0.0
        self.heading = wrapped(r["rpy"][2] - np.clip(lag, -0.5, 0.5))

    def observe(self) -> None:
        r, terms = self.record, self.policy.terms
        now = np.concatenate([[r["height"]], r["rpy"], r["twist"], r["contacts"]])
        if self.policy.reading == "relative":
            now[0] -= self.config.gait.walking_height
            now[1:3] += terms.slope_body * np.arctan(r["slope"])[::-1] * [-1, 1]
            now[3] = wrapped(now[3] - self.heading)
            error = now[4:6] - r["velocity_command"][:2]
            bound = terms.velocity_error_bound or np.inf
            now[4:6] = np.clip(error, -bound, bound)
            if (now[4:6] != error).any():
                self.clamps |= Clamp.OBSERVATION
            now[9] -= self.followed[2]
        before = now if self.previous is None else self.previous
        self.previous = now
        offset = np.array(self.policy.observation_offset or (0.0,) * 28)
        r["observation"] = (np.concatenate([now, before]) - offset) * self.policy.observation_scale

    def act(self) -> Array | None:
        """Fill ``asked`` and ``action``; the forces of a direct policy are returned."""
        r, policy, bounds = self.record, self.policy, self.config.bounds
        if policy.matrix:
            raw = np.array(policy.matrix) @ r["observation"]
        else:
            raw = np.array(policy.readout) @ np.tanh(np.array(policy.hidden) @ r["observation"])
        raw = raw * policy.action_scale
        limit = np.array(policy.action_bound)
        shifts = raw[:12].reshape(4, 3)
        shifts[:, :2] += policy.terms.capture_point * (r["twist"][:2] - r["velocity_command"][:2])
        smooth = self.shifts + (shifts.ravel() - self.shifts) * self.dt / (self.dt + policy.shift_time_constant)
        self.shifts = np.clip(smooth, -np.minimum(limit[:12], bounds.shift), np.minimum(limit[:12], bounds.shift))
        if (self.shifts != smooth).any():
            self.clamps |= Clamp.SHIFT
        wrench_limit = np.array([*bounds.force, *bounds.moment])
        direct = policy.output == "grf"
        forces = np.clip(raw[12:], -limit[12:], limit[12:])
        if not direct:
            forces = np.clip(forces, -wrench_limit, wrench_limit)
        if (forces != raw[12:]).any():
            self.clamps |= Clamp.WRENCH
        r["asked"] = np.concatenate([shifts.ravel(), np.zeros(6) if direct else raw[12:]])
        r["action"] = np.concatenate([self.shifts, np.zeros(6) if direct else forces])
        return forces.reshape(4, 3) if direct else None

    # --- gait, trajectory ---------------------------------------------------------------------------------------------

    def advance_gait(self, standing: bool) -> None:
        offsets, swing_time, stance_time = gait_table(self.config.gait)
        fraction = 0.0 if self.config.gait.name == "stand" else swing_time / (swing_time + stance_time)
        before, self.clock = self.clock, (self.clock + self.dt / (swing_time + stance_time)) % 1.0
        self.phase = np.full(4, np.pi)
        for leg in range(4):
            share = (self.clock + offsets[leg]) % 1.0
            inside, begins = share < fraction, share < (before + offsets[leg]) % 1.0
            progress = np.pi * share / fraction if inside else np.pi
            if self.swinging[leg]:
                self.phase[leg] = progress
                early = self.config.gait.early_contact and self.contacts[leg] and progress > np.pi / 2
                if early or not inside:
                    self.swinging[leg], self.searching[leg] = False, not self.contacts[leg]
            elif inside and begins and not standing:
                self.phase[leg], self.swinging[leg], self.searching[leg] = progress, True, False
            elif self.contacts[leg]:
                self.searching[leg] = False
            elif self.lifted[leg]:
                self.searching[leg] = True
        if standing and not self.swinging.any():
            self.clock = 1.0 - 1e-9
        self.was, self.stance = self.stance, ~(self.swinging | self.searching)
        self.record.update(phase=self.phase, stance=self.stance.astype(float))

    def aim_feet(self) -> None:
        r, gait, dt = self.record, self.config.gait, self.dt
        _, swing_time, stance_time = gait_table(gait)
        linear, turn = r["velocity_command"][:2], r["velocity_command"][2]
        ground = self.body.foot_radius - gait.walking_height
        shifts = r["action"][:12].reshape(4, 3)

        def velocity_at(point: Array) -> Array:
            return linear + turn * np.array([-point[1], point[0]])

        touchdown = np.empty((4, 2))
        targets = np.empty((4, 3))
        for leg in range(4):
            touchdown[leg] = self.nominal[leg] + 0.5 * stance_time * velocity_at(self.nominal[leg]) + shifts[leg, :2]
            if self.was[leg] != self.stance[leg]:
                self.foot_targets[leg] = r["feet"][leg]
            xy = self.foot_targets[leg, :2]
            if self.swinging[leg]:
                left = max(dt, swing_time * (1 - self.phase[leg] / np.pi))
                xy = xy + (touchdown[leg] - xy) * dt / left
                z = ground + (gait.swing_height + self.policy.terms.swing_lift) * np.sin(self.phase[leg])
            else:
                xy = xy - velocity_at(xy) * dt
                deeper = min(gait.search_depth, self.depth[leg] + gait.search_speed * dt)
                self.depth[leg] = deeper if self.searching[leg] else 0.0
                z = ground - self.depth[leg]
            self.foot_targets[leg] = [*xy, z]
            rise = self.policy.terms.slope_feet * (r["slope"] @ xy)
            targets[leg] = [*xy, z + rise + shifts[leg, 2]]
        r.update(touchdown=touchdown, foot_targets=targets)

    # --- forces, torque -----------------------------------------------------------------------------------------------

    def distribute(self, direct: Array | None) -> tuple[Array, SolverStatus]:
        r, grf, mass = self.record, self.config.grf, self.body.mass
        turn = np.array([0, 0, r["velocity_command"][2]])
        along = np.array([*r["velocity_command"][:2], 0])
        wanted = r["action"][12:] + np.array([0, 0, mass * GRAVITY, 0, 0, 0])
        wanted[:3] += self.policy.terms.centripetal * mass * np.cross(turn, along)
        r["target_wrench"] = wanted
        forces, count = np.zeros((4, 3)), int(self.stance.sum())
        status = SolverStatus.IDLE
        if direct is not None:
            for leg in np.flatnonzero(self.stance):
                wish = direct[leg] + [0, 0, mass * GRAVITY / count]
                x, y, z = wish
                z = np.clip(z, grf.min_force, grf.max_force)
                forces[leg] = [*np.clip([x, y], -grf.friction * z, grf.friction * z), z]
                if (forces[leg] != wish).any():
                    self.clamps |= Clamp.FRICTION
        elif count:
            arms = r["feet"][self.stance] - self.rotation @ self.com
            wrench_map = np.vstack([np.tile(np.eye(3), count), np.hstack([skew(arm) for arm in arms])])
            weight = np.diag(grf.wrench_weight)
            hessian = 2 * (wrench_map.T @ weight @ wrench_map + grf.force_weight * np.eye(3 * count))
            gradient = -2 * wrench_map.T @ weight @ wanted
            solved = self.solver.solve(GrfProblem(hessian, gradient, grf.friction, grf.min_force, grf.max_force))
            assert solved is not None
            status = SolverStatus.SOLVED
            forces[self.stance] = solved.reshape(-1, 3)
            edge = grf.friction * forces[self.stance, 2] - 1e-6
            at_side = np.abs(forces[self.stance, :2]).max(axis=1) >= edge
            vertical = forces[self.stance, 2]
            at_bound = (vertical >= grf.max_force - 1e-6) | (vertical <= grf.min_force + 1e-6)
            if (at_side | at_bound).any():
                self.clamps |= Clamp.FRICTION
        r["grf"] = forces
        return forces, status

    def command_joints(self, grf: Array, standing: bool) -> JointCommand:
        r, gains, limits = self.record, self.config.gains, self.body.joints
        reached = [leg.angles(self.rotation.T @ foot) for leg, foot in zip(self.legs, r["foot_targets"], strict=True)]
        angles = np.array([angle for angle, _ in reached])
        if not all(inside for _, inside in reached):
            self.clamps |= Clamp.REACH
        position = np.clip(angles, limits.lower, limits.upper)
        if (position != angles).any():
            self.clamps |= Clamp.JOINT_LIMIT
        same = (self.was == self.stance) & self.commanded
        wanted = np.where(same[:, None], (position - self.joint_targets) / self.dt, 0.0)
        velocity = np.clip(wanted, -gains.max_joint_speed, gains.max_joint_speed)
        if (velocity != wanted).any():
            self.clamps |= Clamp.JOINT_SPEED
        self.joint_targets, self.commanded = position, True
        rise = self.dt / 0.5
        for leg in range(4):
            if not self.stance[leg]:
                self.gain[leg] = 1.0
            elif standing:
                start = max(gains.stance_scale, self.gain[leg])
                self.gain[leg] = start + np.clip(gains.standing_scale - start, -rise, rise)
            else:
                self.gain[leg] = gains.stance_scale
        torque = np.array([-j.T @ self.rotation.T @ f for j, f in zip(self.jacobians, grf, strict=True)])
        kp, kd = np.outer(self.gain, gains.kp), np.outer(self.gain, gains.kd)
        r.update(
            command_position=position,
            command_velocity=velocity,
            command_kp=kp,
            command_kd=kd,
            command_torque=torque,
        )
        return JointCommand(position, velocity, kp, kd, torque)
