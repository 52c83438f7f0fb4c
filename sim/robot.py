"""``World`` behind the ``Robot`` protocol: the simulated body that the daemon drives like the real one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from drivers.errors import NotConnected
from drivers.robot import JointCommand, Measurement
from sim.scenario import Scenario
from sim.world import World


class SimRobot:
    """One simulated robot. It never sleeps: whoever calls ``exchange`` sets the pace.

    With a ``clock`` (``time.monotonic`` under the daemon's ticker) measurements bear its time, as the hardware's do;
    without one they bear simulated time, for free-running episodes.
    """

    def __init__(
        self,
        build_world: Callable[[], World],
        scenario: Scenario | None = None,
        clock: Callable[[], float] | None = None,
    ) -> None:
        """Keep what ``connect`` needs; nothing starts yet."""
        self._build_world = build_world
        self._scenario = scenario or Scenario()
        self._clock = clock
        self._world: World | None = None

    @property
    def world(self) -> World:
        """The world, for its truth and its scenario's rewards.

        Raises:
            NotConnected: before ``connect`` or after ``close``.
        """
        if self._world is None:
            raise NotConnected("the simulated robot is not connected")
        return self._world

    async def connect(self) -> None:
        """Start the simulator with the scenario; connecting twice starts it over.

        Raises:
            SimulatorMissing: PyBullet cannot be imported.
        """
        await self.close()
        world = self._build_world()
        try:
            world.reset(self._scenario)
        except BaseException:
            world.close()
            raise
        self._world = world

    async def exchange(self, command: JointCommand) -> Measurement:
        """Live for one period under ``command``; returns what the sensors read when it arrived."""
        stamp = None if self._clock is None else self._clock()
        measurement = self.world.step(command)
        if stamp is None:
            return measurement
        return replace(measurement, stamp=stamp, imu=replace(measurement.imu, stamp=stamp))

    def push(self, force: tuple[float, float, float], duration: float) -> None:
        """Push the body from now on: N in the world frame, s."""
        self.world.push(force, duration)

    @property
    def troubles(self) -> dict[str, int]:
        """None: there are no wires."""
        return {}

    async def close(self) -> None:
        """Release the simulator."""
        world, self._world = self._world, None
        if world is not None:
            world.close()
