"""What can go wrong with the simulated body.

The tree::

    SimError
    ├── SimulatorMissing   PyBullet is not there (also an ImportError)
    ├── PhysicsError       PyBullet did not build what the model says
    └── UrdfError          a URDF cannot be read or is another robot's (also a ValueError)
"""

from __future__ import annotations


class SimError(Exception):
    """Root of everything the simulator raises."""


class SimulatorMissing(SimError, ImportError):
    """PyBullet is not installed, or has no wheel for this Python."""


class PhysicsError(SimError):
    """The physics engine did not build what the model says."""


class UrdfError(SimError, ValueError):
    """A URDF that cannot be read or does not fit its robot's TOML."""
