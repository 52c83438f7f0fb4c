"""The robot and its ground in PyBullet: the only file that speaks to the physics engine.

PyBullet's frame of a body is its centre of mass along its principal axes; everything that leaves this file refers to
the body's origin, the centre of the four hips.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import platform
import sys
import tempfile
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from math import copysign
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.description import RobotDescription
from drivers.robot import JOINTS, LEGS, Array, JointCommand, Measurement
from sim.model import PAYLOAD, Model, build_model, rpy_rotation, standing_pose
from sim.scenario import Push, Scenario
from sim.sensors import Sensors
from sim.terrain import HeightField, Plane, Slope, Steps, Terrain
from sim.urdf import read_model

GRAVITY = 9.81
"""m/s²."""
UPWARDS = np.array([0.0, 0.0, GRAVITY])
"""What an accelerometer at rest feels, world frame, m/s²."""
FAR = 100.0
"""Height at which nothing touches anything, m."""
STICKING_SPEED = 0.1
"""Dry friction grows linearly up to this joint speed, rad/s: a hard sign would chatter, a constraint would cost as much
as the rest of the step."""
JOINT_NAMES = [f"{leg}_{joint}" for leg in LEGS for joint in JOINTS]


class SimulatorMissing(ImportError):
    """PyBullet is not installed, or has no wheel for this Python."""


class SimulatorError(RuntimeError):
    """The simulator did not build what the description asks for."""


@dataclass(frozen=True, slots=True)
class Truth:
    """The exact state, for rewards and tests; never for the controller. World frame where not said otherwise."""

    position: Array
    """Body origin, m. Shape (3,)."""
    rotation_body_to_world: Array
    """Shape (3, 3)."""
    linear_velocity: Array
    """Of the body origin, m/s. Shape (3,)."""
    angular_velocity: Array
    """rad/s. Shape (3,)."""
    foot_contacts: NDArray[np.bool_]
    """Feet that touched the ground in the last physics step. Shape (4,)."""
    foot_forces: Array
    """Ground on foot in the last physics step, N. Shape (4, 3)."""
    joint_position: Array
    """rad. Shape (4, 3)."""
    joint_velocity: Array
    """rad/s. Shape (4, 3)."""
    joint_torque: Array
    """What the motors applied in the last physics step, N·m. Shape (4, 3)."""


@dataclass(frozen=True, slots=True)
class _Law:
    """A command as the motors run it: torque = constant - kp q - kd q', twelve numbers each."""

    constant: list[float]
    kp: list[float]
    kd: list[float]


LIMP = _Law([0.0] * 12, [0.0] * 12, [0.0] * 12)


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
            SimulatorError: PyBullet changed an inertia.
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
        self._friction = description.joints.friction_torque
        self._sensors = Sensors(description.joints)
        self._urdf = self._model.urdf()
        self._built: Terrain | None = None
        self._client = -1
        with _silenced():
            self._client = self._bullet.connect(self._bullet.DIRECT)
            self._start(Scenario())
        self._check_inertia()
        self.reset(Scenario())

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
        self._scenario = scenario
        self._ticks = 0
        self._delay = round(scenario.extra_delay / self._dt)
        self._pushes = list(scenario.pushes)
        self._law = LIMP
        self._pending: deque[tuple[int, _Law]] = deque()
        self._peak = [scenario.motor_strength * peak for peak in self.description.joints.peak_torque] * 4
        self._torque = [0.0] * 12
        self._states: Sequence[Any] = self._bullet.getJointStates(
            self._robot, self._joints, physicsClientId=self._client
        )
        self._velocity = np.array(scenario.velocity, dtype=float)
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
        measurement = self._measurement
        self._pending.append((self._ticks * self.substeps + self._delay, _law(command)))
        torques = []
        for index in range(self._ticks * self.substeps, (self._ticks + 1) * self.substeps):
            self._physics_step(index)
            torques.append(self._torque)
        self._ticks += 1
        history = np.array(torques)
        self._sensors.warm(((history * history).sum(axis=0) / self.substeps).reshape(4, 3), self.period)
        self._measurement = self._sense()
        return measurement

    def push(self, force: tuple[float, float, float], duration: float) -> None:
        """Push the body at its origin from now on: N in the world frame, s."""
        self._pushes.append(Push(self.time, duration, force))

    def fallen(self, tilt: float = 1.0) -> bool:
        """Whether the body touches the ground or leans by more than ``tilt`` rad."""
        if self._rotation[2, 2] < math.cos(tilt):
            return True
        return bool(self._bullet.getContactPoints(self._robot, linkIndexA=-1, physicsClientId=self._client))

    @property
    def truth(self) -> Truth:
        """The exact state now."""
        contacts, forces = self._foot_forces()
        position, velocity = self._joint_arrays()
        torque = np.array(self._torque).reshape(4, 3)
        return Truth(
            self._position,
            self._rotation,
            self._velocity,
            self._angular_velocity,
            contacts,
            forces,
            position,
            velocity,
            torque,
        )

    def close(self) -> None:
        """Release the simulator. Harmless when repeated."""
        if self._client >= 0:
            self._bullet.disconnect(physicsClientId=self._client)
            self._client = -1

    def _physics_step(self, index: int) -> None:
        """Run the motors' law on the present joint states, then the physics for ``dt``."""
        while self._pending and self._pending[0][0] <= index:
            self._law = self._pending.popleft()[1]
        law = self._law
        self._torque = [
            torque if -peak < (torque := c - p * state[0] - d * state[1]) < peak else (peak if torque > 0 else -peak)
            for state, c, p, d, peak in zip(self._states, law.constant, law.kp, law.kd, self._peak, strict=True)
        ]
        friction, slope = self._friction, self._friction / STICKING_SPEED
        applied = [
            torque
            - (speed * slope if -STICKING_SPEED < (speed := state[1]) < STICKING_SPEED else copysign(friction, speed))
            for torque, state in zip(self._torque, self._states, strict=True)
        ]
        bullet, robot, client = self._bullet, self._robot, self._client
        bullet.setJointMotorControlArray(
            robot, self._joints, bullet.TORQUE_CONTROL, forces=applied, physicsClientId=client
        )
        if self._pushes:
            self._apply_pushes((index + 0.5) * self._dt)
        bullet.stepSimulation(physicsClientId=client)
        self._states = bullet.getJointStates(robot, self._joints, physicsClientId=client)

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
        before = self._velocity
        self._position, self._rotation = self._pose()
        linear, angular = self._bullet.getBaseVelocity(self._robot, physicsClientId=self._client)
        self._angular_velocity = np.array(angular)
        self._velocity = np.array(linear) - _cross(angular, (self._rotation @ self._com).tolist())
        world_to_body = self._rotation.T
        position, velocity = self._joint_arrays()
        return self._sensors.read(
            self.time,
            _quaternion(self._rotation),
            world_to_body @ self._angular_velocity,
            world_to_body @ ((self._velocity - before) / self.period + UPWARDS),
            (position, velocity, np.array(self._torque).reshape(4, 3)),
        )

    def _pose(self) -> tuple[Array, Array]:
        """Body origin (3,) and rotation body to world (3, 3), from PyBullet's frame at the centre of mass."""
        position, orientation = self._bullet.getBasePositionAndOrientation(self._robot, physicsClientId=self._client)
        rotation = _matrix(orientation) @ self._principal.T
        return np.array(position) - rotation @ self._com, rotation

    def _joint_arrays(self) -> tuple[Array, Array]:
        both = np.array([state[:2] for state in self._states])
        return both[:, 0].reshape(4, 3).copy(), both[:, 1].reshape(4, 3).copy()

    def _foot_forces(self) -> tuple[NDArray[np.bool_], Array]:
        contacts, forces = np.zeros(4, dtype=bool), np.zeros((4, 3))
        for contact in self._bullet.getContactPoints(self._robot, self._ground[0], physicsClientId=self._client):
            leg = self._foot_of_link.get(contact[3])
            if leg is None or contact[9] <= 0.0:
                continue
            contacts[leg] = True
            forces[leg] += np.array(contact[7]) * contact[9]
            forces[leg] += np.array(contact[11]) * contact[10] + np.array(contact[13]) * contact[12]
        return contacts, forces

    def _start(self, scenario: Scenario) -> None:
        """Put robot and ground where ``scenario`` wants them, with nothing of the last episode left.

        On level and tilted planes PyBullet's own state ends with one step far from the ground, so the bodies are kept;
        elsewhere its broad phase remembers the past in the order of its pairs, so everything is built anew.
        """
        bullet, client = self._bullet, self._client
        if scenario.terrain != self._built or not isinstance(scenario.terrain, Plane | Slope):
            self._build(scenario.terrain)
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
        rotation = rpy_rotation(scenario.rpy)
        height = scenario.height
        if height is None:
            height = self._resting_height(scenario, rotation, joint_position)
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
        for link in range(-1, count):
            bullet.changeDynamics(
                self._robot,
                link,
                linearDamping=0.0,
                angularDamping=0.0,
                lateralFriction=1.0,
                maxJointVelocity=1e3,
                physicsClientId=client,
            )
        bullet.setJointMotorControlArray(
            self._robot, self._joints, bullet.VELOCITY_CONTROL, forces=[0.0] * 12, physicsClientId=client
        )
        info = bullet.getDynamicsInfo(self._robot, -1, physicsClientId=client)
        self._com, self._principal = np.array(info[3]), _matrix(info[4])

    def _place(self, origin: Array, rotation: Array, velocity: Array, joint_position: Array) -> None:
        bullet, robot, client = self._bullet, self._robot, self._client
        w, x, y, z = _quaternion(rotation @ self._principal)
        centre = (origin + rotation @ self._com).tolist()
        bullet.resetBasePositionAndOrientation(robot, centre, (x, y, z, w), physicsClientId=client)
        bullet.resetBaseVelocity(robot, velocity.tolist(), (0.0, 0.0, 0.0), physicsClientId=client)
        for joint, angle in zip(self._joints, np.ravel(joint_position).tolist(), strict=True):
            bullet.resetJointState(robot, joint, angle, 0.0, physicsClientId=client)

    def _resting_height(self, scenario: Scenario, rotation: Array, joint_position: Array) -> float:
        """Body origin above z = 0 at which the first foot's sphere touches the ground, m."""
        radius = self.description.foot_radius
        best = -math.inf
        for foot in self._model.foot_positions(joint_position) @ rotation.T:
            x, y = foot[0] + scenario.position_xy[0], foot[1] + scenario.position_xy[1]
            for dx, dy in _disc(radius):
                under = scenario.terrain.height_at(x + dx, y + dy)
                best = max(best, under + math.sqrt(max(radius**2 - dx**2 - dy**2, 0.0)) - foot[2])
        return best

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
                self.close()
                raise SimulatorError(
                    f"link {name}: PyBullet turned its inertia into {inertia}; it breaks the triangle rule"
                )


def _law(command: JointCommand) -> _Law:
    constant = command.torque + command.kp * command.position + command.kd * command.velocity
    if not (np.isfinite(constant).all() and np.isfinite(command.kp).all() and np.isfinite(command.kd).all()):
        names = [item.name for item in fields(command) if not np.isfinite(getattr(command, item.name)).all()]
        raise ValueError(f"joint command {', '.join(names) or 'product'}: not finite")
    return _Law(constant.ravel().tolist(), command.kp.ravel().tolist(), command.kd.ravel().tolist())


def _disc(radius: float) -> list[tuple[float, float]]:
    """Points over a disc: its centre and two rings."""
    angles = [index * math.pi / 6 for index in range(12)]
    rings = [(r * math.cos(a), r * math.sin(a)) for r in (radius / 2, 0.99 * radius) for a in angles]
    return [(0.0, 0.0), *rings]


def _cross(a: Sequence[float], b: Sequence[float]) -> Array:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _matrix(orientation: Sequence[float]) -> Array:
    """Rotation matrix of a quaternion in PyBullet's order x y z w. Shape (3, 3)."""
    x, y, z, w = orientation
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _quaternion(rotation: Array) -> Array:
    """Unit quaternion w x y z of a rotation matrix, from its largest component. Shape (4,)."""
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    squares = (1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i)
    largest = squares.index(max(squares))
    rows = (
        (squares[0], h - f, c - g, d - b),
        (h - f, squares[1], b + d, c + g),
        (c - g, b + d, squares[2], f + h),
        (d - b, c + g, f + h, squares[3]),
    )
    quaternion = np.array(rows[largest]) / (2 * math.sqrt(squares[largest]))
    return quaternion if quaternion[0] >= 0 else -quaternion


def _import_bullet() -> Any:
    try:
        with _silenced():
            import pybullet
    except ImportError as error:
        python = f"Python {platform.python_version()} on {platform.machine()}"
        raise SimulatorMissing(
            f"no PyBullet for {python} ({error}): the simulator needs an environment made with Python 3.11 on x86_64"
        ) from error
    return pybullet


@contextlib.contextmanager
def _silenced() -> Iterator[None]:
    """Send what C code prints to nowhere: PyBullet announces itself on standard error."""
    libc = ctypes.CDLL(None)
    sys.stdout.flush()
    sys.stderr.flush()
    libc.fflush(None)
    kept = os.dup(1), os.dup(2)
    try:
        with Path(os.devnull).open("wb") as nowhere:
            os.dup2(nowhere.fileno(), 1)
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        libc.fflush(None)
        for descriptor, copy in enumerate(kept, start=1):
            os.dup2(copy, descriptor)
            os.close(copy)
