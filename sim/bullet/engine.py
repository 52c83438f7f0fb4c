"""One physics client of PyBullet, and the only import of it."""

from __future__ import annotations

import platform
from pathlib import Path
from typing import Any

from sim.bullet.native import find_client
from sim.errors import SimulatorMissing
from sim.quiet import silenced
from sim.sensing import GRAVITY


class Engine:
    """A physics client in this process: ``connect``, then ``clear`` before anything is built, ``close`` at the end."""

    def __init__(self) -> None:
        """Import PyBullet.

        Raises:
            SimulatorMissing: it cannot be imported.
        """
        self.bullet = _import_bullet()
        """PyBullet's module."""
        self.client = -1
        """Its number for us; negative while there is none."""
        self.address = 0
        """Where it lies, for ``native``; 0 where PyBullet does not tell."""

    def connect(self) -> None:
        """Start a simulation of our own."""
        self.client = self.bullet.connect(self.bullet.DIRECT)
        self.address = find_client(Path(self.bullet.__file__), self.client)

    def clear(self, dt: float) -> None:
        """Remove every body, so that what is built depends on nothing that was; physics steps of ``dt`` s follow."""
        self.bullet.resetSimulation(physicsClientId=self.client)
        self.bullet.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=self.client)
        self.bullet.setPhysicsEngineParameter(
            fixedTimeStep=dt, deterministicOverlappingPairs=1, enableFileCaching=0, physicsClientId=self.client
        )

    def step(self) -> None:
        """Do one physics step."""
        self.bullet.stepSimulation(physicsClientId=self.client)

    def close(self) -> None:
        """Release the client. Harmless when repeated."""
        if self.client >= 0:
            self.bullet.disconnect(physicsClientId=self.client)
            self.client = -1


def _import_bullet() -> Any:
    try:
        with silenced():
            import pybullet
    except ImportError as error:
        python = f"Python {platform.python_version()} on {platform.machine()}"
        raise SimulatorMissing(
            f"no PyBullet for {python} ({error}): the simulator needs an environment made with Python 3.11 on x86_64"
        ) from error
    return pybullet
