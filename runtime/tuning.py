"""What an operator may change while the robot lives: names, bounds, and the ramp from what is to what is wanted.

The numbers in force are one row of the core's memory (``Controller.tuning``) and of every tick's record, so a replay
takes them from there. ``Tuning.step`` moves them in the loop's slack, for the next tick.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from drivers.durable import write_whole
from drivers.robot import JOINTS, Array
from runtime.config import Config
from runtime.control.gait import GAITS, gait_table
from runtime.control.kinematics import inverse, leg_geometry
from runtime.control.state import TUNING_DTYPE, build_parameters
from runtime.messages.mode import Mode
from runtime.messages.motion import PoseMessage
from runtime.messages.tuning import TuningEntry

Value = float | str
WALKED = tuple(name for name in GAITS if name != "stand")
"""Gaits that can be changed to; legs that never swing are what the mode STAND is for."""
POSE = ("roll", "pitch", "yaw", "height")
_NUMBERS = {
    name: slice(offset // 8, (offset + dtype.itemsize) // 8)
    for name, (dtype, offset, *_) in (TUNING_DTYPE.fields or {}).items()
}
_OFFSETS, _KP, _KD, _BODY = (_NUMBERS[name] for name in ("gait_offset", "kp", "kd", "body_pose"))
_HEIGHT, _SWING, _STANCE, _CYCLE, _FRACTION = (
    _NUMBERS[name].start for name in ("walking_height", "swing_time", "stance_time", "cycle_time", "swing_fraction")
)
_SHARE = _NUMBERS["policy_share"].start


class TuningError(ValueError):
    """A name or a value that cannot be: the message names it and the bound."""


@dataclass(frozen=True, slots=True)
class Tunable:
    """One number that may be changed."""

    unit: str
    own: float
    """As the robot's TOML has it."""
    low: float
    high: float


def tunables(config: Config) -> dict[str, Tunable]:
    """What may be changed on a robot, by name; the gait's name comes besides."""
    gait, gains, bounds = config.control.gait, config.control.gains, config.tuning
    height = gait.walking_height
    found = {
        "swing_time": Tunable("s", gait.swing_time, *bounds.swing_time),
        "stance_time": Tunable("s", gait.stance_time, *bounds.stance_time),
        "swing_height": Tunable("m", gait.swing_height, *bounds.swing_height),
        "walking_height": Tunable("m", height, *(height * share for share in bounds.walking_height)),
        "stance_scale": Tunable("", gains.stance_scale, *bounds.gain_scale),
        "standing_scale": Tunable("", gains.standing_scale, *bounds.gain_scale),
    }
    for letter, own, shares, unit in (
        ("kp", gains.kp, bounds.kp, "N·m/rad"),
        ("kd", gains.kd, bounds.kd, "N·m·s/rad"),
    ):
        for joint, value in zip(JOINTS, own, strict=True):
            found[f"{letter}_{joint}"] = Tunable(unit, value, *(value * share for share in shares))
    for name in ("roll", "pitch", "yaw"):
        angle = getattr(bounds, name)
        found[name] = Tunable("rad", 0.0, -angle, angle)
    found["height"] = Tunable("m", 0.0, *(height * share for share in bounds.height))
    return {
        name: Tunable(one.unit, one.own, min(one.low, one.own), max(one.high, one.own)) for name, one in found.items()
    }


class Tuning:
    """One robot's wishes and the ramp that leads there."""

    def __init__(self, config: Config, numbers: Array, saved: Path | None = None) -> None:
        """``numbers`` is ``Controller.tuning``, which is written to; ``saved`` the file that outlives a restart."""
        self.tunables = tunables(config)
        self.saved: dict[str, Value] = {}
        self._config = config
        self._numbers = numbers
        self._wanted: dict[str, float] = {name: one.own for name, one in self.tunables.items()}
        self._gait: str = config.control.gait.name
        self._file = saved
        self._geometry = leg_geometry(config.robot)
        self._nominal = build_parameters(config.robot, config.control)[0]["nominal_footholds"]
        self._dt = 1.0 / config.control.rate_hz
        self._target = np.array(numbers)
        self._step = self._speeds() * self._dt
        self._moving = False
        self._mode = Mode.DAMP

    def change(self, name: str, value: Value | None) -> Value:
        """Want another value; None wants the robot's own. Returns what is wanted now.

        Raises:
            TuningError: an unknown name, a value that is no number, or one out of its bounds.
        """
        if name == "gait":
            gait = self._config.control.gait.name if value is None else value
            if gait not in WALKED:
                raise TuningError(f"gait = {value!r}: must be one of {', '.join(WALKED)}")
            self._gait = str(gait)
        elif name in self.tunables:
            self._change_number(name, value)
        else:
            raise TuningError(f"{name!r} cannot be set; there are gait, {', '.join(self.tunables)}")
        self._aim()
        return self._gait if name == "gait" else self._wanted[name]

    def _change_number(self, name: str, value: Value | None) -> None:
        one = self.tunables[name]
        number = one.own if value is None else value
        if isinstance(number, str) or not math.isfinite(number):
            raise TuningError(f"{name} = {value!r}: must be a number, {one.low:g} to {one.high:g} {one.unit}".rstrip())
        if not one.low <= number <= one.high:
            raise TuningError(f"{name} = {number:g}: must be within {one.low:g} to {one.high:g} {one.unit}".rstrip())
        if name in POSE and number and self._mode is not Mode.STAND:
            raise TuningError(f"{name} = {number:g}: only while standing")
        self._check_reach(self._wanted | {name: number})
        self._wanted[name] = number

    def pose(self, message: PoseMessage) -> None:
        """Want a body pose, each number as a share of its bounds; what is out of reach is made smaller until it is not.

        Raises:
            TuningError: not standing.
        """
        if self._mode is not Mode.STAND:
            raise TuningError("body pose: only while standing")
        for whole in (1.0, 0.8, 0.6, 0.4, 0.2, 0.0):
            wished = {}
            for name in POSE:
                one, share = self.tunables[name], whole * getattr(message, name)
                wished[name] = share * (one.high if share > 0.0 else -one.low)
            try:
                self._check_reach(self._wanted | wished)
            except TuningError:
                continue
            self._wanted.update(wished)
            self._aim()
            return

    def step(self, mode: Mode) -> None:
        """Move the numbers on by one tick; ``mode`` is that of the tick that has just been."""
        if mode is not self._mode:
            self._enter(mode)
        if not self._moving:
            return
        numbers, way = self._numbers, self._target - self._numbers
        way[_SHARE] = 0.0
        way[_OFFSETS] -= np.round(way[_OFFSETS])  # the short way round
        numbers += np.clip(way, -self._step, self._step)
        numbers[_OFFSETS] %= 1.0
        numbers[_CYCLE] = numbers[_SWING] + numbers[_STANCE]
        if self._target[_FRACTION] > 0.0:
            numbers[_FRACTION] = numbers[_SWING] / numbers[_CYCLE]
        self._moving = bool((np.abs(way) > self._step).any())
        if not self._moving:
            share = numbers[_SHARE]
            numbers[:] = self._target
            numbers[_SHARE] = share

    def entries(self) -> list[TuningEntry]:
        """Every name with what is in force, what it moves to and its bounds; times are the gait's."""
        own = self._config.control.gait.name
        found = [TuningEntry("gait", "", self._gait, self._gait, own, None, None, self.saved.get("gait"))]
        now = self._numbers
        where = _places()
        for name, one in self.tunables.items():
            value, wanted = float(now[where[name]]), float(self._target[where[name]])
            found.append(TuningEntry(name, one.unit, value, wanted, one.own, one.low, one.high, self.saved.get(name)))
        return found

    # What outlives a restart -------------------------------------------------------------------------------------

    def load(self, note: Callable[[str], None]) -> None:
        """Want what was saved; what cannot be wanted any more is told to ``note``. At the start, before any tick."""
        if self._file is None or not self._file.is_file():
            return
        try:
            saved = msgspec.json.decode(self._file.read_bytes(), type=dict[str, Value])
        except (OSError, msgspec.MsgspecError) as error:
            note(f"saved tuning not used: {error}")
            return
        for name, value in saved.items():
            try:
                self.saved[name] = self.change(name, value)
            except TuningError as error:
                note(f"saved tuning not used: {error}")
        self._numbers[1:] = self._target[1:]  # nothing stands on it yet
        self._moving = False

    def save(self, name: str, value: Value | None) -> None:
        """Keep a value for the next start; None forgets it. Waits for the disk: not for the loop.

        Raises:
            OSError: the disk refused.
            TuningError: a pose, which is nobody's to keep.
        """
        if name in POSE:
            raise TuningError(f"{name}: a body pose is not saved")
        changed = {key: kept for key, kept in self.saved.items() if key != name}
        if value is not None:
            changed[name] = value
        if self._file is not None:
            write_whole(self._file, msgspec.json.format(msgspec.json.encode(changed)))
        self.saved = changed

    # Inside ------------------------------------------------------------------------------------------------------

    def _enter(self, mode: Mode) -> None:
        """A pose is for standing alone; and standing up ends at the robot's own height, from where the ramp goes on."""
        before, self._mode = self._mode, mode
        if before is Mode.STAND and any(self._wanted[name] for name in POSE):
            self._wanted.update(dict.fromkeys(POSE, 0.0))
            self._aim()
        if mode is Mode.STAND and before is not Mode.WALK:
            self._numbers[_HEIGHT] = self._config.control.gait.walking_height
            self._numbers[_BODY] = 0.0
            self._moving = True

    def _aim(self) -> None:
        wanted, target = self._wanted, self._target
        for name, place in _places().items():
            target[place] = wanted[name]
        gait = msgspec.structs.replace(
            self._config.control.gait,
            name=self._gait,
            swing_time=wanted["swing_time"],
            stance_time=wanted["stance_time"],
        )
        target[_OFFSETS], target[_SWING], target[_STANCE] = gait_table(gait)
        target[_CYCLE] = target[_SWING] + target[_STANCE]
        target[_FRACTION] = 0.0 if self._gait == "stand" else target[_SWING] / target[_CYCLE]
        self._moving = True

    def _speeds(self) -> Array:
        """How fast each number may move, 1/s."""
        speeds = np.full(len(self._numbers), np.inf)
        time = self._config.tuning.ramp_time
        speeds[_OFFSETS] = 0.5 / time
        speeds[_FRACTION] = 1.0 / time
        for name, place in _places().items():
            one = self.tunables[name]
            speeds[place] = (one.high - one.low) / time
        return speeds

    def _check_reach(self, wanted: dict[str, float]) -> None:
        """Whether every foot of a standing robot is within reach in this pose.

        Raises:
            TuningError: naming the joint and its range.
        """
        height = wanted["walking_height"] + wanted["height"]
        feet = np.column_stack([self._nominal, np.full(4, self._config.robot.foot_radius - height)])
        turned = feet @ _rotation(wanted["roll"], wanted["pitch"], wanted["yaw"])
        angles, reached = inverse(self._geometry, turned)
        joints = self._config.robot.joints
        lower, upper = np.array(joints.lower), np.array(joints.upper)
        pose = ", ".join(f"{name} {wanted[name]:g}" for name in ("walking_height", *POSE))
        if not reached.all():
            raise TuningError(f"{pose}: a foot would be out of the leg's reach")
        for leg, joint in np.argwhere((angles < lower) | (angles > upper)):
            raise TuningError(
                f"{pose}: puts joint [{leg}][{joint}] at {angles[leg, joint]:.2f} rad,"
                f" its range is {lower[leg, joint]:g} to {upper[leg, joint]:g}"
            )


def _places() -> dict[str, int]:
    """Where each name's number lies in the row."""
    found = {name: _NUMBERS[name].start for name in ("swing_time", "stance_time", "swing_height", "walking_height")}
    found |= {name: _NUMBERS[name].start for name in ("stance_scale", "standing_scale")}
    for letter, place in (("kp", _KP), ("kd", _KD)):
        found |= {f"{letter}_{joint}": place.start + index for index, joint in enumerate(JOINTS)}
    return found | {name: _BODY.start + index for index, name in enumerate(POSE)}


def _rotation(roll: float, pitch: float, yaw: float) -> Array:
    """Body to heading frame; ``points @ R`` takes points of the heading frame into the body's. Shape (3, 3)."""
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
