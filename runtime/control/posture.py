"""Standing up and sitting down: from the pose that was measured, softly, and back.

A movement is a list of segments, one after the other; each moves the joints or the feet along a minimum-jerk line while
the gains and the share of the weight that is fed forward change from one value to another. Up: gains grow at the
measured pose → joints fold until the feet are below the hips → the legs take the weight → the body rises vertically.
Down is the reverse, and ends without torque.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from drivers.description import RobotDescription
from drivers.robot import Array, JointCommand, Measurement
from runtime.control.kinematics import GRAVITY, forward, inverse, jacobians, leg_geometry
from runtime.control.parameters import ControlConfig
from runtime.control.records import Records
from runtime.control.state import build_parameters


class PostureTimes(Protocol):
    """What ``[posture]`` of the robot's TOML says (``runtime.parameters.PostureConfig``)."""

    @property
    def soft_start(self) -> float: ...  # noqa: D102
    @property
    def fold_time(self) -> float: ...  # noqa: D102
    @property
    def rise_time(self) -> float: ...  # noqa: D102
    @property
    def settle_time(self) -> float: ...  # noqa: D102
    @property
    def fold_height(self) -> float: ...  # noqa: D102
    @property
    def brace_time(self) -> float: ...  # noqa: D102
    @property
    def brace_gain(self) -> float: ...  # noqa: D102
    @property
    def brace_damping(self) -> float: ...  # noqa: D102
    @property
    def tuck_time(self) -> float: ...  # noqa: D102
    @property
    def tuck_gain(self) -> float: ...  # noqa: D102


@dataclass(frozen=True, slots=True)
class Segment:
    """One act of a movement."""

    duration: float
    """s."""
    start: Array
    """Joint angles, rad, or feet in the body frame, m. Shape (4, 3)."""
    end: Array
    """Of the same kind as ``start``. Shape (4, 3)."""
    feet: bool
    """Whether ``start`` and ``end`` are feet."""
    gain: tuple[float, float]
    """Share of the gains, at start and end."""
    load: tuple[float, float]
    """Share of the weight that is fed forward, at start and end."""
    damping: float = 0.0
    """Share of the damping gain at least."""


SEGMENTS = 5
"""Segments of the longest movement."""
POSTURE_DTYPE = np.dtype(
    [
        ("gain", "f8"),
        ("load", "f8"),
        ("elapsed", "f8"),
        ("finished", "u1"),
        ("aimed", "u1"),  # 1 where target holds a target
        ("target", "f8", (4, 3)),
        ("count", "u1"),
        ("duration", "f8", (SEGMENTS,)),
        ("start", "f8", (SEGMENTS, 4, 3)),
        ("end", "f8", (SEGMENTS, 4, 3)),
        ("feet", "u1", (SEGMENTS,)),
        ("gains", "f8", (SEGMENTS, 2)),
        ("loads", "f8", (SEGMENTS, 2)),
        ("dampings", "f8", (SEGMENTS,)),
    ],
    align=True,
)
"""A movement in progress, whole."""


def minimum_jerk(share: float) -> float:
    """From 0 to 1 with no speed and no acceleration at either end."""
    share = min(1.0, max(0.0, share))
    return min(1.0, share**3 * (10.0 + share * (6.0 * share - 15.0)))


def blend(old: JointCommand, new: JointCommand, share: float) -> JointCommand:
    """``old`` at 0, ``new`` at 1, every number on the straight line between."""
    keep = 1.0 - share
    return JointCommand(
        position=keep * old.position + share * new.position,
        velocity=keep * old.velocity + share * new.velocity,
        kp=keep * old.kp + share * new.kp,
        kd=keep * old.kd + share * new.kd,
        torque=keep * old.torque + share * new.torque,
    )


class Posture:
    """The movement in progress."""

    def __init__(self, description: RobotDescription, control: ControlConfig, times: PostureTimes) -> None:
        """Plan the two ends of every movement.

        Raises:
            ValueError: the folded or the standing pose is out of the legs' reach or of the joints' range.
        """
        self.dt = 1.0 / control.rate_hz
        self.times = times
        self.kp = np.tile(control.gains.kp, (4, 1))
        self.kd = np.tile(control.gains.kd, (4, 1))
        self.weight = description.mass * GRAVITY
        self.geometry = leg_geometry(description)
        footholds = build_parameters(description, control)[0]["nominal_footholds"]
        hip = description.hip_position[2]
        self.standing = self._feet(footholds, description.foot_radius - control.gait.walking_height)
        self.folded = self._feet(footholds, hip - times.fold_height * description.reach)
        self.folded_joints, _ = inverse(self.geometry, self.folded)
        """Where standing up begins and sitting down ends, rad. Shape (4, 3)."""
        self.standing_joints, _ = inverse(self.geometry, self.standing)
        """Where standing up ends, rad. Shape (4, 3)."""
        for name, feet in (("control.gait.walking_height", self.standing), ("posture.fold_height", self.folded)):
            self._check(description, name, feet)
        self.reset()

    def reset(self) -> None:
        """No movement in progress: limp."""
        self.finished = True
        self.gain = 0.0
        """Share of the gains commanded last."""
        self.load = 0.0
        """Share of the weight fed forward last."""
        self._segments: list[Segment] = []
        self._elapsed = 0.0
        self._target: Array | None = None

    def stand_up(self, measurement: Measurement) -> None:
        """Plan from the measured pose to the walking height; a robot that bears its weight already only rises."""
        q = measurement.joints.position
        times = self.times
        feet = forward(self.geometry, q)
        if self.load > 0.0:
            self._begin([self._along_feet(times.rise_time, feet, self.standing, 1.0)])
            return
        self._begin(
            [
                Segment(times.soft_start, q, q, False, (self.gain, 1.0), (0.0, 0.0)),
                Segment(times.fold_time, q, self.folded_joints, False, (1.0, 1.0), (0.0, 0.0)),
                Segment(times.settle_time, self.folded, self.folded, True, (1.0, 1.0), (0.0, 1.0)),
                Segment(times.rise_time, self.folded, self.standing, True, (1.0, 1.0), (1.0, 1.0)),
                Segment(times.settle_time, self.standing, self.standing, True, (1.0, 1.0), (1.0, 1.0)),
            ]
        )

    def sit_down(self, measurement: Measurement, bearing: bool) -> None:
        """Plan from the measured pose to folded and limp. ``bearing``: the legs carry the body now."""
        times = self.times
        feet = forward(self.geometry, measurement.joints.position)
        if bearing:
            self.gain, self.load = 1.0, 1.0
        self._begin(
            [
                self._along_feet(times.rise_time, feet, self.folded, self.load),
                Segment(times.settle_time, self.folded, self.folded, True, (1.0, 1.0), (self.load, 0.0)),
                Segment(times.soft_start, self.folded, self.folded, True, (1.0, 0.0), (0.0, 0.0)),
            ]
        )

    def brace(self, measurement: Measurement, falls: bool = False) -> None:
        """Plan the quick way down of a robot that moves: joint by joint to folded, soft, bearing less and less.

        One that ``falls`` does it at once and stiffly, so that it is low before it lands. Needs neither attitude nor
        contact nor a controller.
        """
        q, times, folded = measurement.joints.position, self.times, self.folded_joints
        duration = times.tuck_time if falls else times.brace_time
        gain = times.tuck_gain if falls else times.brace_gain
        damping = times.tuck_gain if falls else times.brace_damping
        self._begin(
            [
                Segment(duration, q, folded, False, (gain, gain), (1.0, 0.0), damping),
                Segment(times.soft_start, folded, folded, False, (gain, 0.0), (0.0, 0.0), damping),
            ]
        )

    def step(self) -> JointCommand:
        """The command of this tick; ``finished`` once the last segment is over (its end is then held)."""
        self._elapsed += self.dt
        while len(self._segments) > 1 and self._elapsed > self._segments[0].duration:
            self._elapsed -= self._segments.pop(0).duration
        segment = self._segments[0]
        share = 1.0 if segment.duration <= 0.0 else self._elapsed / segment.duration
        self.finished = len(self._segments) == 1 and share >= 1.0
        smooth = minimum_jerk(share)
        value = segment.start + smooth * (segment.end - segment.start)
        q = inverse(self.geometry, value)[0] if segment.feet else value
        self.gain = segment.gain[0] + smooth * (segment.gain[1] - segment.gain[0])
        self.load = segment.load[0] + smooth * (segment.load[1] - segment.load[0])
        velocity = np.zeros((4, 3)) if self._target is None else (q - self._target) / self.dt
        self._target = q
        damping = max(self.gain, segment.damping)
        return JointCommand(q.copy(), velocity, self.gain * self.kp, damping * self.kd, self._bear(q))

    def remember(self, memory: Records) -> None:
        """Write the movement in progress into ``memory`` () of ``POSTURE_DTYPE``."""
        memory["gain"], memory["load"], memory["elapsed"] = self.gain, self.load, self._elapsed
        memory["finished"], memory["aimed"] = self.finished, self._target is not None
        if self._target is not None:
            memory["target"] = self._target
        memory["count"] = len(self._segments)
        for index, segment in enumerate(self._segments):
            memory["duration"][index], memory["feet"][index] = segment.duration, segment.feet
            memory["start"][index], memory["end"][index] = segment.start, segment.end
            memory["gains"][index], memory["loads"][index] = segment.gain, segment.load
            memory["dampings"][index] = segment.damping

    def recall(self, memory: Records) -> None:
        """Go on with the movement that was written into ``memory``."""
        self.gain, self.load = float(memory["gain"]), float(memory["load"])
        self._elapsed, self.finished = float(memory["elapsed"]), bool(memory["finished"])
        self._target = memory["target"].copy() if memory["aimed"] else None
        self._segments = [
            Segment(
                float(memory["duration"][index]),
                memory["start"][index].copy(),
                memory["end"][index].copy(),
                bool(memory["feet"][index]),
                tuple(memory["gains"][index].tolist()),
                tuple(memory["loads"][index].tolist()),
                float(memory["dampings"][index]),
            )
            for index in range(int(memory["count"]))
        ]

    def _bear(self, q: Array) -> Array:
        """-Jᵀ f with a quarter of the borne weight on every foot, N·m."""
        force = np.array([0.0, 0.0, 0.25 * self.load * self.weight])
        torque: Array = -(jacobians(self.geometry, q).transpose(0, 2, 1) @ force)
        return torque

    def _begin(self, segments: list[Segment]) -> None:
        self._segments = segments
        self._elapsed = 0.0
        self._target = None
        self.finished = False

    def _along_feet(self, whole: float, start: Array, end: Array, load: float) -> Segment:
        """Feet from ``start`` to ``end`` at the pace of the whole way, which takes ``whole`` s."""
        way = np.abs(start - end).max() / np.abs(self.standing - self.folded).max()
        gain = (self.gain, 1.0)
        return Segment(whole * min(1.0, max(0.2, float(way))), start, end, True, gain, (self.load, load))

    @staticmethod
    def _feet(footholds: Array, z: float) -> Array:
        return np.column_stack([footholds, np.full(4, z)])

    def _check(self, description: RobotDescription, name: str, feet: Array) -> None:
        q, reached = inverse(self.geometry, feet)
        lower, upper = np.array(description.joints.lower), np.array(description.joints.upper)
        if not reached.all():
            raise ValueError(f"{name}: a foot at {feet[0].round(3).tolist()} m is out of the leg's reach")
        for leg, joint in np.argwhere((q < lower) | (q > upper)):
            raise ValueError(
                f"{name}: puts joint [{leg}][{joint}] at {q[leg, joint]:.2f} rad,"
                f" its range is {lower[leg, joint]:g} to {upper[leg, joint]:g}"
            )
