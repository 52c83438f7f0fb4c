"""From hands to the robot: what the sticks and buttons mean now. Pure: no clock, no device, no network.

After anything was lost, and at the start of every walk, nothing moves until the sticks were centred once.
"""

from __future__ import annotations

from collections.abc import Sequence

from runtime.messages.mode import Mode, Request
from runtime.messages.motion import PoseMessage
from station.pad import GAITS, Sticks

Velocity = tuple[float, float, float]
STILL: Velocity = (0.0, 0.0, 0.0)
LEVEL = PoseMessage(0.0, 0.0, 0.0, 0.0)
REQUESTS = {
    "idle": Request.DAMP,
    "hold": Request.STAND,
    "sit": Request.SIT,
    "stand": Request.STAND,
    "walk": Request.WALK,
    "clear": Request.CLEAR,
}


class Driving:
    """The rules of one driver."""

    def __init__(self, forward: float, sideways: float, turn: float, gaits: Sequence[str] = GAITS) -> None:
        """``forward``, ``sideways`` in m/s and ``turn`` in rad/s are what full sticks ask for."""
        self.gaits = list(gaits)
        """The gait button goes through them; the first is the one in use."""
        self.posing = False
        """The sticks move the standing body."""
        self._pose = LEVEL
        self.full: Velocity = (forward, sideways, turn)
        self.centred = False
        """The sticks were centred since the last loss or the start of the walk."""

    def lose(self) -> None:
        """The pad, the link or the robot's ear was lost for a while."""
        self.centred = False

    def velocity(self, sticks: Sticks | None, mode: Mode | None) -> Velocity | None:
        """What to command: m/s, m/s, rad/s; None when there is nothing to say.

        Args:
            sticks: where they are; None while that is not known.
            mode: the robot's last word; None when it has not been heard for a while.
        """
        if mode is not Mode.WALK:
            if not self.posing:
                self.lose()
            return None
        if sticks is None:
            self.lose()
            return STILL
        if sticks.centred:
            self.centred = True
        elif not sticks.held:
            self.lose()
        if not (self.centred and sticks.held):
            return STILL
        forward, sideways, turn = self.full
        return sticks.forward * forward, sticks.left * sideways, sticks.turn * turn

    def toggle_pose(self, mode: Mode | None) -> PoseMessage | None:
        """The pose button: the sticks are the body's, or the body goes level again. Returns what to say now."""
        self.lose()
        self.posing = mode is Mode.STAND and not self.posing
        self._pose = LEVEL
        return None if self.posing else LEVEL

    def pose(self, sticks: Sticks | None, mode: Mode | None) -> PoseMessage | None:
        """What body pose to ask for, in shares of the bounds; None when there is nothing to say.

        Left stick: pitch and roll, as the body should lean; right stick: yaw and height. Without the dead-man the body
        stays as it is.
        """
        if mode is not Mode.STAND:
            self.posing = False
        if not self.posing or sticks is None:
            return None
        if sticks.level:
            self.centred = True
        if self.centred and sticks.held:
            self._pose = PoseMessage(-sticks.turn + 0.0, sticks.forward, sticks.left, sticks.rise)
        return self._pose

    def next_gait(self) -> str:
        """The gait button: the next of the list."""
        self.gaits.append(self.gaits.pop(0))
        return self.gaits[0]

    @staticmethod
    def requests(button: str, sticks: Sticks | None, armed: bool) -> list[Request]:
        """What a pressed button asks for; standing up with the dead-man held arms first."""
        wish = REQUESTS[button]
        if button == "stand" and not armed and sticks is not None and sticks.held:
            return [Request.ARM, wish]
        return [wish]
