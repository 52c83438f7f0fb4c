"""How a sensor sits in the body: its axes turned into the body's."""

from __future__ import annotations

import numpy as np

from drivers.robot import Array
from drivers.wiring import Quaternion


class Mounting:
    """Turns what a sensor says into the body's frame."""

    def __init__(self, mount: Quaternion) -> None:
        """``mount``: w x y z that turns sensor into body.

        Raises:
            ValueError: not a unit quaternion.
        """
        norm = float(np.linalg.norm(mount))
        if not abs(norm - 1.0) < 1e-3:
            raise ValueError(f"mount = {mount}: a unit quaternion is wanted, its norm is {norm:.4g}")
        w, x, y, z = np.array(mount) / norm
        self.rotation_sensor_to_body: Array = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        # Right multiplication by the mount's conjugate, as a matrix.
        self._conjugate: Array = np.array([[w, x, y, z], [-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]])

    def vector(self, vector: Array) -> Array:
        """A vector (3,) of the sensor's frame, in the body's; what is not finite stays so, and the guard says it."""
        with np.errstate(invalid="ignore"):
            turned: Array = self.rotation_sensor_to_body @ vector
        return turned

    def orientation(self, orientation: Array) -> Array:
        """Sensor → world (4,) as body → world (4,); what is not finite stays so."""
        with np.errstate(invalid="ignore"):
            turned: Array = self._conjugate @ orientation
        return turned
