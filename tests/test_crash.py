"""A run that ends without a word: killed or crashed in the middle of a walk, its last minute is a recording."""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from daemons import PATIENCE, quick_robot, running
from hypothesis import given
from hypothesis import strategies as st
from walks import Walk

from runtime import crash
from runtime.messages.event import Event
from runtime.messages.mode import Mode, Request
from runtime.recorder import EVENT_DTYPE, EVENTS, Recorder, event_row
from runtime.recording import SUFFIX, list_recordings, load
from runtime.replay import replay
from runtime.state import OWNER, memory_folder
from station.requests import set_off


def left_by(walk: Walk, memory: Path) -> None:
    """What ``walk`` would leave, were it killed now."""
    header = walk.header("crash")
    crash.keep_header(memory, header)


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Walk:
    folder = tmp_path_factory.mktemp("killed")
    walk = Walk(folder, seconds=3.0)
    (folder / "memory").mkdir()
    walk.recorder = Recorder(folder, walk.config.control.rate_hz, 3.0, 9, 10**9, folder / "memory" / crash.RING)
    walk.stand()
    walk.ask(Request.WALK)
    walk.run(2.0, (0.4, 0.0, 0.2))
    left_by(walk, folder / "memory")
    return walk


@pytest.fixture
def memory(walked: Walk, tmp_path: Path) -> Path:
    """A copy of what the walk left."""
    copy = tmp_path / "memory" / "robot"
    copy.mkdir(parents=True)
    for file in (walked.recorder.folder / "memory").iterdir():
        (copy / file.name).write_bytes(file.read_bytes())
    return copy


def test_the_last_seconds_come_back_and_replay(walked: Walk, memory: Path, tmp_path: Path) -> None:
    (left,) = crash.claim(memory)
    path, words = crash.salvage(left, tmp_path / "shelf", 9, 10**9)
    assert path is not None and path.name.endswith(f"-crash{SUFFIX}") and "ended without a word" in words
    recording = load(path)
    ticks = recording.ticks
    np.testing.assert_array_equal(np.diff(ticks["index"]), 1)
    assert ticks["index"][-1] == walked.index and len(ticks) >= 3.0 * recording.header.rate_hz
    assert recording.header.events == list(walked.recorder.events) and recording.header.reason == "crash"
    result = replay(recording)
    assert result.difference is None and result.modes["WALK"] >= 300
    assert not left.exists() and not memory.exists()


def test_what_was_claimed_and_not_written_is_claimed_again(memory: Path, tmp_path: Path) -> None:
    (left,) = crash.claim(memory)
    nowhere = tmp_path / "file"
    nowhere.write_bytes(b"")
    with pytest.raises(OSError):
        crash.salvage(left, nowhere / "shelf", 9, 10**9)
    assert crash.claim(memory) == [left]
    assert crash.salvage(left, tmp_path / "shelf", 9, 10**9)[0] is not None
    assert crash.claim(memory) == []


def test_runs_that_wait_are_few_and_the_first_are_kept(memory: Path, tmp_path: Path) -> None:
    files = {file.name: file.read_bytes() for file in memory.iterdir()}
    first = crash.claim(memory)
    for _ in range(2 * crash.LEFT):
        memory.mkdir()
        for name, data in files.items():
            (memory / name).write_bytes(data)
        waiting = crash.claim(memory)
    assert waiting[0] == first[0] and len(waiting) == crash.LEFT and not memory.exists()


def test_a_run_without_a_tick_leaves_nothing(walked: Walk, tmp_path: Path) -> None:
    memory = tmp_path / "memory" / "robot"
    memory.mkdir(parents=True)
    Recorder(tmp_path, 200.0, 1.0, 9, 10**9, memory / crash.RING)
    crash.keep_header(memory, walked.header("crash"))
    (left,) = crash.claim(memory)
    assert crash.salvage(left, tmp_path / "shelf", 9, 10**9) == (None, "it had not begun to tick")
    assert not left.exists()


def test_of_runs_that_were_never_armed_the_newest_is_kept(walked: Walk, tmp_path: Path) -> None:
    kept = []
    for number in (1, 2, 3):
        memory = tmp_path / "memory" / "robot"
        memory.mkdir(parents=True)
        recorder = Recorder(tmp_path, 200.0, 1.0, 9, 10**9, memory / crash.RING)
        row = walked.cycle.tick.copy()
        row["armed"], row["stamp"] = 0, float(number)
        recorder.keep(row)
        crash.keep_header(memory, walked.header("crash"))
        kept.append(crash.salvage(crash.claim(memory)[0], tmp_path / "shelf", 9, 10**9)[0])
    assert list_recordings(tmp_path / "shelf") == [kept[-1]]


@given(st.data())
def test_a_damaged_ring_is_named_and_gone_or_gives_ticks(
    walked: Walk, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    memory = folder / "robot"
    memory.mkdir()
    name = data.draw(st.sampled_from([crash.RING, crash.HEADER]))
    for file in (walked.recorder.folder / "memory").iterdir():
        whole = file.read_bytes()
        if file.name == name:
            at = data.draw(st.integers(0, min(len(whole), 3000)))
            whole = whole[:at] + data.draw(st.binary(min_size=1, max_size=8)) + whole[at + 8 :]
            whole = whole[: data.draw(st.integers(0, len(whole)) | st.just(len(whole)))]
        (memory / file.name).write_bytes(whole)
    (left,) = crash.claim(memory)
    try:
        path, _ = crash.salvage(left, folder / "shelf", 9, 10**9)
    except crash.CrashError as error:
        assert str(left) in str(error)
    else:
        assert path is None or len(load(path).ticks)
    assert not left.exists()


@pytest.mark.parametrize(("name", "kind", "shape"), [
    ("stamp", "<f8", [28]), ("armed", "|u1", [2]), ("index", "<u8", [3]), ("stamp", None, []),
])  # fmt: skip
def test_a_header_that_says_nonsense_of_a_tick_is_named_and_gone(
    memory: Path, tmp_path: Path, name: str, kind: str | None, shape: list[int]
) -> None:
    (left,) = crash.claim(memory)
    table = json.loads((left / crash.HEADER).read_bytes())
    layout = table["header"]["layout"]
    (place,) = (row for row, field in enumerate(layout) if field[0] == name)
    if kind is None:
        del layout[place]
    else:
        layout[place][1:3] = kind, shape
    (left / crash.HEADER).write_bytes(json.dumps(table).encode())
    with pytest.raises(crash.CrashError, match=name):
        crash.salvage(left, tmp_path / "shelf", 9, 10**9)
    assert not left.exists()


@given(st.text(max_size=2000), st.integers(0, 2**60))
def test_an_event_fits_its_room_and_stays_json(text: str, tick: int) -> None:
    row = event_row(Event(stamp=1.5, tick=tick, kind="recording", text=text))
    found = json.loads(row.tobytes().rstrip(b"\0"))
    assert row.dtype == EVENT_DTYPE and found["tick"] == tick
    if len(text) < 60 and text.isascii() and text.isprintable():
        assert found["text"] == text


def test_more_events_than_there_is_room_for(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, 200.0, 1.0, 9, 10**9, tmp_path / "ring")
    for number in range(EVENTS + 20):
        recorder.keep_event(Event(stamp=0.0, tick=number, kind="mode", text="x"))
    assert [event.tick for event in recorder.events] == list(range(20, EVENTS + 20))


# A daemon of its own --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV])
def test_a_walk_that_is_killed_is_there_at_the_next_start(tmp_path: Path, number: signal.Signals) -> None:
    robot = quick_robot(tmp_path)
    with running(tmp_path, robot, "null") as (process, station):
        set_off(station)
        for _ in range(20):
            station.session.put(station.keys.velocity, b'{"linear": [0.3, 0.0], "yaw_rate": 0.0}')
            time.sleep(0.02)
        seen = station.next_status()
        process.send_signal(number)
        process.wait()
    assert seen.mode == "WALK" and not list_recordings(tmp_path / "recordings" / "stoch3")
    with running(tmp_path, robot, "null") as (process, station):
        while not (written := list_recordings(tmp_path / "recordings" / "stoch3")):
            time.sleep(0.05)
        assert station.next_status().mode == "DAMP"
        process.send_signal(signal.SIGTERM)
        log = process.communicate(timeout=PATIENCE)[1]
    assert f"the run before: it ended without a word at {load(written[0]).header.written}" in log
    assert str(written[0]) in log and written[0].name.endswith(f"-crash{SUFFIX}")
    recording = load(written[0])
    assert recording.ticks["mode"][-1] == Mode.WALK and recording.ticks["index"][-1] >= seen.ticks
    np.testing.assert_array_equal(recording.ticks["asked_velocity"][-1], [0.3, 0.0, 0.0])
    result = replay(recording)
    assert result.difference is None and result.ticks == len(recording.ticks) - 1
    left = [file for file in (tmp_path / "run").rglob("*") if file.is_file()]
    assert [file.name for file in left] == [OWNER], "a run that ends in order leaves nothing in memory"


def test_what_belongs_to_a_state_folder_that_is_gone_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "run"))
    states = [tmp_path / "a", tmp_path / "b"]
    gone, kept = (memory_folder(state) for state in states)
    for folder in (gone, kept):
        (folder / "robot").mkdir()
    states[0].rmdir()
    assert memory_folder(states[1]) == kept
    assert not gone.exists() and (kept / "robot").is_dir()
