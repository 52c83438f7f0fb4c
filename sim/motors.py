"""Twelve servos: the one motor law at every physics step, its limits, its dry friction and the way commands reach it.

Plain floats in lists: at twelve joints they cost a third of numpy, and the physics engine wants lists.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import fields
from math import copysign
from typing import Any

import numpy as np

from drivers.description import JointLimits
from drivers.robot import Array, JointCommand
from sim.sensing import STICKING_SPEED, motor_law

Encoder = Callable[[float, float], tuple[float, float]]
"""From a joint's position rad and velocity rad/s to what its servo reads instead."""


_LIMP = np.zeros((3, 12))
FOREVER = 2**62


class Motors:
    """The servos of one episode. They are without torque until the first command reaches them."""

    def __init__(self, limits: JointLimits) -> None:
        self._limits = limits
        self._friction = limits.friction_torque
        self.peak: Array = np.empty(12)
        """Knob: torque that each joint's motor reaches, N·m; 0 where none arrives at the joint."""
        self.encoders: dict[int, Encoder] = {}
        """Knob: joints (0 to 11) whose servo misreads its shaft: its own loop and its reports believe this."""
        self.reversed: set[int] = set()
        """Knob: joints whose motor turns the other way than it is asked."""
        self.watched = False
        """Knob: every physics step passes through ``drive``, for somebody who looks at it."""
        self.reset(1.0, 0)

    def reset(self, strength: float, delay: int) -> None:
        """Start an episode.

        Args:
            strength: share of the peak torque that the motors reach.
            delay: physics steps between a command's arrival and its effect.
        """
        self.peak = np.array([strength * peak for peak in self._limits.peak_torque] * 4)
        self.encoders, self.reversed = {}, set()
        self._delay = delay
        self._law: Array = _LIMP
        self._pending: deque[tuple[int, Array]] = deque()
        self.torque: Sequence[float] | Array = [0.0] * 12
        """What the motors exert on the joints since the last physics step, N·m."""

    def take(self, command: JointCommand, step: int) -> None:
        """Receive ``command`` at physics step ``step``.

        Raises:
            ValueError: a number in ``command`` is not finite.
        """
        self._pending.append((step + self._delay, _law(command)))

    @property
    def plain(self) -> bool:
        """Whether the torque is the law's within its peak and nothing else, and nobody looks at it."""
        return not (self.encoders or self.reversed or self.watched)

    def law_at(self, step: int) -> tuple[Array, int]:
        """The law of physics step ``step`` and the first step that has another. Shape (3, 12), see ``motor_law``."""
        pending = self._pending
        while pending and pending[0][0] <= step:
            self._law = pending.popleft()[1]
        return self._law, pending[0][0] if pending else FOREVER

    def drive(self, step: int, states: Sequence[Any]) -> list[float]:
        """Torque on each joint in physics step ``step``, motor and dry friction together, N·m.

        Args:
            step: counted from the reset.
            states: position rad and velocity rad/s of each joint, as the first two entries of twelve tuples.
        """
        law, _ = self.law_at(step)
        read = self.read(states) if self.encoders else states
        exerted = [
            torque if -peak < (torque := c - p * state[0] - d * state[1]) < peak else copysign(peak, torque)
            for state, c, p, d, peak in zip(read, *law.tolist(), self.peak.tolist(), strict=True)
        ]
        for joint in self.reversed:
            exerted[joint] = -exerted[joint]
        self.torque = exerted
        friction, bound = self._friction, STICKING_SPEED
        slope = friction / bound
        return [
            torque - (speed * slope if -bound < (speed := state[1]) < bound else copysign(friction, speed))
            for torque, state in zip(exerted, states, strict=True)
        ]

    @property
    def misreads(self) -> bool:
        """Whether any servo believes or reports what is not so."""
        return bool(self.encoders or self.reversed)

    def read(self, states: Sequence[Any]) -> list[tuple[float, float]]:
        """Position rad and velocity rad/s of each joint as its servo knows them."""
        encoders = self.encoders
        return [
            encoders[joint](state[0], state[1]) if joint in encoders else (state[0], state[1])
            for joint, state in enumerate(states)
        ]

    def reported(self) -> list[float]:
        """Torque of each joint as its servo reports it, N·m."""
        return [-torque if joint in self.reversed else torque for joint, torque in enumerate(self.torque)]


def _law(command: JointCommand) -> Array:
    law = np.empty((3, 12))
    if not motor_law(command.position, command.velocity, command.kp, command.kd, command.torque, law):
        names = [item.name for item in fields(command) if not np.isfinite(getattr(command, item.name)).all()]
        raise ValueError(f"joint command {', '.join(names) or 'torque'}: not finite")
    return law
