"""Commissioning's last step: what each leg's torque feigns, listened for while the robot stands under its daemon."""

from __future__ import annotations

import time

import msgspec
import numpy as np

from drivers import calibration
from drivers.calibration import Calibration
from drivers.commissioning import GRAVITY, CommissionError, contact_baseline
from runtime.config import Config
from runtime.control.records import Records
from runtime.control.state import build_parameters
from runtime.messages.mode import Mode
from station.session import Station
from station.ticks import TickStream

LISTENING_TIME = 3.0
"""s over which the forces are listened to."""
_PERIOD = 0.05


def listen(station: Station, seconds: float = LISTENING_TIME) -> Records:
    """The ticks of a robot that stands. Shape (n,).

    Raises:
        CommissionError: it does not stand, or stopped standing.
        StationError: nobody answers.
    """
    with TickStream(station) as stream:
        end, taken = time.monotonic() + seconds, [stream.take()]
        while time.monotonic() < end:
            time.sleep(_PERIOD)
            taken.append(stream.take())
    ticks = np.concatenate(taken)
    standing = ticks["mode"] == Mode.STAND
    if not len(ticks) or not standing.all():
        mode = Mode(int(ticks["mode"][~standing][0])).name if len(ticks) else "silent"
        raise CommissionError(f"robot {station.robot!r} is {mode}, not in STAND: trotd arm, trotd stand, and try again")
    return ticks


def find_baseline(config: Config, ticks: Records) -> tuple[float, float, float, float]:
    """What each leg feigns, N, from the ticks of a robot that stands.

    Raises:
        CommissionError: too much to be believed.
    """
    parameters = build_parameters(config.robot, config.control)[0]
    feet = np.median(ticks["feet"], axis=0)[:, :2]
    return contact_baseline(ticks["contact_force"][:, :, 2], feet, config.robot.mass * GRAVITY, parameters["com"][:2])


def with_baseline(known: Calibration, baseline: tuple[float, float, float, float]) -> Calibration:
    """``known`` with another baseline, sealed."""
    return calibration.seal(msgspec.structs.replace(known, contact_baseline=baseline))


def carried_over(before: Calibration, found: Calibration) -> Calibration:
    """``found`` with the baseline of the one before it, if the joints are still the same."""
    same = all(getattr(before, name) == getattr(found, name) for name in ("id", "bus", "direction", "offset", "body"))
    return with_baseline(found, before.contact_baseline) if same else found
