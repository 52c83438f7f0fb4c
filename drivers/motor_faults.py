"""Which of the twelve motors does not obey: what only shows over several ticks, as fault codes beside their own."""

from __future__ import annotations

from collections.abc import Sequence, Set

import numpy as np
from numpy.typing import NDArray

from drivers.moteus import Reading
from drivers.motor_codec import FAULT, MODE, MotorCodec

RESTARTED = 16
"""Fault code of ours: a motor that had been running is back at its beginning. Its zero may be lost."""
NOT_STARTING = 17
"""Fault code of ours: a motor that gets commands but does not begin to obey."""
SILENT = 18
"""Fault code of ours: a motor missed more replies in a row than are coasted over."""
START_TIME = 0.25
"""s that a motor may take from stopped to running."""


class MotorFaults:
    """Twelve motors' silence, restarts and failures to begin."""

    def __init__(self, codec: MotorCodec, coasted_ticks: int) -> None:
        self._codec, self._coasted = codec, coasted_ticks
        self.reset()

    def reset(self) -> None:
        """Forget every fault."""
        self._running = [False] * 12
        self._missed = [0] * 12
        self._latched: dict[int, int] = {}
        self._commanded_since: float | None = None

    @property
    def commanded(self) -> bool:
        """Whether the motors are being commanded, so that one which does not run is at fault."""
        return self._commanded_since is not None

    @property
    def all_silent(self) -> bool:
        """Whether every motor missed more replies in a row than are coasted over."""
        return min(self._missed) > self._coasted

    def begin_commands(self, now: float) -> None:
        """Commands follow from ``now`` on, s."""
        self._commanded_since = now

    def end_commands(self) -> None:
        """The motors were stopped; restarts stay held against them until ``reset``."""
        self._commanded_since = None
        self._running = [False] * 12

    def note_answers(self, answered: Set[int]) -> None:
        """Count, after a tick, what did not come in it."""
        if len(answered) < 12:
            self._missed = [0 if index in answered else count + 1 for index, count in enumerate(self._missed)]
        else:
            self._missed = [0] * 12

    def note_late_answer(self, index: int) -> None:
        """It came between two ticks: late, but not silent."""
        self._missed[index] = 0

    def judge(self, readings: Sequence[Reading], now: float) -> NDArray[np.int32]:
        """The fault codes at ``now`` s; 0 for none. Shape (12,)."""
        faults = np.zeros(12, dtype=np.int32)
        running, coasted = self._codec.running, self._coasted
        for index, reading in enumerate(readings):
            if reading[MODE] == running and index not in self._latched and self._missed[index] <= coasted:
                self._running[index] = self._commanded_since is not None
            else:
                faults[index] = self._fault(index, int(reading[MODE]), int(reading[FAULT]), now)
        return faults

    def describe(self, code: int) -> str:
        """A fault code in words."""
        if code == RESTARTED:
            return "it restarted by itself: check supply and zero"
        if code == SILENT:
            return f"it missed more than {self._coasted} replies in a row: cable? supply?"
        if code == NOT_STARTING:
            return f"it gets commands but did not begin to obey within {START_TIME} s"
        return self._codec.describe_fault(code)

    def _fault(self, index: int, mode: int, fault: int, now: float) -> int:
        if index in self._latched:
            return self._latched[index]
        if self._missed[index] > self._coasted:
            return SILENT
        if mode == self._codec.running:
            return 0
        if mode not in self._codec.starting:
            return self._codec.fault(mode, fault)
        if self._commanded_since is None:
            return 0
        if self._running[index]:
            self._latched[index] = RESTARTED
            return RESTARTED
        return NOT_STARTING if now - self._commanded_since > START_TIME else 0
