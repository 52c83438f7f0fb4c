"""How the viewer is laid out for this robot: the body on the left, charts in tabs on the right, what happened below."""

from __future__ import annotations

import rerun.blueprint as rrb

from drivers.robot import JOINTS, LEGS
from station.canvas import PLACE, TIMELINE, VELOCITIES, WRENCH

TRAIL_SECONDS = 3.0
WINDOW_SECONDS = 10.0


def _last(seconds: float) -> rrb.VisibleTimeRange:
    return rrb.VisibleTimeRange(
        TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-seconds),
        end=rrb.TimeRangeBoundary.cursor_relative(seconds=0.0),
    )


def _scene() -> rrb.Spatial3DView:
    trails = [rrb.VisibleTimeRanges(_last(TRAIL_SECONDS))]
    return rrb.Spatial3DView(
        origin=PLACE,
        contents="world/**",
        name="Body",
        eye_controls=rrb.EyeControls3D(position=(1.1, -1.5, 0.9), look_target=(0.0, 0.0, 0.3), eye_up=(0.0, 0.0, 1.0)),
        line_grid=rrb.LineGrid3D(visible=False),
        overrides={
            "world/trail": trails,
            "world/path": trails,
            "world/ground": [rrb.EntityBehavior(interactive=False)],
        },
    )


def _chart(origin: str, name: str, low: float | None = None, high: float | None = None) -> rrb.TimeSeriesView:
    axis = None if low is None or high is None else rrb.ScalarAxis(range=(low, high))
    return rrb.TimeSeriesView(origin=origin, name=name, axis_y=axis, time_ranges=[_last(WINDOW_SECONDS)])


def _charts() -> rrb.Tabs:
    units = ("m/s", "m/s", "rad/s")
    velocity = rrb.Vertical(
        *(_chart(f"velocity/{name}", f"{name}, {unit}") for name, unit in zip(VELOCITIES, units, strict=True)),
        name="Velocity",
    )
    torque = rrb.Vertical(
        *(_chart(f"torque/{leg}", f"{leg}: torque as a share of its peak", -1.05, 1.05) for leg in LEGS), name="Torque"
    )
    tracking = rrb.Vertical(
        *(_chart(f"tracking/{leg}", f"{leg}: wanted - measured, rad") for leg in LEGS), name="Tracking"
    )
    applied = rrb.Grid(
        *(_chart(f"applied/{name}", f"{name.replace('_', ' ')}, asked and applied") for name in WRENCH),
        grid_columns=2,
        name="Asked / applied",
    )
    portraits = rrb.Vertical(
        *(rrb.Spatial2DView(origin=f"portrait/{joint}", name=f"{joint}: rad against 10 rad/s") for joint in JOINTS),
        name="Phase",
    )
    return rrb.Tabs(velocity, torque, tracking, applied, portraits, _chart("timing", "Tick, ms"))


def build_blueprint() -> rrb.Blueprint:
    """The layout; a viewer's own changes win over it."""
    below = rrb.Horizontal(
        rrb.StateTimelineView(origin="state", name="Mode and clamps"),
        rrb.TextLogView(origin="event", name="Events"),
        column_shares=[2, 1],
    )
    return rrb.Blueprint(
        rrb.Vertical(rrb.Horizontal(_scene(), _charts(), column_shares=[3, 2]), below, row_shares=[5, 2]),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )
