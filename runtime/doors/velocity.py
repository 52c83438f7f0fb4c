"""The door of velocity commands: the newest wins, and sticks that were not centred after a silence move nothing."""

from __future__ import annotations

import math
import time

import numpy as np
import zenoh

from runtime.config import Config
from runtime.control.records import VelocityCommand
from runtime.delays import Delays
from runtime.doors.answers import Doors
from runtime.doors.crossing import Crossing, read
from runtime.messages.decoding import MessageError
from runtime.messages.motion import VelocityMessage, decode_velocity

SHED = "velocity superseded"
"""Under this name velocity commands are counted that a newer one overtook before a tick could take them."""


class VelocityDoor:
    """``command/velocity`` of one robot."""

    def __init__(self, config: Config, key: str, crossing: Crossing, doors: Doors) -> None:
        self._bounds, self._expiry = config.control.bounds, config.command.expiry
        self._key, self._crossing, self._doors = key, crossing, doors
        self._newest: VelocityCommand | None = None
        self._heard = -math.inf
        self._locked = True
        """The sticks were not centred since commands came again."""
        self._delays = Delays()

    def hear(self, sample: zenoh.Sample) -> None:
        """The newest wins: one that the loop has not taken yet is replaced, so that a flood costs the loop nothing."""
        stamp = time.monotonic()
        try:
            message = decode_velocity(read(sample.payload), self._bounds.linear_velocity, self._bounds.yaw_rate)
        except MessageError as error:
            self._crossing.refuse(self._key, str(error))
            return
        if message.sticks and not self._centred(stamp, message):
            message = VelocityMessage((0.0, 0.0), 0.0)
        self._heard = stamp
        sent = sample.timestamp
        if sent is not None:  # it counts from when it was sent: after a gap, what waited comes at once
            stamp -= self._delays.lateness(str(sent.get_id()), sent.get_time().timestamp(), stamp)
        waiting, self._newest = self._newest, VelocityCommand(stamp, np.array(message.linear), message.yaw_rate)
        if waiting is None:
            self._crossing.cross(self._take_newest)
        else:
            self._crossing.refused[SHED] += 1

    def _centred(self, stamp: float, message: VelocityMessage) -> bool:
        """Whether sticks may move the robot: since the last silence they have to have been in the middle once."""
        silence = stamp - self._heard
        if silence > self._expiry:
            self._locked = True
        if not any((*message.linear, message.yaw_rate)):
            self._locked = False
        if self._locked:
            self._crossing.refuse(self._key, "centre the sticks: no command had come for a while")
        return not self._locked

    def _take_newest(self) -> None:
        newest, self._newest = self._newest, None
        if newest is not None:
            self._doors.take_velocity(newest)
