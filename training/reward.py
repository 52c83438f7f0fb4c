"""What a tick is worth: the paper's Table I, and the second stage's task reward. Compiled; terms reported apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.robot import Array
from runtime.control.compilation import compiled

TABLE_TERMS = ("position", "velocity", "orientation", "angular_velocity", "grf")
"""Table I, row by row."""
FEATURES = 30
"""[position 3, velocity 3, rotation 9, angular velocity 3, grf / (m g) 12]: a tick as Table I sees it."""
_ENDS = np.array([0, 3, 6, 15, 18, 30])


@dataclass(frozen=True, slots=True)
class TableReward:
    """(w, k) of each Gaussian kernel G(x, y) = w exp(-k |x - y|²). Paper Table I."""

    position: tuple[float, float] = (1.0, 10.0)
    """Body origin in the world, m."""
    velocity: tuple[float, float] = (1.0, 50.0)
    """m/s."""
    orientation: tuple[float, float] = (1.0, 50.0)
    """Rotation matrix, Frobenius norm."""
    angular_velocity: tuple[float, float] = (1.0, 50.0)
    """rad/s."""
    grf: tuple[float, float] = (30.0, 100.0)
    """Forces of all feet as shares of the weight: in newtons the kernel would always be zero."""

    def table(self) -> Array:
        """Weights and sharpnesses. Shape (5, 2)."""
        return np.array([getattr(self, name) for name in TABLE_TERMS])

    @property
    def best(self) -> float:
        """Reward of a tick without any deviation: 34."""
        return float(self.table()[:, 0].sum())


def gaussian_kernel(weight: float, sharpness: float, x: Array, y: Array) -> float:
    """G_{w,k}(x, y), the paper's; the compiled reward is held to it by a test."""
    return float(weight * np.exp(-sharpness * np.sum((np.asarray(x) - np.asarray(y)) ** 2)))


@compiled
def fill_features(position, velocity, rotation, angular_velocity, grf, weight, features):  # type: ignore[no-untyped-def]
    """Write a tick's state and forces (4, 3) N into ``features`` (30,).

    ``rotation`` (3, 3) body to world; ``weight`` m g in N; the rest in the world, forces in the heading frame.
    """
    for i in range(3):
        features[i] = position[i]
        features[3 + i] = velocity[i]
        features[15 + i] = angular_velocity[i]
        for j in range(3):
            features[6 + 3 * i + j] = rotation[i, j]
    for leg in range(4):
        for i in range(3):
            features[18 + 3 * leg + i] = grf[leg, i] / weight


@compiled
def table_terms(table, reference, features, terms):  # type: ignore[no-untyped-def]
    """Fill ``terms`` (5,) from the reference's features (30,) and the robot's (30,). Paper Table I."""
    for term in range(5):
        distance = 0.0
        for i in range(_ENDS[term], _ENDS[term + 1]):
            distance += (reference[i] - features[i]) ** 2
        terms[term] = table[term, 0] * np.exp(-table[term, 1] * distance)


TASK_TERMS = ("alive", "velocity", "turn", "level", "height", "velocity_now", "torque", "slip", "wobble")


@dataclass(frozen=True, slots=True)
class TaskReward:
    """The second stage: what walking is for. Weights of the terms, and the scales of the bounded ones."""

    alive: float = 1.0
    velocity: float = 1.0
    turn: float = 0.5
    level: float = 0.3
    height: float = 0.3
    velocity_now: float = 0.3
    torque: float = 2e-5
    """Per (N·m)²."""
    slip: float = 0.05
    """Per m/s of each foot that touches the ground."""
    wobble: float = 0.02
    """Per (rad/s)² of roll and pitch rate."""
    velocity_scale: float = 0.15
    """m/s."""
    turn_scale: float = 0.3
    """rad/s."""
    level_scale: float = 0.1
    """rad."""
    height_scale: float = 0.03
    """m."""
    time_constant: float = 0.15
    """Low-pass of the velocity and turn errors, s: a gait sways within a step and should."""

    def table(self) -> Array:
        """All numbers in the order of the fields. Shape (14,)."""
        return np.array([getattr(self, name) for name in self.__slots__])


@compiled
def task_terms(  # type: ignore[no-untyped-def]
    table, dt, smoothed, command, velocity, rpy, height_error, angular_velocity, torque, slip, terms
):
    """Fill ``terms`` (9,) and update ``smoothed`` (3,), the low-passed error of vx, vy and yaw rate.

    ``command`` and ``velocity`` (3,) = vx, vy, yaw rate in the heading frame; ``slip`` the summed speed of the feet
    on the ground, m/s; ``torque`` (4, 3) N·m.
    """
    share = dt / (table[13] + dt)
    for i in range(3):
        smoothed[i] += share * (velocity[i] - command[i] - smoothed[i])
    terms[0] = table[0]
    terms[1] = table[1] * np.exp(-np.hypot(smoothed[0], smoothed[1]) / table[9])
    terms[2] = table[2] * np.exp(-abs(smoothed[2]) / table[10])
    terms[3] = table[3] * np.exp(-np.hypot(rpy[0], rpy[1]) / table[11])
    terms[4] = table[4] * np.exp(-abs(height_error) / table[12])
    terms[5] = table[5] * np.exp(-np.hypot(velocity[0] - command[0], velocity[1] - command[1]) / table[9])
    terms[6] = -table[6] * np.sum(torque * torque)
    terms[7] = -table[7] * slip
    terms[8] = -table[8] * (angular_velocity[0] ** 2 + angular_velocity[1] ** 2)


def named(names: tuple[str, ...], sums: NDArray[np.float64]) -> dict[str, float]:
    """Terms by name, for people and for files."""
    return {name: float(value) for name, value in zip(names, sums, strict=True)}
