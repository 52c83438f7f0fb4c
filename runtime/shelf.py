"""The policies that a daemon knows: the active one, those before it, the proven ones, and the one on the disk."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from drivers.durable import write_whole
from runtime import policies
from runtime.control.policy import Policy, encode_policy
from runtime.cycle import Cycle
from runtime.messages.policy import PolicyEntry

GOOD = 4
"""Policies that proved good and can be rolled back to."""


@dataclass(frozen=True)
class PolicyFile:
    """A verified policy and the bytes that it came as."""

    policy: Policy
    data: bytes

    @cached_property
    def sha256(self) -> str:
        """Digest of the file, in hex."""
        return hashlib.sha256(self.data).hexdigest()


class Shelf:
    """One robot's policies. Lives on the loop's thread; only the disk is written to from another."""

    def __init__(
        self,
        cycle: Cycle,
        folder: Path,
        robot: str,
        note: Callable[[int, bytes], None] = lambda _generation, _data: None,
        data: bytes = b"",
    ) -> None:
        """``note`` is told the generation and the file of every policy that becomes active.

        ``data`` is the file that the cycle's policy was read from; as ``encode_policy`` makes it, if not given.
        """
        self.active = PolicyFile(cycle.policy, data or encode_policy(cycle.policy))
        self.good = [self.active]
        """Proved good, or given at the start; the newest last."""
        self._cycle, self._note = cycle, note
        note(cycle.generation, self.active.data)
        self._robot = robot
        self._path = folder / "policies" / f"{robot}.json"

    def activate(self, file: PolicyFile, share: float = 1.0) -> None:
        """Have the cycle take a policy, between two ticks; below a ``share`` of one the one before has the rest."""
        self._cycle.swap_policy(file.policy, share)
        self.active = file
        self._note(self._cycle.generation, file.data)

    def approve(self, file: PolicyFile) -> None:
        """Count a policy as good, and as the one to go back to."""
        others = [other for other in self.good if other.sha256 != file.sha256]
        self.good = [*others[-GOOD + 1 :], file]

    def disapprove(self, file: PolicyFile) -> None:
        """A policy that proved good failed later."""
        self.good = [other for other in self.good if other.sha256 != file.sha256] or self.good

    def last_good(self) -> PolicyFile | None:
        """The newest good policy that is not the active one; None where there is none."""
        return next((file for file in reversed(self.good) if file.sha256 != self.active.sha256), None)

    def keep(self, file: PolicyFile, then: Callable[[str], None]) -> None:
        """Remember a policy for the next start, on a thread; ``then`` gets what went wrong, or nothing, on the loop."""
        writing = asyncio.get_running_loop().run_in_executor(None, write_whole, self._path, file.data)

        def written(done: asyncio.Future[None]) -> None:
            error = None if done.cancelled() else done.exception()
            then("" if error is None else f"not kept: {error}")

        writing.add_done_callback(written)

    def load_kept(self) -> str:
        """Take the policy that was kept, if there is one; returns why it cannot be used."""
        if not self._path.is_file():
            return ""
        try:
            data = self._path.read_bytes()
            file = PolicyFile(policies.decode(data, self._robot, str(self._path)), data)
        except (OSError, policies.PolicyError) as error:
            return f"kept policy not used: {error}"
        self.activate(file)
        self.approve(file)
        return ""

    def on_disk(self) -> list[PolicyEntry]:
        """The kept policy and the shipped ones of this robot; reads files, so not for the loop."""
        found = []
        for role, paths in (("kept", [self._path]), ("shipped", sorted(policies.SHIPPED.glob("*.json")))):
            for path in paths:
                try:
                    data = path.read_bytes()
                    file = PolicyFile(policies.decode(data, self._robot, str(path)), data)
                except (OSError, policies.PolicyError):
                    continue  # not there, or another robot's
                found.append(_entry(role, file))
        return found

    def entries(self) -> list[PolicyEntry]:
        """The active and the good ones; what lies on the disk says ``on_disk``."""
        last = self.last_good()
        listed = [_entry("active", self.active)]
        others = [file for file in reversed(self.good) if file.sha256 != self.active.sha256]
        listed += [_entry("previous" if file is last else "good", file) for file in others]
        return listed


def _entry(role: str, file: PolicyFile) -> PolicyEntry:
    made = file.policy.provenance.get("made", "")
    return PolicyEntry(role, file.policy.name, file.sha256, str(made) if made else "unknown")
