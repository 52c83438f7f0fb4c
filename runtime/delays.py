"""How late a message is, by two clocks that know nothing of each other: against the quickest of its sender's last few.

After a gap in the network everything that waited comes at once. A command among it is as old as it was long on the way,
not as young as its arrival.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable

RECENT = 250
"""Messages among which the quickest is sought: more than may come at once after a gap; a clock that was set is
believed again after so many."""
SENDERS = 16
"""Known at once; those that were silent longest are forgotten."""


class Delays:
    """The senders of one kind of message."""

    def __init__(self) -> None:
        self._recent: dict[Hashable, deque[float]] = {}

    def lateness(self, sender: Hashable, sent: float, arrived: float) -> float:
        """Seconds that a message was longer on its way than the quickest of its sender's.

        Args:
            sender: who it is.
            sent: s, the sender's clock.
            arrived: s, ours; any steady one.
        """
        recent = self._recent.pop(sender, None) or deque(maxlen=RECENT)
        self._recent[sender] = recent  # the newest last
        while len(self._recent) > SENDERS:
            del self._recent[next(iter(self._recent))]
        recent.append(arrived - sent)
        return recent[-1] - min(recent)
