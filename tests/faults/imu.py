"""Faults of the inertial unit, on any body whose measurement passes through the rig."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivers.robot import ImuSample, Measurement
from faults.rig import Fault, Rig

FIELDS = ("orientation", "angular_velocity", "linear_acceleration")


def with_imu(measurement: Measurement, **imu: Any) -> Measurement:
    return replace(measurement, imu=replace(measurement.imu, **imu))


def product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Of two quaternions w x y z."""
    w, v = p[0] * q[0] - p[1:] @ q[1:], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
    return np.array([w, *v])


def turn(axis: int, angle: float) -> np.ndarray:
    quaternion = np.zeros(4)
    quaternion[0], quaternion[axis + 1] = math.cos(angle / 2), math.sin(angle / 2)
    return quaternion


@dataclass
class FrozenImu(Fault):
    """It goes on sending, always the same sample; ``stamped``: with the time of its sending."""

    stamped: bool = True

    def start(self, rig: Rig) -> None:
        self._sample = rig.last.imu

    def measurement(self, rig: Rig, measurement: Measurement) -> Measurement:
        stamp = measurement.imu.stamp if self.stamped else self._sample.stamp
        return replace(measurement, imu=replace(self._sample, stamp=stamp))


@dataclass
class NanImu(Fault):
    """One number of a sample is not one."""

    name: str
    place: int
    value: float = math.nan

    def measurement(self, rig: Rig, measurement: Measurement) -> Measurement:
        part = getattr(measurement.imu, self.name).copy()
        part[self.place % len(part)] = self.value
        return with_imu(measurement, **{self.name: part})


@dataclass
class FlippedImu(Fault):
    """Turned by half a turn about one of its axes: mounted upside down, or its firmware thinks so."""

    axis: int

    def measurement(self, rig: Rig, measurement: Measurement) -> Measurement:
        imu, sign = measurement.imu, -np.ones(3)
        sign[self.axis] = 1.0
        return with_imu(
            measurement,
            orientation=product(imu.orientation, turn(self.axis, math.pi)),
            angular_velocity=sign * imu.angular_velocity,
            linear_acceleration=sign * imu.linear_acceleration,
        )


@dataclass
class BiasJump(Fault):
    """From one sample to the next everything is off by a constant."""

    tilt: float
    axis: int
    rate: tuple[float, float, float]
    acceleration: tuple[float, float, float]

    def measurement(self, rig: Rig, measurement: Measurement) -> Measurement:
        imu = measurement.imu
        return with_imu(
            measurement,
            orientation=product(imu.orientation, turn(self.axis, self.tilt)),
            angular_velocity=imu.angular_velocity + self.rate,
            linear_acceleration=imu.linear_acceleration + self.acceleration,
        )


@dataclass
class ClippedImu(Fault):
    rate: float
    acceleration: float

    def measurement(self, rig: Rig, measurement: Measurement) -> Measurement:
        imu = measurement.imu
        return with_imu(
            measurement,
            angular_velocity=np.clip(imu.angular_velocity, -self.rate, self.rate),
            linear_acceleration=np.clip(imu.linear_acceleration, -self.acceleration, self.acceleration),
        )


@dataclass
class ReplacedImu(Fault):
    """Its cable is pulled and plugged in again: silence, then another heading."""

    seconds: float
    yaw: float

    def start(self, rig: Rig) -> None:
        self._sample, self._end = rig.last.imu, rig.body.now + self.seconds

    def measurement(self, rig: Rig, measurement: Measurement) -> Measurement:
        if rig.body.now < self._end:
            return replace(measurement, imu=self._sample)
        return with_imu(measurement, orientation=product(turn(2, self.yaw), measurement.imu.orientation))


@dataclass
class SlowImu(Fault):
    """It sends at another rate than it was told, Hz."""

    rate: float

    def start(self, rig: Rig) -> None:
        self._sample: ImuSample = rig.last.imu

    def measurement(self, rig: Rig, measurement: Measurement) -> Measurement:
        if measurement.imu.stamp - self._sample.stamp >= 1.0 / self.rate - 1e-6:
            self._sample = measurement.imu
        return replace(measurement, imu=self._sample)
