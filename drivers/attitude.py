"""Orientation for an IMU that gives none (a true MTi-610 is such a one), by the imufusion library behind our types.

Gyroscope and gravity only: roll and pitch are absolute, yaw starts at 0 and drifts. World: x where the sensor's x
pointed at the start, z up.
"""

from __future__ import annotations

import math

import imufusion
import numpy as np

from drivers.robot import Array

GRAVITY = 9.80665
"""m/s² in one g, as imufusion counts."""
GAIN = 0.5
"""How fast gravity corrects the gyroscope, rad/s (Madgwick's revised filter)."""
AVERAGING_TIME = 0.25
"""s over which the felt force is averaged in the world before its direction is believed.

A trotting body shakes forwards and upwards in step, so single directions are lopsided; their sum over strides is not.
Rejecting implausible samples, the library's own way, keeps the lopsided half: 9.7 degrees off where this is 1.4.
"""
_GYROSCOPE_RANGE = 2000.0
_LONGEST_GAP = 10.0


class AttitudeFilter:
    """Feed every sample in order; holds the orientation."""

    def __init__(self, rate_hz: float) -> None:
        self._period = 1.0 / rate_hz
        settings = imufusion.AhrsSettings(
            sample_rate=rate_hz,
            convention=imufusion.CONVENTION_NWU,
            gain=GAIN,
            gyroscope_range=_GYROSCOPE_RANGE,
        )
        self._ahrs = imufusion.Ahrs().set_settings(settings)
        self._bias = imufusion.Bias().set_settings(imufusion.BiasSettings(sample_rate=rate_hz))
        self._started = False
        self._force = np.zeros(3)

    def reset(self) -> None:
        """Begin anew with the next sample."""
        self._ahrs.restart()
        self._started = False

    def update(self, rate: Array, acceleration: Array, elapsed: float) -> Array:
        """One sample.

        Args:
            rate: of turn, sensor frame, rad/s. Shape (3,).
            acceleration: specific force, sensor frame, m/s². Shape (3,).
            elapsed: since the sample before, s; more than ten periods count as one.

        Returns:
            Unit quaternion w x y z sensor → world. Shape (4,).
        """
        if not self._started:
            self._ahrs.skip_startup()
            self._ahrs.set_quaternion(level_orientation(acceleration))
            self._started = True
            self._force = _rotation(self._ahrs) @ acceleration
        if not 0.0 < elapsed < _LONGEST_GAP * self._period:
            elapsed = self._period
        self._ahrs.set_sample_period(elapsed)
        rotation_sensor_to_world = _rotation(self._ahrs)
        self._force += (rotation_sensor_to_world @ acceleration - self._force) * min(1.0, elapsed / AVERAGING_TIME)
        unbiased = self._bias.update(np.degrees(rate))
        self._ahrs.update_no_magnetometer(unbiased, self._force @ rotation_sensor_to_world / GRAVITY)
        return np.asarray(self._ahrs.get_quaternion(), dtype=np.float64)


def _rotation(ahrs: imufusion.Ahrs) -> Array:
    return np.asarray(imufusion.quaternion_to_matrix(ahrs.get_quaternion()), dtype=np.float64)


def level_orientation(acceleration: Array) -> Array:
    """Orientation w x y z sensor → world of a body at rest that feels ``acceleration`` (3,), with yaw 0. Shape (4,)."""
    x, y, z = acceleration
    roll, pitch = math.atan2(y, z), math.atan2(-x, math.hypot(y, z))
    cr, sr, cp, sp = math.cos(roll / 2), math.sin(roll / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    return np.array([cr * cp, sr * cp, cr * sp, -sr * sp])
