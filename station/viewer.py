"""``trotd view``: one robot in rerun, live or from a recording, in a process of its own.

Nothing here can hold the robot up: what the viewer does not take is dropped, first by the link, then by this process,
and memory has a bound on both sides.
"""

from __future__ import annotations

import os
import resource
import sys
import time
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import rerun as rr

from drivers.description import RobotDescription
from runtime import config
from runtime.recording import load
from station.blueprint import build_blueprint
from station.canvas import Canvas
from station.session import Station, StationError
from station.ticks import TickStream, check_fields

DRAW_SECONDS = 0.05
"""Ticks are gathered for this long and drawn in one go."""
SILENCE_SECONDS = 5.0
CHUNK = 2000
"""Ticks of a recording drawn at a time."""
UNTAKEN = 500_000_000
"""Bytes that may wait for a viewer that does not take them."""
UNITS = {"kB": 10**3, "MB": 10**6, "GB": 10**9, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}


@dataclass(frozen=True, slots=True)
class Screen:
    """Where the drawing goes: a file, a browser, or a window."""

    save: Path | None = None
    web: bool = False
    web_port: int = 9090
    grpc_port: int = 9876
    memory: str = "1GiB"
    """The viewer's bound; its oldest data go first. A browser's lie in this process, a window's in its own."""

    def __post_init__(self) -> None:
        """Raises StationError for a ``memory`` that is no number and unit."""
        parse_size(self.memory)

    @property
    def kept(self) -> int:
        """Bytes that this process may keep for whoever looks at it later."""
        return parse_size(self.memory) if self.web else 0

    @property
    def address(self) -> str:
        """What a browser on this machine opens: the page, and where it finds the data."""
        data = quote(f"rerun+http://127.0.0.1:{self.grpc_port}/proxy", safe="")
        return f"http://127.0.0.1:{self.web_port}/?url={data}"

    def open(self, name: str, endless: bool = False) -> rr.RecordingStream:
        """A stream that ends on this screen, laid out for a robot. A browser is served for as long as it is kept.

        A file's table of contents is kept in memory until its end, some 18 MB a minute: an ``endless`` one has none.

        Raises:
            StationError: the file cannot be written, or there is no viewer to start.
        """
        stream = rr.RecordingStream("trotd", recording_id=None)
        stream.send_recording_name(name)
        blueprint = build_blueprint()
        try:
            if self.save is not None:
                stream.save(self.save, default_blueprint=blueprint, write_footer=not endless)
            elif self.web:
                url = stream.serve_grpc(
                    grpc_port=self.grpc_port, default_blueprint=blueprint, server_memory_limit=self.memory
                )
                rr.serve_web_viewer(web_port=self.web_port, open_browser=False, connect_to=url)
            else:
                _need_display()
                rr.spawn(
                    port=self.grpc_port,
                    memory_limit=self.memory,
                    default_blueprint=blueprint,
                    executable_path=_find_viewer(),
                    recording=stream,
                )
        except (OSError, RuntimeError) as error:
            raise StationError(f"viewer: {error}") from error
        return stream


def parse_size(words: str) -> int:
    """``1.5GiB`` in bytes.

    Raises:
        StationError: no number, or another unit than those of ``UNITS``.
    """
    unit = words.lstrip("0123456789.")
    try:
        return round(float(words.removesuffix(unit)) * UNITS[unit])
    except (ValueError, KeyError) as error:
        raise StationError(f"memory {words!r}: a number and one of {', '.join(UNITS)}") from error


def _need_display() -> None:
    """Raises StationError where no window can open."""
    if sys.platform == "linux" and not any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")):
        raise StationError("no display for a window: --web serves a browser, --save FILE.rrd writes a file")


def view_recording(path: Path, screen: Screen) -> rr.RecordingStream:
    """Draw a whole recording.

    Raises:
        RecordingError, ConfigError, StationError: the file cannot be read, or another version wrote it.
    """
    recording = load(path)
    check_fields(recording.ticks.dtype, str(path))
    description = config.parse(tomllib.loads(recording.header.robot_toml), f"{path}: robot").robot
    stream = screen.open(path.name)
    canvas = Canvas(stream, description)
    for first in range(0, len(recording.ticks), CHUNK):
        canvas.draw(recording.ticks[first : first + CHUNK])
    canvas.draw_events(recording.header.events)
    stream.flush(timeout_sec=60.0)
    return stream


def view_live(
    station: Station, description: RobotDescription, screen: Screen, more: Callable[[], bool] = lambda: True
) -> int:
    """Draw what comes until ``more`` says no; returns how many ticks were lost on the way.

    Raises:
        StationError: the robot does not answer, runs another version, or the screen no longer takes anything.
    """
    with TickStream(station) as ticks:
        canvas = Canvas(screen.open(station.robot, endless=True), description)
        bound = MemoryBound(screen.kept + UNTAKEN)
        heard = time.monotonic()
        while more():
            time.sleep(DRAW_SECONDS)
            batch = ticks.take()
            now = time.monotonic()
            if len(batch):
                heard = now
            elif now - heard > SILENCE_SECONDS:
                heard = now
                canvas.stream.log("event", rr.TextLog(f"no ticks for {SILENCE_SECONDS:g} s", level="WARN"))
            bound.check()
            canvas.draw(batch)
            canvas.draw_events(ticks.take_events())
        canvas.stream.flush(timeout_sec=5.0)
        return ticks.lost


def _find_viewer() -> str | None:
    """rerun's program beside this Python, which need not be on the PATH; None leaves the search to rerun."""
    beside = Path(sys.executable).with_name("rerun")
    return str(beside) if beside.is_file() else None


class MemoryBound:
    """Ends a process whose screen has stopped taking: what it would buffer has a bound."""

    def __init__(self, more: int) -> None:
        """``more`` bytes than now."""
        self._bound = _resident() + more

    def check(self) -> None:
        """Raise StationError beyond the bound."""
        used = _resident()
        if used > self._bound:
            raise StationError(f"the viewer does not take what it is sent: {used / 1e6:.0f} MB wait for it")


def _resident() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()
