"""The viewer: legs where the compiled kinematics put them, nothing lost or invented between ticks and rerun."""

from __future__ import annotations

import asyncio
import mmap
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from daemons import until
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scenes import quaternion, robot, rotation
from walks import Walk

from runtime.control.kinematics import forward, leg_geometry
from runtime.messages.tick import TICK_DTYPE, tick_schema
from runtime.recording import RecordingError, load
from station import ticks as station_ticks
from station.canvas import SCENE_HZ, Canvas
from station.pose import heading_to_world, leg_points, orientation_xyzw
from station.session import StationError, free_endpoint
from station.viewer import MemoryBound, Screen, view_recording

rr = pytest.importorskip("rerun")

ANGLES = arrays(np.float64, (2, 4, 3), elements=st.floats(-3.0, 3.0))


@settings(deadline=None)
@given(ANGLES)
def test_legs_end_where_the_compiled_kinematics_put_the_feet(angles: np.ndarray) -> None:
    description = robot().robot
    points = leg_points(description, angles)
    for tick in range(2):
        assert np.allclose(points[tick, :, 3], forward(leg_geometry(description), angles[tick]), atol=1e-12)
    lengths = np.linalg.norm(np.diff(points, axis=2), axis=-1)
    wanted = (description.abduction_length, description.thigh_length, description.shank_length)
    assert np.allclose(lengths, wanted, atol=1e-12)


@given(st.floats(-3, 3), st.floats(-2, 2), st.floats(-2, 2))
def test_a_foot_in_the_heading_frame_is_turned_by_yaw_alone_and_moved_with_the_body(
    yaw: float, x: float, y: float
) -> None:
    tick = np.zeros(1, TICK_DTYPE)
    tick["rpy"] = (0.3, -0.2, yaw)
    tick["position"], tick["height"] = (1.0, 2.0, 99.0), 0.5
    shown = heading_to_world(tick, np.array([[[x, y, -0.5]]]))
    assert np.allclose(shown[0, 0], rotation((0, 0, yaw)) @ (x, y, -0.5) + (1.0, 2.0, 0.5), atol=1e-12)


def test_orientation_is_given_in_rerun_s_order() -> None:
    tick = np.zeros(2, TICK_DTYPE)
    tick["orientation"][0] = quaternion((0.1, 0.2, 0.3))
    w, x, y, z = quaternion((0.1, 0.2, 0.3))
    assert orientation_xyzw(tick).tolist() == [[x, y, z, w], [0, 0, 0, 1]]


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Walk:
    walk = Walk(tmp_path_factory.mktemp("recordings"))
    walk.stand()
    return walk


def test_a_recording_becomes_an_rrd_with_every_tick_in_the_charts(walked: Walk, tmp_path) -> None:  # type: ignore[no-untyped-def]
    path = walked.write("seen")
    view_recording(path, Screen(save=tmp_path / "seen.rrd"))
    written = (tmp_path / "seen.rrd").read_bytes()
    assert written[:4] == b"RRF2"
    assert len(written) > 100 * len(load(path).ticks)


def listens(port: int) -> bool:
    with socket.socket() as asking:
        return asking.connect_ex(("127.0.0.1", port)) == 0


def test_a_browser_finds_page_and_data_of_a_recording_for_as_long_as_it_looks(walked: Walk) -> None:
    web, data = (int(free_endpoint().rsplit(":", 1)[1]) for _ in range(2))
    words = ["view", str(walked.write("browsed")), "--web", "--web-port", str(web), "--port", str(data)]
    with subprocess.Popen([sys.executable, "-m", "trotd.cli", *words], stderr=subprocess.PIPE, text=True) as viewing:
        try:
            assert viewing.stderr is not None
            line = viewing.stderr.readline()
            assert f"http://127.0.0.1:{web}/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{data}%2Fproxy" in line
            asyncio.run(until(lambda: listens(web) and listens(data)))
            time.sleep(3.0)  # drawn by now; who lets go of the stream then closes the door
            assert listens(web) and listens(data)
        finally:
            viewing.send_signal(signal.SIGINT)
        assert viewing.wait(30.0) == 130


def test_charts_take_every_tick_and_the_scene_its_own_rate(walked: Walk) -> None:
    seen: dict[str, int] = {}

    class Counting:
        def send_columns(self, entity: str, indexes: list[object], _columns: object) -> None:
            seen[entity] = seen.get(entity, 0) + len(indexes[0].as_arrow_array())  # type: ignore[attr-defined]

        def log(self, *_: object, **__: object) -> None: ...
        def set_time(self, *_: object, **__: object) -> None: ...

    ticks = load(walked.write("counted")).ticks
    canvas = Canvas(Counting(), walked.config.robot)  # type: ignore[arg-type]
    for first in range(0, len(ticks), 7):
        canvas.draw(ticks[first : first + 7])
    assert seen["velocity/forward"] == len(ticks)
    seconds = float(ticks["stamp"][-1] - ticks["stamp"][0])
    assert seen["world/body"] == pytest.approx(seconds * SCENE_HZ, abs=2)
    modes = ticks["mode"]
    assert seen["state/MODE"] == 1 + np.count_nonzero(np.diff(modes.astype(int)))


def test_a_recording_of_another_layout_is_refused_by_the_field_s_name(walked: Walk, tmp_path) -> None:  # type: ignore[no-untyped-def]
    import msgspec

    other = msgspec.structs.replace(walked.header(), layout=[row for row in walked.header().layout if row[0] != "grf"])
    path = walked.recorder.write(other, "other")
    with pytest.raises(StationError, match="no field 'grf'"):
        view_recording(path, Screen(save=tmp_path / "x.rrd"))


def test_a_browser_s_data_may_lie_in_this_process_and_a_window_s_may_not() -> None:
    assert Screen(web=True, memory="1.5GiB").kept == 3 * 2**29
    assert Screen(web=True, memory="200MB").kept == 200_000_000
    assert Screen(memory="1GiB").kept == 0


@pytest.mark.parametrize("memory", ["much", "1", "GiB", "1.2.3GB", "-1GiB", "1 TB", ""])
def test_a_memory_without_number_or_unit_is_refused(memory: str) -> None:
    with pytest.raises(StationError, match="a number and one of kB, MB, GB"):
        Screen(memory=memory)


def test_memory_that_grows_past_its_bound_ends_the_viewer() -> None:
    bound = MemoryBound(30_000_000)
    bound.check()
    with mmap.mmap(-1, 40_000_000) as block:
        block.write(b"x" * len(block))
        with pytest.raises(StationError, match="the viewer does not take what it is sent"):
            bound.check()


def test_what_is_no_recording_is_refused(tmp_path) -> None:  # type: ignore[no-untyped-def]
    (tmp_path / "x.trotd").write_bytes(b"not this")
    with pytest.raises(RecordingError, match="not a trotd recording"):
        view_recording(tmp_path / "x.trotd", Screen(save=tmp_path / "x.rrd"))


def test_the_schema_on_the_wire_rebuilds_the_layout() -> None:
    assert station_ticks.read_schema(tick_schema()) == TICK_DTYPE


@given(st.binary(max_size=200))
def test_a_schema_of_garbage_is_refused(data: bytes) -> None:
    with pytest.raises(StationError):
        station_ticks.read_schema(data)
