"""The conditions of one episode: pure data, all nominal by default."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from drivers.robot import Array
from sim.terrain import Plane, Terrain

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Push:
    """A constant force on the body for a while."""

    start: float
    """s of simulated time."""
    duration: float
    """s."""
    force: Vector
    """N in the world frame."""
    point: Vector = (0.0, 0.0, 0.0)
    """Where it acts, from the body's origin in the body frame, m."""

    def __post_init__(self) -> None:
        if not 0 < self.duration < math.inf:
            raise ValueError(f"push duration = {self.duration}: must be finite and positive")
        _check_finite(self, "push", ("start", "force", "point"))


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations of the sensors' errors: white ones, and biases drawn once an episode."""

    joint_position: float = 0.0
    """rad."""
    joint_velocity: float = 0.0
    """rad/s."""
    joint_torque: float = 0.0
    """N·m."""
    orientation: float = 0.0
    """rad about each body axis."""
    angular_velocity: float = 0.0
    """rad/s."""
    linear_acceleration: float = 0.0
    """m/s²."""
    joint_position_bias: float = 0.0
    """rad."""
    joint_torque_bias: float = 0.0
    """N·m."""
    orientation_bias: float = 0.0
    """rad about each body axis."""
    angular_velocity_bias: float = 0.0
    """rad/s."""
    linear_acceleration_bias: float = 0.0
    """m/s²."""

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if not getattr(self, name) >= 0:
                raise ValueError(f"noise {name} = {getattr(self, name)}: a standard deviation is not negative")


@dataclass(frozen=True, slots=True)
class Scenario:
    """What an episode starts from and what it meets."""

    seed: int = 0
    """Of the sensors' noise."""
    position_xy: tuple[float, float] = (0.0, 0.0)
    """Body origin in the world, m."""
    rpy: Vector = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw of the body, rad."""
    velocity: Vector = (0.0, 0.0, 0.0)
    """Of the body in the world, m/s."""
    friction: float = 1.0
    """Coefficient between foot and ground."""
    terrain: Terrain = field(default_factory=Plane)
    pushes: tuple[Push, ...] = ()
    payload: float = 0.0
    """Mass on the middle of the body's top, kg."""
    motor_strength: float = 1.0
    """Share of the peak torque that the motors reach."""
    extra_delay: float = 0.0
    """How much later than it should a command reaches the motors, s."""
    noise: Noise = field(default_factory=Noise)
    joint_position: Array | None = None
    """Start pose, rad, (4, 3). Default: standing at the walking height with the feet below the hips."""
    height: float | None = None
    """Body origin above z = 0, m. Default: the lowest foot just touches the ground."""

    def __post_init__(self) -> None:
        for name in ("friction", "payload", "motor_strength", "extra_delay"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"scenario {name} = {getattr(self, name)}: must be finite and not negative")
        _check_finite(self, "scenario", ("position_xy", "rpy", "velocity") + (("height",) if self.height else ()))
        pose = self.joint_position
        if pose is not None and (pose.shape != (4, 3) or not np.isfinite(pose).all()):
            raise ValueError(f"scenario joint_position of shape {pose.shape}: must be (4, 3) and finite")


def _check_finite(record: Push | Scenario, kind: str, names: tuple[str, ...]) -> None:
    for name in names:
        if not np.isfinite(getattr(record, name)).all():
            raise ValueError(f"{kind} {name} = {getattr(record, name)}: must be finite")
