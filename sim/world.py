"""The robot on its ground: scenarios and commands in, measurements and the truth out.

Everything here refers to the body's origin, the centre of the four hips. The engine itself is ``sim.bullet``'s.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.description import RobotDescription
from drivers.robot import Array, JointCommand, Measurement, damp_command
from sim.bullet.engine import Engine
from sim.bullet.ground import Ground
from sim.bullet.multibody import Multibody
from sim.model import Model, build_model, standing_pose
from sim.motors import Motors
from sim.quiet import silenced
from sim.rotation import from_rpy
from sim.scenario import Push, Scenario
from sim.sensing import BODY, POSITION, RATE, READINGS, ROTATION, VELOCITY, read_body
from sim.sensors import Sensors
from sim.terrain import Plane, Slope, Terrain, resting_height
from sim.truth import Truth
from sim.urdf import read_model

FAR = 100.0
"""Height at which nothing touches anything, m."""
HELD_HEIGHT = 2.0
"""Of the body's origin while it is held up, m."""


class World:
    """One robot on one ground. ``reset`` first, then ``step`` once a tick; ``close`` at the end."""

    def __init__(
        self,
        description: RobotDescription,
        rate_hz: float,
        walking_height: float,
        physics_rate_hz: float = 1000.0,
        urdf_search: Path | None = None,
    ) -> None:
        """Start a simulator of its own.

        Args:
            description: the robot.
            rate_hz: how often ``step`` will be called in a second of simulated time.
            walking_height: body origin above the ground in the default start pose, m.
            physics_rate_hz: at least that many physics steps a second; rounded up to a multiple of ``rate_hz``.
            urdf_search: folder of the robot's TOML, where a named URDF is looked for first.

        Raises:
            SimulatorMissing: PyBullet cannot be imported.
            PhysicsError: PyBullet changed an inertia.
            UrdfError: the URDF does not fit the description.
            ValueError: the legs do not reach the walking height.
        """
        self._engine = Engine()
        self.description = description
        self.period = 1.0 / rate_hz
        """s a tick."""
        self.substeps = max(1, math.ceil(physics_rate_hz / rate_hz - 1e-9))
        """Physics steps a tick."""
        self._dt = self.period / self.substeps
        self._stand = standing_pose(description, walking_height)
        self._model = build_model(description) if description.urdf is None else read_model(description, urdf_search)
        self.motors = Motors(description.joints)
        """The servos, with their knobs."""
        self._jammed: set[int] = set()
        self._sensors = Sensors(description.joints)
        self._urdf = self._model.urdf()
        self._built: Terrain | None = None
        try:
            with silenced():
                self._engine.connect()
                self._start(Scenario())
            self._robot.check_inertia(self._model)
            self.reset(Scenario())
            self.step(damp_command(0.0))  # compiles here what would otherwise compile in somebody's first tick
            self.fallen()
            self.reset(Scenario())
        except BaseException:
            self.close()
            raise

    @property
    def time(self) -> float:
        """Simulated time since the reset, s."""
        return self._ticks * self.period

    @property
    def measurement(self) -> Measurement:
        """What the sensors read now, after the last step: what the next ``step`` will return."""
        return self._measurement

    @property
    def model(self) -> Model:
        """The rigid bodies, without payload."""
        return self._model

    def reset(self, scenario: Scenario) -> Measurement:
        """Begin an episode; what follows depends on ``scenario`` and the commands alone, bit for bit.

        Returns the sensors at time 0, which the first ``step`` returns once more.
        """
        self._start(scenario)
        self._ticks = 0
        self._held: tuple[Array, Array | None] | None = None
        self._scenario = scenario
        self._pushes = list(scenario.pushes)
        self.motors.reset(scenario.motor_strength, round(scenario.extra_delay / self._dt))
        self._robot.look()
        self._robot.raw[24:36] = 0.0
        self._body = np.zeros(BODY)
        self._body[VELOCITY] = scenario.velocity
        self._sensors.reset(scenario.noise, scenario.seed)
        self._measurement = self._sense()
        return self._measurement

    def step(self, command: JointCommand) -> Measurement:
        """Give the motors ``command`` and live for one period.

        Returns what the sensors read at the instant the command arrived, before it acted: a command computed from it
        acts exactly one tick later. Joint torque is the motors' in the last physics step, as a servo reports it; the
        accelerometer reads the mean over the last tick, so that R·a·T + g·T is the change of velocity in that tick.

        Raises:
            ValueError: a number in ``command`` is not finite.
        """
        first = self._ticks * self.substeps
        self.motors.take(command, first)
        measurement = self._measurement
        torques = np.empty((self.substeps, 12))
        self._physics_steps(first, torques)
        self._ticks += 1
        self._sensors.warm(torques, self.period)
        self._measurement = self._sense()
        return measurement

    def push(self, force: tuple[float, float, float], duration: float) -> None:
        """Push the body at its origin from now on: N in the world frame, s.

        Raises:
            ValueError: a number that is not finite, or a duration that is not positive.
        """
        now = self.time
        self._pushes = [push for push in self._pushes if push.start + push.duration > now]
        self._pushes.append(Push(now, duration, force))

    def jam(self, joint: int, torque: float) -> None:
        """From now until the reset, joint ``joint`` (0 to 11) only turns under more than ``torque``, N·m."""
        self._jammed.add(joint)
        self._robot.brake(joint, torque)

    def hold(self, rpy: tuple[float, float, float], joint_position: Array | None = None) -> None:
        """Keep the body up in the air from now on, as hands or a stand do.

        Args:
            rpy: roll, pitch, yaw of the body, rad.
            joint_position: where the joints are held, rad, (4, 3); None leaves them to the motors and gravity.
        """
        self._held = from_rpy(rpy), joint_position
        self._keep_held(joint_position)
        self._robot.look()

    def set_down(self) -> None:
        """End ``hold``: the robot is again where its last ``reset`` put it."""
        self.reset(self._scenario)

    def fallen(self, tilt: float = 1.0) -> bool:
        """Whether the body touches the ground or leans by more than ``tilt`` rad."""
        return bool(self._body[11] < math.cos(tilt)) or self._robot.body_touches()

    @property
    def body(self) -> Array:
        """The trunk's exact state now, a part of ``truth`` that costs nothing. ``sensing.BODY``, (18,)."""
        return self._body

    @property
    def truth(self) -> Truth:
        """The exact state now."""
        contacts, forces = self._robot.foot_forces()
        body = self._body
        position, velocity, torque = self.joints
        return Truth(
            body[POSITION], body[ROTATION].reshape(3, 3), body[VELOCITY], body[RATE],
            contacts, forces, position, velocity, torque,
        )  # fmt: skip

    @property
    def foot_contacts(self) -> NDArray[np.bool_]:
        """Feet that touched the ground in the last physics step: a part of ``truth`` that costs less. Shape (4,)."""
        return self._robot.foot_contacts()

    @property
    def joints(self) -> Array:
        """Exact joint positions rad, velocities rad/s and motor torques N·m, a part of ``truth``. Shape (3, 4, 3)."""
        return self._exact[:36].reshape(3, 4, 3)

    def close(self) -> None:
        """Release the simulator. Harmless when repeated."""
        self._engine.close()

    def _physics_steps(self, first: int, torques: Array) -> None:
        """A tick of the motors' law and the physics, from physics step ``first`` on; every torque goes into a row."""
        end = first + self.substeps
        if not (self._robot.direct and self.motors.plain and self._held is None and not self._pushed(first, end)):
            for index in range(first, end):
                torques[index - first] = self._physics_step(index)
            self._robot.look()
            return
        index = first
        while index < end:
            law, changes = self.motors.law_at(index)
            stop = min(changes, end)
            self._robot.run(law, self.motors.peak, torques[index - first : stop - first])
            index = stop
        self.motors.torque = torques[-1]

    def _physics_step(self, index: int) -> Sequence[float] | Array:
        """One physics step with everything that may happen in it; ``Multibody.run`` does the plain ones."""
        robot, motors = self._robot, self.motors
        robot.drive(motors.drive(index, self._states()))
        if self._pushes:
            self._apply_pushes((index + 0.5) * self._dt)
        if self._held is not None:
            self._keep_held(self._held[1])
        self._engine.step()
        robot.look(whole=False)
        robot.raw[24:36] = motors.torque
        return motors.torque

    def _states(self) -> list[tuple[float, float]]:
        """Position rad and velocity rad/s of each joint."""
        raw = self._robot.raw
        return list(zip(raw[:12].tolist(), raw[12:24].tolist(), strict=True))

    def _pushed(self, first: int, end: int) -> bool:
        """Whether a push may act in these physics steps."""
        start, stop = first * self._dt, end * self._dt
        return any(push.start <= stop and push.start + push.duration >= start for push in self._pushes)

    def _keep_held(self, joint_position: Array | None) -> None:
        assert self._held is not None
        self._robot.place(np.array([0.0, 0.0, HELD_HEIGHT]), self._held[0], np.zeros(3))
        if joint_position is not None:
            self._robot.place_joints(joint_position)

    def _apply_pushes(self, now: float) -> None:
        for push in self._pushes:
            if push.start <= now < push.start + push.duration:
                self._robot.push(push)

    def _sense(self) -> Measurement:
        robot = self._robot
        before, self._body, self._exact = self._body[VELOCITY], np.empty(BODY), np.empty(READINGS)
        read_body(robot.raw, robot.com, robot.principal, before, self.period, self._body, self._exact)
        return self._sensors.read(self.time, self._misread(self._exact) if self.motors.misreads else self._exact)

    def _misread(self, exact: Array) -> Array:
        """What the servos believe of their joints, and the truth of the rest."""
        read = exact.copy()
        read[:24] = np.array(self.motors.read(self._states())).T.ravel()
        read[24:36] = self.motors.reported()
        return read

    def _start(self, scenario: Scenario) -> None:
        """Put robot and ground where ``scenario`` wants them, with nothing of the last episode left.

        On level and tilted planes PyBullet's own state ends with one step far from the ground, so the bodies are kept;
        elsewhere its broad phase drops stale pairs a few a step, in an order the past decides, so all is built anew.
        """
        if scenario.terrain != self._built or not isinstance(scenario.terrain, Plane | Slope):
            self._build(scenario.terrain)
        robot = self._robot
        for joint in self._jammed:
            robot.brake(joint, 0.0)
        self._jammed.clear()
        robot.place(np.array([0.0, 0.0, FAR]), np.eye(3), np.zeros(3))
        robot.place_joints(self._stand)
        self._engine.step()
        self._ground.rub(scenario.friction)
        robot.load(scenario.payload)
        joint_position = self._stand if scenario.joint_position is None else scenario.joint_position
        rotation = from_rpy(scenario.rpy)
        origin = self._origin(scenario, rotation, joint_position)
        robot.place(origin, rotation, np.array(scenario.velocity, dtype=float))
        robot.place_joints(joint_position)

    def _build(self, terrain: Terrain) -> None:
        self._engine.clear(self._dt)
        self._ground = Ground(self._engine, terrain)
        self._robot = Multibody(self._engine, self._urdf, self.description.joints.friction_torque)
        self._built = terrain

    def _origin(self, scenario: Scenario, rotation: Array, joint_position: Array) -> Array:
        """Where the body's origin starts, world frame, m: the lowest foot on the ground unless a height is named."""
        x, y = scenario.position_xy
        height = scenario.height
        if height is None:
            feet = self._model.foot_positions(joint_position) @ rotation.T + [x, y, 0.0]
            height = resting_height(scenario.terrain, feet, self.description.foot_radius)
        return np.array([x, y, height])
