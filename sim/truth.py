"""The exact state of the simulated robot, beside what its sensors say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.robot import Array


@dataclass(frozen=True, slots=True)
class Truth:
    """For rewards and tests; never for the controller. World frame."""

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
