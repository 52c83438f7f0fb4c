"""The robot and its ground in PyBullet: the only file that speaks to the physics engine.

PyBullet's frame of a body is its centre of mass along its principal axes; everything that leaves this file refers to
the body's origin, the centre of the four hips.
"""

from __future__ import annotations

import math
import platform
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.description import RobotDescription
from drivers.robot import JOINTS, LEGS, Array, JointCommand, Measurement, damp_command
from sim.errors import PhysicsError, SimulatorMissing
from sim.model import PAYLOAD, Model, build_model, standing_pose
from sim.motors import Motors
from sim.quiet import silenced
from sim.rotation import from_rpy, from_xyzw, to_quaternion
from sim.scenario import Push, Scenario
from sim.sensing import BODY, GRAVITY, POSITION, RATE, READINGS, ROTATION, VELOCITY, read_body
from sim.sensors import Sensors
from sim.terrain import HeightField, Plane, Slope, Steps, Terrain, resting_height
from sim.truth import Trunk, Truth
from sim.urdf import read_model

FAR = 100.0
"""Height at which nothing touches anything, m."""
HELD_HEIGHT = 2.0
"""Of the body's origin while it is held up, m."""
JOINT_NAMES = [f"{leg}_{joint}" for leg in LEGS for joint in JOINTS]


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
        self._bullet = _import_bullet()
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
        self._client = -1
        try:
            with silenced():
                self._client = self._bullet.connect(self._bullet.DIRECT)
                self._start(Scenario())
            self._check_inertia()
            self.reset(Scenario())
            self.step(damp_command(0.0))  # compiles here what would otherwise compile in somebody's first tick
            self.reset(Scenario())
        except BaseException:
            self.close()
            raise

    @property
    def time(self) -> float:
        """Simulated time since the reset, s."""
        return self._ticks * self.period

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
        self._states: Sequence[Any] = self._bullet.getJointStates(
            self._robot, self._joints, physicsClientId=self._client
        )
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
        torques: list[float] = []
        for index in range(first, first + self.substeps):
            self._physics_step(index)
            torques += self.motors.torque
        self._ticks += 1
        self._sensors.warm(np.array(torques).reshape(self.substeps, 12), self.period)
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
        self._brake(joint, torque)

    def hold(self, rpy: tuple[float, float, float], joint_position: Array | None = None) -> None:
        """Keep the body up in the air from now on, as hands or a stand do.

        Args:
            rpy: roll, pitch, yaw of the body, rad.
            joint_position: where the joints are held, rad, (4, 3); None leaves them to the motors and gravity.
        """
        self._held = from_rpy(rpy), joint_position
        self._keep_held(joint_position)
        self._states = self._bullet.getJointStates(self._robot, self._joints, physicsClientId=self._client)

    def set_down(self) -> None:
        """End ``hold``: the robot is again where its last ``reset`` put it."""
        self.reset(self._scenario)

    def fallen(self, tilt: float = 1.0) -> bool:
        """Whether the body touches the ground or leans by more than ``tilt`` rad."""
        if self._body[11] < math.cos(tilt):
            return True
        return bool(self._bullet.getContactPoints(self._robot, linkIndexA=-1, physicsClientId=self._client))

    @property
    def trunk(self) -> Trunk:
        """The trunk's exact state now: a part of ``truth`` that costs nothing."""
        body = self._body
        return Trunk(body[POSITION], body[ROTATION].reshape(3, 3), body[VELOCITY], body[RATE])

    @property
    def truth(self) -> Truth:
        """The exact state now."""
        contacts, forces = self._foot_forces()
        body = self._body
        position, velocity, torque = self.joints
        return Truth(
            body[POSITION],
            body[ROTATION].reshape(3, 3),
            body[VELOCITY],
            body[RATE],
            contacts,
            forces,
            position,
            velocity,
            torque,
        )

    @property
    def foot_contacts(self) -> NDArray[np.bool_]:
        """Feet that touched the ground in the last physics step: a part of ``truth`` that costs less. Shape (4,)."""
        touched = [False] * 4
        for leg, _ in self._foot_points():
            touched[leg] = True
        return np.array(touched)

    @property
    def joints(self) -> tuple[Array, Array, Array]:
        """Exact joint positions rad, velocities rad/s and motor torques N·m now: a part of ``truth``. Each (4, 3)."""
        position, velocity, torque = self._exact[:36].reshape(3, 4, 3)
        return position, velocity, torque

    def close(self) -> None:
        """Release the simulator. Harmless when repeated."""
        if self._client >= 0:
            self._bullet.disconnect(physicsClientId=self._client)
            self._client = -1

    def _physics_step(self, index: int) -> None:
        """Run the motors' law on the present joint states, then the physics."""
        bullet, robot, client = self._bullet, self._robot, self._client
        torque = self.motors.drive(index, self._states)
        bullet.setJointMotorControlArray(
            robot, self._joints, bullet.TORQUE_CONTROL, forces=torque, physicsClientId=client
        )
        if self._pushes:
            self._apply_pushes((index + 0.5) * self._dt)
        if self._held is not None:
            self._keep_held(self._held[1])
        bullet.stepSimulation(physicsClientId=client)
        self._states = bullet.getJointStates(robot, self._joints, physicsClientId=client)

    def _keep_held(self, joint_position: Array | None) -> None:
        assert self._held is not None
        self._place_body(np.array([0.0, 0.0, HELD_HEIGHT]), self._held[0], np.zeros(3))
        if joint_position is not None:
            self._place_joints(joint_position)

    def _apply_pushes(self, now: float) -> None:
        bullet = self._bullet
        for push in self._pushes:
            if push.start <= now < push.start + push.duration:
                position, rotation = self._pose()
                point = position + rotation @ np.array(push.point)
                bullet.applyExternalForce(
                    self._robot, -1, push.force, point.tolist(), bullet.WORLD_FRAME, physicsClientId=self._client
                )

    def _sense(self) -> Measurement:
        bullet, states = self._bullet, self._states
        position, orientation = bullet.getBasePositionAndOrientation(self._robot, physicsClientId=self._client)
        linear, angular = bullet.getBaseVelocity(self._robot, physicsClientId=self._client)
        raw = np.array([
            *[state[0] for state in states], *[state[1] for state in states], *self.motors.torque,
            *position, *orientation, *linear, *angular,
        ])  # fmt: skip
        before, self._body, self._exact = self._body[VELOCITY], np.empty(BODY), np.empty(READINGS)
        read_body(raw, self._com, self._principal, before, self.period, self._body, self._exact)
        return self._sensors.read(self.time, self._misread(self._exact) if self.motors.misreads else self._exact)

    def _misread(self, exact: Array) -> Array:
        """What the servos believe of their joints, and the truth of the rest."""
        read = exact.copy()
        read[:24] = np.array(self.motors.read(self._states)).T.ravel()
        read[24:36] = self.motors.reported()
        return read

    def _pose(self) -> tuple[Array, Array]:
        """Body origin (3,) and rotation body to world (3, 3), from PyBullet's frame at the centre of mass."""
        position, orientation = self._bullet.getBasePositionAndOrientation(self._robot, physicsClientId=self._client)
        rotation = from_xyzw(orientation) @ self._principal.T
        return np.array(position) - rotation @ self._com, rotation

    def _foot_points(self) -> Iterator[tuple[int, Any]]:
        """The engine's contact points that press on a foot, with its leg."""
        for contact in self._bullet.getContactPoints(self._robot, physicsClientId=self._client):
            leg = self._foot_of_link.get(contact[3])
            if leg is not None and contact[9] > 0.0:
                yield leg, contact

    def _foot_forces(self) -> tuple[NDArray[np.bool_], Array]:
        contacts, forces = [False] * 4, [[0.0, 0.0, 0.0] for _ in range(4)]
        for leg, contact in self._foot_points():
            contacts[leg] = True
            force = forces[leg]
            for axis in range(3):
                force[axis] += (
                    contact[7][axis] * contact[9] + contact[11][axis] * contact[10] + contact[13][axis] * contact[12]
                )
        return np.array(contacts), np.array(forces)

    def _brake(self, joint: int, torque: float) -> None:
        bullet = self._bullet
        bullet.setJointMotorControl2(
            self._robot,
            self._joints[joint],
            bullet.VELOCITY_CONTROL,
            targetVelocity=0.0,
            force=torque,
            physicsClientId=self._client,
        )

    def _start(self, scenario: Scenario) -> None:
        """Put robot and ground where ``scenario`` wants them, with nothing of the last episode left.

        On level and tilted planes PyBullet's own state ends with one step far from the ground, so the bodies are kept;
        elsewhere its broad phase drops stale pairs a few a step, in an order the past decides, so all is built anew.
        """
        bullet, client = self._bullet, self._client
        if scenario.terrain != self._built or not isinstance(scenario.terrain, Plane | Slope):
            self._build(scenario.terrain)
        for joint in self._jammed:
            self._brake(joint, 0.0)
        self._jammed.clear()
        self._place(np.array([0.0, 0.0, FAR]), np.eye(3), np.zeros(3), self._stand)
        bullet.stepSimulation(physicsClientId=client)
        for body in self._ground:
            bullet.changeDynamics(body, -1, lateralFriction=scenario.friction, physicsClientId=client)
        bullet.changeDynamics(
            self._robot,
            self._payload,
            mass=scenario.payload,
            localInertiaDiagonal=(0.0, 0.0, 0.0),
            physicsClientId=client,
        )
        joint_position = self._stand if scenario.joint_position is None else scenario.joint_position
        rotation = from_rpy(scenario.rpy)
        height = scenario.height
        if height is None:
            x, y = scenario.position_xy
            feet = self._model.foot_positions(joint_position) @ rotation.T + [x, y, 0.0]
            height = resting_height(scenario.terrain, feet, self.description.foot_radius)
        origin = np.array([*scenario.position_xy, height])
        self._place(origin, rotation, np.array(scenario.velocity, dtype=float), joint_position)

    def _build(self, terrain: Terrain) -> None:
        bullet, client = self._bullet, self._client
        bullet.resetSimulation(physicsClientId=client)
        bullet.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=client)
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=self._dt, deterministicOverlappingPairs=1, enableFileCaching=0, physicsClientId=client
        )
        self._ground = self._build_ground(terrain)
        self._load_robot()
        self._built = terrain

    def _load_robot(self) -> None:
        bullet, client = self._bullet, self._client
        with tempfile.NamedTemporaryFile("w", suffix=".urdf") as file:
            file.write(self._urdf)
            file.flush()
            self._robot = bullet.loadURDF(file.name, flags=bullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client)
        count = bullet.getNumJoints(self._robot, physicsClientId=client)
        infos = [bullet.getJointInfo(self._robot, joint, physicsClientId=client) for joint in range(count)]
        index = {info[1].decode(): info[0] for info in infos}
        self._joints = [index[name] for name in JOINT_NAMES]
        self._payload = index[PAYLOAD]
        self._foot_of_link = {self._joints[3 * leg + 2]: leg for leg in range(4)}
        bullet.changeDynamics(
            self._robot, -1, linearDamping=0.0, angularDamping=0.0, maxJointVelocity=1e3, physicsClientId=client
        )
        for link in range(-1, count):  # in a call of its own: beside a damping, PyBullet drops a link's friction
            bullet.changeDynamics(self._robot, link, lateralFriction=1.0, physicsClientId=client)
        bullet.setJointMotorControlArray(
            self._robot, self._joints, bullet.VELOCITY_CONTROL, forces=[0.0] * 12, physicsClientId=client
        )
        info = bullet.getDynamicsInfo(self._robot, -1, physicsClientId=client)
        self._com, self._principal = np.array(info[3]), from_xyzw(info[4])

    def _place(self, origin: Array, rotation: Array, velocity: Array, joint_position: Array) -> None:
        self._place_body(origin, rotation, velocity)
        self._place_joints(joint_position)

    def _place_body(self, origin: Array, rotation: Array, velocity: Array) -> None:
        bullet, robot, client = self._bullet, self._robot, self._client
        w, x, y, z = to_quaternion(rotation @ self._principal)
        centre = (origin + rotation @ self._com).tolist()
        bullet.resetBasePositionAndOrientation(robot, centre, (x, y, z, w), physicsClientId=client)
        bullet.resetBaseVelocity(robot, velocity.tolist(), (0.0, 0.0, 0.0), physicsClientId=client)

    def _place_joints(self, joint_position: Array) -> None:
        for joint, angle in zip(self._joints, np.ravel(joint_position).tolist(), strict=True):
            self._bullet.resetJointState(self._robot, joint, angle, 0.0, physicsClientId=self._client)

    def _build_ground(self, terrain: Terrain) -> list[int]:
        bullet, client = self._bullet, self._client

        def static(shape: int, position: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> int:
            body: int = bullet.createMultiBody(0.0, shape, basePosition=position, physicsClientId=client)
            return body

        def plane(normal: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> int:
            shape: int = bullet.createCollisionShape(bullet.GEOM_PLANE, planeNormal=normal, physicsClientId=client)
            return shape

        match terrain:
            case Plane():
                return [static(plane())]
            case Slope():
                return [static(plane(terrain.normal))]
            case Steps():
                bodies = [static(plane())]
                for step in range(terrain.count):
                    length = terrain.end - terrain.start - step * terrain.depth
                    half = (length / 2, terrain.width / 2, terrain.height / 2)
                    shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=half, physicsClientId=client)
                    bodies.append(static(shape, (terrain.end - length / 2, 0.0, (step + 0.5) * terrain.height)))
                return bodies
            case HeightField():
                return [self._build_height_field(terrain, static), static(plane(), (0.0, 0.0, -terrain.amplitude))]

    def _build_height_field(self, terrain: HeightField, static: Any) -> int:
        bullet = self._bullet
        nodes = terrain.cells + 1
        shape = bullet.createCollisionShape(
            bullet.GEOM_HEIGHTFIELD,
            meshScale=(terrain.spacing, terrain.spacing, 1.0),
            heightfieldData=terrain.heights.ravel().tolist(),
            numHeightfieldRows=nodes,
            numHeightfieldColumns=nodes,
            physicsClientId=self._client,
        )
        middle = (float(terrain.heights.min()) + float(terrain.heights.max())) / 2
        body: int = static(shape, (0.0, 0.0, middle))
        return body

    def _check_inertia(self) -> None:
        """PyBullet zeroes an inertia that it does not believe and only prints a warning."""
        for body, link in zip(self._model.bodies, [-1, *self._joints], strict=True):
            inertia = self._bullet.getDynamicsInfo(self._robot, link, physicsClientId=self._client)[2]
            if min(inertia) <= 0.0:
                name = body.name
                raise PhysicsError(
                    f"link {name}: PyBullet turned its inertia into {inertia}; it breaks the triangle rule"
                )


def _import_bullet() -> Any:
    try:
        with silenced():
            import pybullet
    except ImportError as error:
        python = f"Python {platform.python_version()} on {platform.machine()}"
        raise SimulatorMissing(
            f"no PyBullet for {python} ({error}): the simulator needs an environment made with Python 3.11 on x86_64"
        ) from error
    return pybullet
