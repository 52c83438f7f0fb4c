"""A robot's outing in the simulator as fast as it goes, without a daemon: the cycle, a body and the flight recorder."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drivers.robot import damp_command
from runtime import config
from runtime.control.policy import encode_policy
from runtime.control.records import VelocityCommand
from runtime.cycle import Cycle
from runtime.flight_log import versions
from runtime.messages.mode import Mode, Request
from runtime.policies import find_policy, load
from runtime.recorder import Recorder
from runtime.recording import Header, layout
from runtime.tick_record import Wake

if TYPE_CHECKING:
    from sim.scenario import Scenario

LIES_DOWN = 1.2
"""s until a robot that was set down lies still."""


class Outing:
    """One robot from damp to wherever the script leads it; ``seconds`` of it are kept."""

    def __init__(self, folder: Path, robot: str = "stoch3", seconds: float = 60.0) -> None:
        """Set it down.

        Raises:
            SimulatorMissing: PyBullet is not here.
        """
        from sim.scenario import Scenario
        from sim.world import World

        path = config.find_robot(robot)
        self.toml = path.read_text()
        self.config = config.load(path)
        self.policy = load(find_policy(self.config.control.policy), self.config.robot.name)
        control = self.config.control
        self.world = World(self.config.robot, control.rate_hz, control.gait.walking_height)
        self.recorder = Recorder(folder, control.rate_hz, seconds, 100, 2_000_000_000)
        self.set_down(Scenario())
        self.after: Callable[[], None] = lambda: None
        """Called after every tick, in the place of the daemon's slack."""
        self.policies: dict[int, str] = {}
        """Those before the active one, by generation."""

    def set_down(self, scenario: Scenario) -> None:
        """Onto the ground of ``scenario``, damped, with a blank memory."""
        self.cycle = Cycle(self.config, self.policy)
        self.measurement = self.world.reset(scenario)
        self.cycle.warm_up(self.measurement)
        self.command = damp_command(self.config.damp.kd)
        self.recorder.events.clear()
        self.index = 0
        """Ticks so far."""

    def run(self, seconds: float, velocity: tuple[float, float, float] | None = None) -> None:
        """Live on, under one velocity command if any."""
        rate = self.config.control.rate_hz
        for _ in range(round(seconds * rate)):
            self.index += 1
            now = self.index / rate
            if velocity is not None:
                self.cycle.command_velocity(VelocityCommand(now - 0.001, np.array(velocity[:2]), velocity[2]))
            self.measurement = self.world.step(self.command)
            self.command = self.cycle.step(Wake(self.index, now, 1.0 / rate, 5e-5, 0), self.measurement)
            self.cycle.tick["compute"] = 2e-4
            self._keep()
            self.after()

    def _keep(self) -> None:
        self.recorder.keep(self.cycle.tick)
        if self.recorder.count % self.recorder.keyframe_every == 1:
            self.recorder.keep_keyframe(self.cycle.remember())
        while self.cycle.events:
            self.recorder.keep_event(self.cycle.events.popleft())

    def ask(self, *wishes: Request) -> None:
        """Requests between two ticks.

        Raises:
            RuntimeError: one was not accepted; the message says why.
        """
        for wish in wishes:
            answer, words = self.cycle.request(wish, self.measurement)
            if not answer.accepted:
                raise RuntimeError(f"{wish.value}: {words}")

    def until(self, reached: Callable[[], bool], seconds: float = 10.0) -> None:
        """Run until ``reached`` says so.

        Raises:
            RuntimeError: it does not within ``seconds``.
        """
        while not reached():
            if seconds <= 0.0:
                raise RuntimeError(f"still {self.cycle.state}")
            self.run(0.1)
            seconds -= 0.1

    def stand(self) -> None:
        """From lying to standing."""
        self.run(LIES_DOWN)
        self.ask(Request.ARM, Request.STAND)
        self.until(lambda: self.cycle.state.mode is Mode.STAND)

    def header(self, reason: str = "test") -> Header:
        """All that a recording says about itself."""
        return Header(
            robot=self.config.robot.name,
            robot_toml=self.toml,
            policy=encode_policy(self.policy).decode(),
            rate_hz=self.config.control.rate_hz,
            reason=reason,
            written=time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            versions=versions(),
            layout=layout(),
            itemsize=self.cycle.tick.dtype.itemsize,
            events=list(self.recorder.events),
            keyframes=self.recorder.keyframes(),
            policies=self.policies,
        )

    def write(self, stem: str = "walk") -> Path:
        """What the recorder holds, as a file."""
        return self.recorder.write(self.header(), stem)
