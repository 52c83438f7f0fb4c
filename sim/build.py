"""How the twin's body is really put together: its own table, which no driver reads, so that a wrong sign shows.

Typed from the lab's published numbers in their own form, per joint: motor = direction · gear · (joint + offset).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.robot import Array
from drivers.wiring import MotorsConfig

Ints = NDArray[np.int64]

_LAB = {
    # leg: (bus, ((id, direction, offset) for abduction, hip, knee))
    "FL": (1, ((11, -1, -0.184), (12, -1, -1.474), (13, -1, 2.873))),
    "FR": (2, ((21, -1, 0.153), (22, 1, -1.467), (23, 1, 2.851))),
    "BL": (3, ((31, 1, -0.174), (32, -1, -1.426), (33, -1, 2.873))),
    "BR": (4, ((41, 1, 0.220), (42, 1, -1.433), (43, 1, 2.854))),
}


@dataclass(frozen=True, slots=True)
class Build:
    """Rows FL FR BL BR, columns abduction hip knee."""

    id: Ints
    bus: Ints
    """Counted from 1."""
    direction: Array
    offset: Array
    """rad."""
    gear: Array
    mount: Array
    """Unit quaternion w x y z, sensor → body."""

    def to_motor(self, joint: Array) -> Array:
        """Joint angles (4, 3) as the motors' output angles."""
        return self.direction * self.gear * (joint + self.offset)

    def to_joint(self, motor: Array) -> Array:
        """Motors' output angles (4, 3) as joint angles."""
        return self.direction * motor / self.gear - self.offset


def lab_build() -> Build:
    """Stoch3 as the lab's own files have it."""
    joints = np.array([leg for _, leg in _LAB.values()])
    return Build(
        id=joints[:, :, 0].astype(np.int64),
        bus=np.array([[bus] * 3 for bus, _ in _LAB.values()]),
        direction=joints[:, :, 1],
        offset=joints[:, :, 2],
        gear=np.ones((4, 3)),
        mount=np.array([1.0, 0.0, 0.0, 0.0]),
    )


def build_of(motors: MotorsConfig, mount: tuple[float, float, float, float]) -> Build:
    """A robot built exactly as its TOML says."""
    return Build(
        id=np.array(motors.id),
        bus=np.array(motors.bus),
        direction=np.array(motors.direction, dtype=float),
        offset=np.array(motors.offset),
        gear=np.tile(np.array(motors.gear), (4, 1)),
        mount=np.array(mount),
    )


def scrambled(build: Build, seed: int) -> Build:
    """The same body put together by somebody who read nothing: plugs, turns, zeros and the IMU at random."""
    random = np.random.default_rng(seed)
    order = random.permutation(12)
    mount = random.standard_normal(4)
    return replace(
        build,
        id=build.id.ravel()[order].reshape(4, 3),
        bus=build.bus.ravel()[order].reshape(4, 3),
        direction=random.choice([-1.0, 1.0], (4, 3)),
        offset=random.uniform(-2.0, 2.0, (4, 3)),
        mount=mount / np.linalg.norm(mount),
    )
