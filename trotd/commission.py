"""``trotd commission``: a new robot understood step by step, resumable, each step done again at will.

The motors stay without torque throughout: people turn the joints, the encoders tell what moved. What a step found is
kept in a progress file until all are done; then it becomes the robot's calibration.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

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
    zeros_from_stops,
)
from drivers.durable import write_whole
from drivers.robot import Array
from drivers.wiring import MotorsConfig
from runtime.config import Config

Step = Literal["joints", "stops", "mount"]
STEPS: tuple[Step, ...] = ("joints", "stops", "mount")
POSES = ("level", "nose down by 20 to 40 degrees", "left side down by 20 to 40 degrees")
_MOTIONS = ("swing the foot to the left", "swing the foot backwards", "swing the shank backwards")
"""What a positive turn about +x and +y looks like: abduction, hip, knee (body x forward, y left, z up)."""


class Progress(msgspec.Struct, kw_only=True):
    """What was found so far."""

    robot: str
    joints: list[list[tuple[int, int, int]]] = []
    """(bus, id, direction) of every joint found, row by row; rows may be short while it goes on."""
    stops: list[list[list[float]]] = []
    """Motor angles (4, 3) at the first and the second end stop, rad."""
    poses: list[list[float]] = []
    """What the accelerometer felt in each of ``POSES``, sensor frame, m/s²."""


class Commission:
    """One robot's commissioning.

    Args:
        config: of the robot; its ids, buses, signs, zeros and mount are not believed.
        path: of the progress file.
        read_motors: output angle of every motor on the buses, rad.
        read_force: what the accelerometer feels, sensor frame, m/s². Shape (3,).
        ask: tells the person what to do, and returns when it is done.
    """

    def __init__(
        self,
        config: Config,
        motors: MotorsConfig,
        path: Path,
        read_motors: Callable[[], dict[MotorPlace, float]],
        read_force: Callable[[], Array],
        ask: Callable[[str], None],
    ) -> None:
        self.config, self.motors, self.path = config, motors, path
        self._read_motors, self._read_force, self._ask = read_motors, read_force, ask
        self.progress = self._resume()

    def run(self) -> Calibration:
        """Do what is left, and put it together.

        Raises:
            CommissionError: a step did not give an answer to trust; run again to go on from there.
        """
        self._find_joints()
        self._find_stops()
        self._find_mount()
        return self._conclude()

    def undo(self, step: Step) -> None:
        """Forget a step, and those that stand on it."""
        for later in STEPS[STEPS.index(step) :] if step == "joints" else (step,):
            setattr(self.progress, {"mount": "poses"}.get(later, later), [])
        self._keep()

    def _resume(self) -> Progress:
        if not self.path.exists():
            return Progress(robot=self.config.robot.name)
        try:
            progress = msgspec.json.decode(self.path.read_bytes(), type=Progress)
        except msgspec.MsgspecError as error:
            raise CommissionError(f"{self.path}: {error}; remove it to begin anew") from error
        if progress.robot != self.config.robot.name:
            raise CommissionError(f"{self.path} is of robot {progress.robot!r}; remove it to begin anew")
        return progress

    def _keep(self) -> None:
        write_whole(self.path, msgspec.json.encode(self.progress))

    def _find_joints(self) -> None:
        rows = self.progress.joints
        for leg in range(4):
            if len(rows) == leg:
                rows.append([])
            for joint in range(len(rows[leg]), 3):
                name = joint_name(leg, joint)
                self._ask(f"{name}: let go of all legs")
                before = self._read_motors()
                self._ask(f"{name}: {_MOTIONS[joint]}, turning this joint alone, by about 20 degrees, and hold it")
                found = find_moved(before, self._read_motors(), name)
                rows[leg].append((*found.place, found.direction))
                self._keep()

    def _find_stops(self) -> None:
        stops = self.progress.stops
        for end in ("one end stop", "the other end stop")[len(stops) :]:
            angles = []
            for leg in range(4):
                for joint in range(3):
                    self._ask(f"{joint_name(leg, joint)}: bring it to {end} and hold it")
                    bus, motor, _ = self.progress.joints[leg][joint]
                    angle = self._read_motors().get((bus, motor))
                    if angle is None:
                        raise CommissionError(
                            f"{joint_name(leg, joint)}: bus {bus} id {motor} does not answer any more"
                        )
                    angles.append(angle)
            stops.append(np.array(angles).reshape(4, 3).tolist())
            self._keep()

    def _find_mount(self) -> None:
        poses = self.progress.poses
        for pose in POSES[len(poses) :]:
            self._ask(f"IMU: hold the body still, {pose}")
            poses.append(self._read_force().tolist())
            self._keep()

    def _conclude(self) -> Calibration:
        progress, motors, description = self.progress, self.motors, self.config.robot
        found = [[FoundJoint((bus, motor), sign) for bus, motor, sign in row] for row in progress.joints]
        ids, buses, directions = assign(found)
        gear = np.tile(np.array(motors.gear), (4, 1))
        first, second = (np.array(stop) for stop in progress.stops)
        offsets = zeros_from_stops(description, first, second, directions, gear)
        level, nose_down, left_down = (np.array(pose) for pose in progress.poses)
        mount = mount_from_gravity(level, nose_down, left_down)
        table = {
            "version": VERSION,
            "robot": description.name,
            "body": fingerprint(description, motors),
            "date": datetime.now(UTC),
            "id": ids.tolist(),
            "bus": buses.tolist(),
            "direction": directions.tolist(),
            "offset": offsets.tolist(),
            "mount": mount.tolist(),
        }
        return calibration.seal(msgspec.convert(table, Calibration))
