"""What stands behind the doors: the daemon's answers, and the keys that a body adds to them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from runtime.audition import Outcome
from runtime.control.records import VelocityCommand
from runtime.messages.fault import FaultRecord
from runtime.messages.mode import ModeReply, Request
from runtime.messages.motion import PoseMessage
from runtime.messages.policy import PolicyEntry
from runtime.messages.status import Status
from runtime.messages.tuning import TuningEntry, TuningReply, TuningRequest
from runtime.shelf import PolicyFile


class Doors(Protocol):
    """What the daemon answers, always on the loop's thread."""

    def take_velocity(self, command: VelocityCommand) -> None: ...  # noqa: D102
    def take_request(self, wish: Request) -> ModeReply: ...  # noqa: D102
    def take_pose(self, pose: PoseMessage) -> None: ...  # noqa: D102
    def take_tuning(self, change: TuningRequest, done: Future[TuningReply]) -> None: ...  # noqa: D102
    def list_tuning(self) -> list[TuningEntry]: ...  # noqa: D102
    def lose_operator(self) -> None: ...  # noqa: D102
    def offer_policy(self, file: PolicyFile, immediate: bool, done: Future[Outcome]) -> None: ...  # noqa: D102
    def roll_back(self, done: Future[Outcome]) -> None: ...  # noqa: D102
    def active_policy(self) -> PolicyFile: ...  # noqa: D102
    def list_policies(self) -> Callable[[], list[PolicyEntry]]: ...  # noqa: D102
    def refuse(self, door: str, why: str) -> None: ...  # noqa: D102
    def fault_history(self) -> list[FaultRecord]: ...  # noqa: D102
    def record_now(self, reason: str, done: Future[Path]) -> None: ...  # noqa: D102
    def status(self) -> Status: ...  # noqa: D102


@dataclass(frozen=True, slots=True)
class Channel:
    """A key beyond the robot's own, for bodies that know or can do more (the simulator)."""

    key: str
    produce: Callable[[], bytes] | None = None
    """Called on the loop with every batch of ticks."""
    accept: Callable[[bytes], None] | None = None
    """Called on the loop with every payload; raises MessageError to refuse it."""
