"""The robot as the engine keeps it: a base with links.

PyBullet's frame of the base is its centre of mass along its principal axes. What this file takes and gives refers to
the body's origin, the centre of the four hips, except ``raw``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.robot import JOINTS, LEGS, Array
from sim.bullet.engine import Engine
from sim.bullet.native import RUN_DTYPE, look, run, touch
from sim.errors import PhysicsError
from sim.model import PAYLOAD, Model
from sim.rotation import from_xyzw, to_quaternion
from sim.scenario import Push
from sim.sensing import STICKING_SPEED

JOINT_NAMES = [f"{leg}_{joint}" for leg in LEGS for joint in JOINTS]


class Multibody:
    """One robot in an engine, until the engine is cleared."""

    def __init__(self, engine: Engine, urdf: str, friction: float) -> None:
        """Load the robot with free joints and no damping; ``friction`` is what ``run`` takes for the motors', N·m."""
        self.bullet = engine.bullet
        self._client = engine.client
        with tempfile.NamedTemporaryFile("w", suffix=".urdf") as file:
            file.write(urdf)
            file.flush()
            self._robot: int = self.bullet.loadURDF(
                file.name, flags=self.bullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=self._client
            )
        count = self.bullet.getNumJoints(self._robot, physicsClientId=self._client)
        infos = [self.bullet.getJointInfo(self._robot, joint, physicsClientId=self._client) for joint in range(count)]
        index = {info[1].decode(): info[0] for info in infos}
        self._joints: list[int] = [index[name] for name in JOINT_NAMES]
        self._payload = index[PAYLOAD]
        self._foot_of_link = {self._joints[3 * leg + 2]: leg for leg in range(4)}
        self._free(count)
        info = self.bullet.getDynamicsInfo(self._robot, -1, physicsClientId=self._client)
        self.com, self.principal = np.array(info[3]), from_xyzw(info[4])
        """Centre of mass in the body frame, m, (3,); rotation from the base's frame to the body's, (3, 3)."""
        self.direct = engine.address != 0
        """Whether ``run`` may be called."""
        self._memory = np.zeros(RUN_DTYPE.itemsize, np.uint8)
        record = self._memory.view(RUN_DTYPE)[0]
        record["client"], record["body"] = engine.address, self._robot
        record["friction"], record["sticking_speed"] = friction, STICKING_SPEED
        record["position_index"] = [infos[joint][3] for joint in self._joints]
        record["velocity_index"] = [infos[joint][4] for joint in self._joints]
        record["feet"] = list(self._foot_of_link)
        self._touching: NDArray[np.bool_] = record["touching"].view(np.bool_)
        self.raw: Array = record["raw"]
        """The state that was looked at last, as ``sensing.RAW`` says; the torques are ``run``'s or the caller's."""

    def check_inertia(self, model: Model) -> None:
        """Compare with ``model``: PyBullet zeroes an inertia that it does not believe and only prints a warning.

        Raises:
            PhysicsError: it did, naming the link.
        """
        for body, link in zip(model.bodies, [-1, *self._joints], strict=True):
            inertia = self.bullet.getDynamicsInfo(self._robot, link, physicsClientId=self._client)[2]
            if min(inertia) <= 0.0:
                raise PhysicsError(
                    f"link {body.name}: PyBullet turned its inertia into {inertia}; it breaks the triangle rule"
                )

    def look(self, whole: bool = True) -> None:
        """Bring ``raw`` up to date, all but the torques; where not ``whole``, at least the joints.

        Raises:
            PhysicsError: the engine does not answer.
        """
        if self.direct:
            self._check(look(self._memory))
            return
        raw = self.raw
        states = self.bullet.getJointStates(self._robot, self._joints, physicsClientId=self._client)
        raw[:24] = [state[0] for state in states] + [state[1] for state in states]
        if whole:
            position, orientation = self.bullet.getBasePositionAndOrientation(self._robot, physicsClientId=self._client)
            linear, angular = self.bullet.getBaseVelocity(self._robot, physicsClientId=self._client)
            raw[36:] = *position, *orientation, *linear, *angular

    def run(self, law: Array, peak: Array, torques: Array) -> None:
        """Physics steps without Python between them, with the bits of ``drive``, ``Engine.step`` and ``look``.

        Args:
            law: as ``sensing.motor_law`` gives it. Shape (3, 12).
            peak: torque that each motor reaches, N·m. Shape (12,).
            torques: filled with what the motors exerted, N·m; a row is a physics step. Shape (n, 12).

        Raises:
            PhysicsError: the engine does not answer.
        """
        self._check(run(self._memory, law, peak, torques))

    def _check(self, answered: bool) -> None:
        if not answered:
            raise PhysicsError("PyBullet does not tell the robot's state")

    def drive(self, torque: Sequence[float]) -> None:
        """Torque of the twelve joints in the next physics step, N·m."""
        bullet = self.bullet
        bullet.setJointMotorControlArray(
            self._robot, self._joints, bullet.TORQUE_CONTROL, forces=torque, physicsClientId=self._client
        )

    def push(self, push: Push) -> None:
        """Let its force act in the next physics step."""
        position, orientation = self.bullet.getBasePositionAndOrientation(self._robot, physicsClientId=self._client)
        rotation = from_xyzw(orientation) @ self.principal.T
        point = np.array(position) - rotation @ self.com + rotation @ np.array(push.point)
        self.bullet.applyExternalForce(
            self._robot, -1, push.force, point.tolist(), self.bullet.WORLD_FRAME, physicsClientId=self._client
        )

    def brake(self, joint: int, torque: float) -> None:
        """Joint ``joint`` (0 to 11) only turns under more than ``torque``, N·m."""
        self.bullet.setJointMotorControl2(
            self._robot,
            self._joints[joint],
            self.bullet.VELOCITY_CONTROL,
            targetVelocity=0.0,
            force=torque,
            physicsClientId=self._client,
        )

    def load(self, payload: float) -> None:
        """Put a payload of so many kg on the body's top."""
        self.bullet.changeDynamics(
            self._robot,
            self._payload,
            mass=payload,
            localInertiaDiagonal=(0.0, 0.0, 0.0),
            physicsClientId=self._client,
        )

    def place(self, origin: Array, rotation: Array, velocity: Array) -> None:
        """Put the body's origin (3,) m there, turned by ``rotation`` (3, 3), moving at ``velocity`` (3,) m/s."""
        w, x, y, z = to_quaternion(rotation @ self.principal)
        centre = (origin + rotation @ self.com).tolist()
        self.bullet.resetBasePositionAndOrientation(self._robot, centre, (x, y, z, w), physicsClientId=self._client)
        self.bullet.resetBaseVelocity(self._robot, velocity.tolist(), (0.0, 0.0, 0.0), physicsClientId=self._client)

    def place_joints(self, position: Array) -> None:
        """Put the joints at ``position`` (4, 3) rad, at rest."""
        for joint, angle in zip(self._joints, np.ravel(position).tolist(), strict=True):
            self.bullet.resetJointState(self._robot, joint, angle, 0.0, physicsClientId=self._client)

    def body_touches(self) -> bool:
        """Whether the body, not a leg, touched something in the last physics step."""
        if self.direct:
            touch(self._memory)
            return bool(self._touching[4])
        return bool(self.bullet.getContactPoints(self._robot, linkIndexA=-1, physicsClientId=self._client))

    def foot_contacts(self) -> NDArray[np.bool_]:
        """Feet that touched the ground in the last physics step. Shape (4,)."""
        if self.direct:
            touch(self._memory)
            return self._touching[:4].copy()
        touched = [False] * 4
        for leg, _ in self._foot_points():
            touched[leg] = True
        return np.array(touched)

    def foot_forces(self) -> tuple[NDArray[np.bool_], Array]:
        """Feet that touched the ground in the last physics step, (4,), and the ground's forces on them, (4, 3) N."""
        contacts, forces = [False] * 4, [[0.0, 0.0, 0.0] for _ in range(4)]
        for leg, contact in self._foot_points():
            contacts[leg] = True
            force = forces[leg]
            for axis in range(3):
                force[axis] += (
                    contact[7][axis] * contact[9] + contact[11][axis] * contact[10] + contact[13][axis] * contact[12]
                )
        return np.array(contacts), np.array(forces)

    def _foot_points(self) -> Iterator[tuple[int, Any]]:
        """The engine's contact points that press on a foot, with its leg."""
        for contact in self.bullet.getContactPoints(self._robot, physicsClientId=self._client):
            leg = self._foot_of_link.get(contact[3])
            if leg is not None and contact[9] > 0.0:
                yield leg, contact

    def _free(self, count: int) -> None:
        """Take away the dampings, the joints' own motors and the friction that a URDF brings."""
        bullet, client = self.bullet, self._client
        bullet.changeDynamics(
            self._robot, -1, linearDamping=0.0, angularDamping=0.0, maxJointVelocity=1e3, physicsClientId=client
        )
        for link in range(-1, count):  # in a call of its own: beside a damping, PyBullet drops a link's friction
            bullet.changeDynamics(self._robot, link, lateralFriction=1.0, physicsClientId=client)
        bullet.setJointMotorControlArray(
            self._robot, self._joints, bullet.VELOCITY_CONTROL, forces=[0.0] * 12, physicsClientId=client
        )
