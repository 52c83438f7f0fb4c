"""Ticks → rerun: the 3-D scene and the charts, drawn by columns so that a thousand ticks cost one call each.

Entities: ``world/…`` the scene; ``velocity``, ``torque``, ``tracking``, ``applied``, ``timing`` the charts;
``portrait`` the phase portraits; ``state/…`` the timelines; ``event`` the log.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from drivers.description import RobotDescription
from drivers.robot import JOINTS, LEGS, Array
from runtime.control.records import Clamp, Records, SolverStatus
from runtime.messages.event import Event
from runtime.messages.mode import Mode
from station.pose import body_position, heading_to_world, leg_points, orientation_xyzw, yaw_quaternion

SCENE_HZ = 25.0
"""How often the scene is drawn; charts have every tick."""
PORTRAIT_SECONDS = 1.0
NEWTONS_PER_METRE = 600.0
"""Length of the arrows of force."""
TIMELINE = "robot time"
PLACE = "world/place"
"""The spot on the ground below the body: the eye goes with it, without turning."""
GROUND_METRES, GROUND_SPACING = 30.0, 0.5
GROUND_COLOR = (60, 60, 66)
LEG_COLORS = np.array([[77, 148, 255], [255, 168, 60], [90, 200, 120], [235, 96, 96]], np.uint8)
BODY_COLOR = (140, 140, 150)
FORCE_COLOR = (250, 220, 80)
TARGET_COLOR = (200, 200, 255)
ASKED_COLOR, MEASURED_COLOR, FOLLOWED_COLOR = (235, 96, 96), (77, 148, 255), (170, 170, 170)
AXES = ("x", "y", "z")
VELOCITIES = ("forward", "left", "turn")
WRENCH = ("force_x", "force_y", "force_z", "moment_x", "moment_y", "moment_z")
MODE_COLORS = {
    Mode.DAMP: 0x808080FF,
    Mode.STAND_UP: 0xC9B037FF,
    Mode.STAND: 0x4D94FFFF,
    Mode.WALK: 0x5AC878FF,
    Mode.SIT_DOWN: 0xC98037FF,
}
LEVELS = {"fault": "ERROR", "refused": "WARN"}


class Canvas:
    """One recording stream and what has to be remembered between two batches of ticks."""

    def __init__(self, stream: rr.RecordingStream, description: RobotDescription) -> None:
        self.stream = stream
        self._description = description
        self._peak = np.array(description.joints.peak_torque)
        self._start: float | None = None
        self._last_drawn = -np.inf
        self._states: dict[str, str] = {}
        self._recent: Records | None = None
        self._draw_static()

    def draw(self, ticks: Records) -> None:
        """Draw ticks (n,), oldest first."""
        if not len(ticks):
            return
        if self._start is None:
            self._start = float(ticks["stamp"][0])
        self._draw_charts(ticks)
        self._draw_states(ticks)
        shown = self._thinned(ticks)
        if len(shown):
            self._draw_scene(shown)
        self._draw_portraits(ticks)

    def draw_events(self, events: Iterable[Event]) -> None:
        """Log what happened."""
        for event in events:
            self.stream.set_time(TIMELINE, duration=event.stamp - (self._start or event.stamp))
            level = LEVELS.get(event.kind, "INFO")
            self.stream.log("event", rr.TextLog(f"{event.kind}: {event.text}", level=level))

    # Once --------------------------------------------------------------------------------------------------------

    def _draw_static(self) -> None:
        log = self.stream.log
        log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        lines = rr.LineStrips3D(_ground_lines(), colors=[GROUND_COLOR], radii=[0.002])
        log("world/ground", lines, static=True)
        half = np.array(self._description.body_size) / 2
        log(
            "world/body/box",
            rr.Boxes3D(half_sizes=[half], colors=[BODY_COLOR], fill_mode="majorwireframe"),
            static=True,
        )
        nose = [[half[0], 0.0, 0.0]]
        log("world/body/front", rr.Arrows3D(origins=nose, vectors=[[0.1, 0, 0]], colors=[BODY_COLOR]), static=True)
        for name in VELOCITIES:
            self._name_series(
                f"velocity/{name}",
                ("asked", "followed", "measured"),
                (ASKED_COLOR, FOLLOWED_COLOR, MEASURED_COLOR),
            )
        for leg in LEGS:
            self._name_series(f"torque/{leg}", JOINTS)
            self._name_series(f"tracking/{leg}", JOINTS)
        for name in WRENCH:
            self._name_series(f"applied/{name}", ("asked", "applied"), (ASKED_COLOR, MEASURED_COLOR))
        self._name_series("timing", ("period", "lateness", "compute"))
        configured = rr.StateConfiguration(
            values=[mode.name for mode in MODE_COLORS], colors=list(MODE_COLORS.values())
        )
        log("state/MODE", configured, static=True)

    def _name_series(
        self, path: str, names: Sequence[str], colors: Sequence[tuple[int, int, int]] | None = None
    ) -> None:
        self.stream.log(path, rr.SeriesLines(names=list(names), colors=colors), static=True)

    # Each batch --------------------------------------------------------------------------------------------------

    def _time(self, ticks: Records) -> rr.TimeColumn:
        assert self._start is not None
        return rr.TimeColumn(TIMELINE, duration=ticks["stamp"] - self._start)

    def _draw_charts(self, ticks: Records) -> None:
        when = [self._time(ticks)]

        def chart(path: str, values: Array) -> None:
            self.stream.send_columns(path, when, rr.Scalars.columns(scalars=values))

        measured = ticks["twist"][:, (0, 1, 5)]
        for axis, name in enumerate(VELOCITIES):
            rows = (ticks["asked_velocity"], ticks["velocity_command"], measured)
            chart(f"velocity/{name}", np.stack([row[:, axis] for row in rows], axis=1))
        for leg, name in enumerate(LEGS):
            chart(f"torque/{name}", ticks["joint_torque"][:, leg] / self._peak)
            chart(f"tracking/{name}", _tracking_error(ticks)[:, leg])
        for axis, name in enumerate(WRENCH):
            chart(f"applied/{name}", np.stack([ticks["asked"][:, 12 + axis], ticks["action"][:, 12 + axis]], axis=1))
        chart("timing", 1e3 * np.stack([ticks["period"], ticks["lateness"], ticks["compute"]], axis=1))

    def _draw_states(self, ticks: Records) -> None:
        """Only where they change: modes, the solver, the clamps."""
        self._draw_state("state/MODE", ticks, [Mode(mode).name for mode in ticks["mode"].tolist()])
        self._draw_state("state/armed", ticks, ["armed" if armed else "" for armed in ticks["armed"].tolist()])
        policies = [
            f"{active}, from {outgoing}" if outgoing else str(active)
            for active, outgoing in zip(ticks["policy"].tolist(), ticks["outgoing"].tolist(), strict=True)
        ]
        self._draw_state("state/policy", ticks, policies)
        fell_back = ticks["solver_status"] > SolverStatus.SOLVED
        names = [SolverStatus(s).name if bad else "" for s, bad in zip(ticks["solver_status"], fell_back, strict=True)]
        self._draw_state("state/solver", ticks, names)
        for clamp in Clamp:
            acts = (ticks["clamps"] & int(clamp)) != 0
            name = str(clamp.name).lower()
            self._draw_state(f"state/clamp_{name}", ticks, [name if act else "" for act in acts.tolist()])

    def _draw_state(self, path: str, ticks: Records, names: list[str]) -> None:
        before = [self._states.get(path, ""), *names[:-1]]
        changed = [index for index, (old, new) in enumerate(zip(before, names, strict=True)) if old != new]
        self._states[path] = names[-1]
        if changed:
            columns = rr.StateChange.columns(state=[names[index] for index in changed])
            self.stream.send_columns(path, [self._time(ticks[changed])], columns)

    def _thinned(self, ticks: Records) -> Records:
        """Ticks at the scene's own rate."""
        shown = []
        for index, stamp in enumerate(ticks["stamp"].tolist()):
            if stamp - self._last_drawn >= 1.0 / SCENE_HZ - 1e-6:
                self._last_drawn = stamp
                shown.append(index)
        return ticks[shown]

    def _draw_scene(self, ticks: Records) -> None:
        when, n = [self._time(ticks)], len(ticks)
        send = self.stream.send_columns
        position = body_position(ticks)
        turned = orientation_xyzw(ticks)
        send("world/body", when, rr.Transform3D.columns(translation=position, quaternion=turned))
        place = position * (1.0, 1.0, 0.0)
        send(PLACE, when, rr.Transform3D.columns(translation=place))
        heading = yaw_quaternion(ticks["rpy"][:, 2])
        send("world/heading", when, rr.Transform3D.columns(translation=position, quaternion=heading))
        send("world/path", when, rr.Points3D.columns(positions=position, radii=[0.006] * n, colors=[BODY_COLOR] * n))
        legs = leg_points(self._description, ticks["joint_position"]).reshape(4 * n, 4, 3)
        colors, radii = np.tile(LEG_COLORS, (n, 1)), np.full(4 * n, 0.012)
        send(
            "world/body/legs",
            when,
            rr.LineStrips3D.columns(strips=list(legs), colors=colors, radii=radii).partition([4] * n),
        )
        self._draw_feet(ticks, when, colors)
        self._draw_velocities(ticks, when)

    def _draw_feet(self, ticks: Records, when: list[rr.TimeColumn], colors: NDArray[np.uint8]) -> None:
        """Feet (large where they feel the ground), their targets, trails and ground reaction forces."""
        n, send = len(ticks), self.stream.send_columns
        fours = [4] * n

        def points(path: str, positions: Array, radii: Array, tint: NDArray[np.uint8]) -> None:
            columns = rr.Points3D.columns(positions=positions.reshape(-1, 3), colors=tint, radii=radii.ravel())
            send(path, when, columns.partition(fours))

        felt = ticks["contacts"] != 0
        points("world/heading/feet", ticks["feet"], np.where(felt, 0.035, 0.018), colors)
        targets = np.tile(np.array(TARGET_COLOR, np.uint8), (4 * n, 1))
        points("world/heading/targets", ticks["foot_targets"], np.full((n, 4), 0.012), targets)
        points("world/trail", heading_to_world(ticks, ticks["feet"]), np.full((n, 4), 0.004), colors)
        arrows = rr.Arrows3D.columns(
            origins=ticks["feet"].reshape(-1, 3),
            vectors=ticks["grf"].reshape(-1, 3) / NEWTONS_PER_METRE,
            colors=[FORCE_COLOR] * (4 * n),
            radii=[0.007] * (4 * n),
        )
        send("world/heading/grf", when, arrows.partition(fours))

    def _draw_velocities(self, ticks: Records, when: list[rr.TimeColumn]) -> None:
        n = len(ticks)
        vectors = np.zeros((n, 2, 3))
        vectors[:, 0, :2] = ticks["asked_velocity"][:, :2]
        vectors[:, 1, :2] = ticks["twist"][:, :2]
        columns = rr.Arrows3D.columns(
            origins=np.tile([[0.0, 0.0, 0.15], [0.0, 0.0, 0.18]], (n, 1)),
            vectors=vectors.reshape(-1, 3) / 2,
            colors=[ASKED_COLOR, MEASURED_COLOR] * n,
            radii=[0.01] * (2 * n),
        )
        self.stream.send_columns("world/heading/velocity", when, columns.partition([2] * n))

    def _draw_portraits(self, ticks: Records) -> None:
        """Angle against speed of the last second, one curve a leg, one pane a joint."""
        whole = ticks if self._recent is None else np.concatenate([self._recent, ticks])
        ends = np.flatnonzero(np.isin(whole["stamp"], self._portrait_times(ticks)))
        for end in ends.tolist():
            last = whole[: end + 1]
            last = last[last["stamp"] > last["stamp"][-1] - PORTRAIT_SECONDS]
            self._draw_portrait(last)
        self._recent = whole[whole["stamp"] > whole["stamp"][-1] - PORTRAIT_SECONDS]

    @staticmethod
    def _portrait_times(ticks: Records) -> Array:
        """Ticks after which the portraits are drawn anew: about five a second."""
        fifth = np.floor(ticks["stamp"] * 5)
        return np.asarray(ticks["stamp"][np.flatnonzero(np.diff(fifth, prepend=fifth[0]))])

    def _draw_portrait(self, ticks: Records) -> None:
        assert self._start is not None
        self.stream.set_time(TIMELINE, duration=float(ticks["stamp"][-1]) - self._start)
        for joint, name in enumerate(JOINTS):
            curves = [
                np.stack(
                    [ticks["joint_position"][:, leg, joint], -0.1 * ticks["joint_velocity"][:, leg, joint]], axis=1
                )
                for leg in range(4)
            ]
            self.stream.log(f"portrait/{name}", rr.LineStrips2D(curves, colors=LEG_COLORS))


def _ground_lines() -> list[Array]:
    """A square of lines around the start, z = 0, m."""
    steps = np.arange(-GROUND_METRES, GROUND_METRES + 1e-9, GROUND_SPACING)
    ends = np.array([-GROUND_METRES, GROUND_METRES])
    along_x = [np.stack([ends, np.full(2, y), np.zeros(2)], axis=1) for y in steps]
    return along_x + [line[:, (1, 0, 2)] for line in along_x]


def _tracking_error(ticks: Records) -> Array:
    """Wanted minus measured joint angle where there is stiffness, rad. Shape (n, 4, 3)."""
    return np.asarray(np.where(ticks["command_kp"] > 0.0, ticks["command_position"] - ticks["joint_position"], 0.0))
