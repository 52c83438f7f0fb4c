"""``trotd commission``: a new robot understood step by step, resumable, each step undone at will.

By hand, the motors stay without torque: people turn the joints, the encoders tell what moved. By wiggle, one motor
after the other turns a little by its own power: its encoder tells which way, people tell what moved. What a step found
is kept in a progress file; all together it becomes the robot's calibration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal, Protocol

import msgspec
import numpy as np
from msgspec import Meta

from drivers import calibration
from drivers.calibration import VERSION, Calibration, fingerprint
from drivers.commissioning import (
    CommissionError,
    FoundJoint,
    MotorPlace,
    assign,
    find_moved,
    joint_name,
    mount_from_gravity,
    range_problem,
    zeros_from_pose,
    zeros_from_stops,
)
from drivers.description import UNDECODABLE
from drivers.durable import write_whole
from drivers.robot import JOINTS, LEGS, Array
from drivers.wiring import Direction, MotorsConfig
from runtime.config import Config

Step = Literal["joints", "zeros", "mount"]
STEPS: tuple[Step, ...] = ("joints", "zeros", "mount")
POSES = ("level", "nose down by 20 to 40 degrees", "left side down by 20 to 40 degrees")
MOTIONS = ("foot to the left", "foot backwards", "shank backwards")
"""What a positive turn about +x and +y looks like: abduction, hip, knee (body x forward, y left, z up)."""
PROGRESS_VERSION: Literal[2] = 2
NAMES = tuple(joint_name(leg, joint) for leg in range(4) for joint in range(3))
SPARE = "none"
"""The answer for a motor that moves no joint of ours."""
_TRIES = 3


@dataclass(frozen=True, slots=True)
class Task:
    """What a person is asked to do, or to say."""

    act: Literal["let go", "turn", "stop", "jig", "tilt", "watch", "say"]
    words: str
    leg: int = 0
    joint: int = 0
    index: int = 0
    """Which end stop, 0 or 1; which of ``POSES``."""
    angles: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of the jig: abduction, hip, knee, rad."""


class Readings(Protocol):
    """What the wires tell."""

    def motors(self) -> dict[MotorPlace, float]:
        """Output angle of every motor on the buses, rad."""
        ...

    def force(self) -> Array:
        """What the accelerometer feels, sensor frame, m/s². Shape (3,)."""
        ...

    def wiggle(self, place: MotorPlace) -> float:
        """How far the motor turned by its own power, rad."""
        ...


class Progress(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """What was found so far."""

    version: int = PROGRESS_VERSION
    robot: str
    joints: dict[str, tuple[int, int, Direction]] = {}
    """Joint's name → bus, id, direction."""
    spare: list[tuple[int, int]] = []
    """Bus and id of motors that move no joint."""
    zeros: dict[str, Annotated[list[float], Meta(min_length=1, max_length=2)]] = {}
    """Joint's name → the motor's angle at both end stops, or in the jig alone, rad."""
    jig: Annotated[list[float], Meta(max_length=3)] = []
    """The joints' angles in the jig; empty where the end stops tell."""
    mount: Annotated[list[tuple[float, float, float]], Meta(max_length=3)] = []
    """What the accelerometer felt in each of ``POSES``, sensor frame, m/s²."""


class Commission:
    """One robot's commissioning.

    Args:
        config: of the robot; its ids, buses, signs, zeros and mount are not believed.
        motors: the wiring's part that is: protocol, gear, model.
        path: of the progress file.
        readings: of the wires.
        ask: shows a task, and returns when it is done, with what was answered.
        wiggle: motors turn by their own power instead of people's.
        jig: the joints' angles, rad, abduction hip knee, that a jig holds all legs at, instead of end stops.
    """

    def __init__(
        self,
        config: Config,
        motors: MotorsConfig,
        path: Path,
        readings: Readings,
        ask: Callable[[Task], str],
        *,
        wiggle: bool = False,
        jig: tuple[float, float, float] | None = None,
    ) -> None:
        self.config, self.motors, self.path = config, motors, path
        self._readings, self._ask, self._wiggle, self._jig = readings, ask, wiggle, jig
        self.progress = self._resume()

    def run(self) -> Calibration:
        """Do what is left, and put it together.

        Raises:
            CommissionError: a step did not give an answer to trust; run again to go on from there.
        """
        if self._wiggle:
            self._wiggle_joints()
        self._find_joints()
        self._find_zeros()
        self._find_mount()
        return self._conclude()

    @property
    def complete(self) -> bool:
        """Whether nothing is left to ask."""
        progress = self.progress
        return len(progress.joints) == len(progress.zeros) == 12 and len(progress.mount) == len(POSES)

    def undo(self, step: Step) -> None:
        """Forget a step, and what stands on it: zeros are read from the motors that the joints were found at."""
        progress = self.progress
        if step == "joints":
            progress.joints, progress.spare = {}, []
        if step in ("joints", "zeros"):
            progress.zeros, progress.jig = {}, []
        if step == "mount":
            progress.mount = []
        self._keep()

    def _resume(self) -> Progress:
        if not self.path.exists():
            return Progress(robot=self.config.robot.name)
        try:
            progress = msgspec.json.decode(self.path.read_bytes(), type=Progress)
        except UNDECODABLE as error:
            raise CommissionError(f"{self.path}: {error}; begin anew with --anew") from error
        if progress.version != PROGRESS_VERSION:
            raise CommissionError(
                f"{self.path}: version {progress.version}, this program writes {PROGRESS_VERSION}; "
                "begin anew with --anew"
            )
        strangers = {*progress.joints, *progress.zeros} - set(NAMES)
        if strangers:
            raise CommissionError(
                f"{self.path}: no joint is called {', '.join(sorted(strangers))}; begin anew with --anew"
            )
        if progress.robot != self.config.robot.name:
            raise CommissionError(f"{self.path} is of robot {progress.robot!r}; begin anew with --anew")
        return progress

    def _keep(self) -> None:
        write_whole(self.path, msgspec.json.encode(self.progress))

    # Joints ------------------------------------------------------------------------------------------------------

    def _find_joints(self) -> None:
        """By hand, joint after joint."""
        for leg in range(4):
            for joint in range(3):
                name = joint_name(leg, joint)
                if name in self.progress.joints:
                    continue
                self._ask(Task("let go", f"{name}: let go of all legs", leg, joint))
                before = self._readings.motors()
                words = f"{name}: turn this joint alone, {MOTIONS[joint]}, by about 20 degrees, and hold it"
                self._ask(Task("turn", words, leg, joint))
                self._found(name, find_moved(before, self._readings.motors(), name))

    def _wiggle_joints(self) -> None:
        """By power, motor after motor."""
        progress = self.progress
        known = {(bus, motor) for bus, motor, _ in progress.joints.values()} | set(progress.spare)
        for place in sorted(self._readings.motors()):
            if place not in known:
                self._wiggle_one(place)

    def _wiggle_one(self, place: MotorPlace) -> None:
        name = f"bus {place[0]} id {place[1]}"
        self._ask(Task("watch", f"{name} turns a little now, by its own power: legs off the ground, hands off"))
        turned = self._readings.wiggle(place)
        legs, joints = " ".join(LEGS), " ".join(JOINTS)
        words = (
            f"{name} turned. Say leg ({legs}), joint ({joints}) and + or -; + is "
            f"{', '.join(f'{joint}: {motion}' for joint, motion in zip(JOINTS, MOTIONS, strict=True))}. "
            f"Or {SPARE}, or again"
        )
        for _ in range(_TRIES):
            answer = self._ask(Task("say", words)).split()
            if answer == [SPARE]:
                self.progress.spare.append(place)
                self._keep()
                return
            if answer == ["again"]:
                turned = self._readings.wiggle(place)
            elif (moved := _joint_said(answer)) is not None:
                self._found(moved[0], FoundJoint(place, moved[1] * (1 if turned > 0 else -1)))
                return
        raise CommissionError(f"{name}: no answer like 'FL knee +'; run again to go on from here")

    def _found(self, name: str, found: FoundJoint) -> None:
        for other, (bus, motor, _) in self.progress.joints.items():
            if other == name or (bus, motor) == found.place:
                raise CommissionError(
                    f"{other} was found at bus {bus} id {motor}, now {name} at bus {found.place[0]} id "
                    f"{found.place[1]}: look again, or --undo joints; or two motors share an id"
                )
        self.progress.joints[name] = (*found.place, 1 if found.direction > 0 else -1)
        self._keep()

    # Zeros -------------------------------------------------------------------------------------------------------

    def _find_zeros(self) -> None:
        progress = self.progress
        if self._jig is not None and not progress.zeros:
            self._ask(Task("jig", f"hold all legs in the jig, at {self._jig} rad", angles=self._jig))
            here = self._readings.motors()
            progress.jig = list(self._jig)
            progress.zeros = {
                joint_name(leg, joint): [self._angle(here, leg, joint)] for leg in range(4) for joint in range(3)
            }
            self._keep()
        for leg in range(4):
            for joint in range(3):
                if joint_name(leg, joint) not in progress.zeros:
                    self._find_stops(leg, joint)

    def _find_stops(self, leg: int, joint: int) -> None:
        name, ends = joint_name(leg, joint), []
        for index, end in enumerate(("one end stop", "the other end stop")):
            self._ask(Task("stop", f"{name}: bring it to {end} and hold it", leg, joint, index))
            ends.append(self._angle(self._readings.motors(), leg, joint))
        turned = abs(ends[1] - ends[0]) / self.motors.gear[joint]
        if problem := range_problem(self.config.robot, leg, joint, turned):
            raise CommissionError(f"{problem}. Run again, and bring it to both of its stops; or mend the model")
        self.progress.zeros[name] = ends
        self._keep()

    def _angle(self, motors: dict[MotorPlace, float], leg: int, joint: int) -> float:
        name = joint_name(leg, joint)
        bus, motor, _ = self.progress.joints[name]
        if (bus, motor) not in motors:
            raise CommissionError(f"{name}: bus {bus} id {motor} does not answer any more")
        return motors[bus, motor]

    # Mount -------------------------------------------------------------------------------------------------------

    def _find_mount(self) -> None:
        poses = self.progress.mount
        for index in range(len(poses), len(POSES)):
            self._ask(Task("tilt", f"IMU: hold the body still, {POSES[index]}", index=index))
            x, y, z = self._readings.force().tolist()
            poses.append((x, y, z))
            self._keep()
        try:
            self._mount()
        except CommissionError:
            self.undo("mount")
            raise

    def _mount(self) -> Array:
        level, nose_down, left_down = (np.array(pose) for pose in self.progress.mount)
        return mount_from_gravity(level, nose_down, left_down)

    # The end -----------------------------------------------------------------------------------------------------

    def _conclude(self) -> Calibration:
        progress, motors, description = self.progress, self.motors, self.config.robot
        rows = [[progress.joints[joint_name(leg, joint)] for joint in range(3)] for leg in range(4)]
        found = [[FoundJoint((bus, motor), sign) for bus, motor, sign in row] for row in rows]
        ids, buses, directions = assign(found)
        gear = np.tile(np.array(motors.gear), (4, 1))
        ends = [np.reshape([progress.zeros[name][end] for name in NAMES], (4, 3)) for end in (0, -1)]
        if progress.jig:
            offsets = zeros_from_pose(ends[0], np.tile(progress.jig, (4, 1)), directions, gear)
        else:
            offsets = zeros_from_stops(description, ends[0], ends[1], directions, gear)
        table = {
            "version": VERSION,
            "robot": description.name,
            "body": fingerprint(description, motors),
            "date": datetime.now(UTC),
            "id": ids.tolist(),
            "bus": buses.tolist(),
            "direction": directions.tolist(),
            "offset": offsets.tolist(),
            "mount": self._mount().tolist(),
        }
        return calibration.seal(msgspec.convert(table, Calibration))


def _joint_said(answer: list[str]) -> tuple[str, int] | None:
    """``['FL', 'knee', '+']`` as name and sign; None where it is nothing of the kind."""
    if len(answer) != 3 or answer[2] not in ("+", "-"):
        return None
    leg, joint = answer[0].upper(), answer[1].lower()
    return (f"{leg} {joint}", 1 if answer[2] == "+" else -1) if leg in LEGS and joint in JOINTS else None
