"""The flight recorder: what was kept is read back whole, on any size of ring, while it goes on."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime.messages.event import Event
from runtime.messages.tick import TICK_DTYPE
from runtime.recorder import CHUNK, Recorder
from runtime.recording import Header, RecordingError, layout, list_recordings, load

EVENT = Event(stamp=1.5, tick=3, kind="mode", text="DAMP -> STAND_UP: asked for")


def header() -> Header:
    return Header(
        robot="r",
        robot_toml="# text",
        policy="{}",
        rate_hz=200.0,
        reason="test",
        written="now",
        versions={"trotd": "0"},
        layout=layout(),
        itemsize=TICK_DTYPE.itemsize,
        events=[EVENT],
    )


def tick(index: int) -> np.ndarray:
    row = np.zeros(1, TICK_DTYPE)
    row["index"], row["joint_position"], row["height"] = index, index * 0.5, -index
    return row


def filled(folder: Path, count: int, seconds: float = 2.0, rate_hz: float = 50.0) -> Recorder:
    recorder = Recorder(folder, rate_hz, seconds, 3, 10**9)
    for index in range(count):
        recorder.keep(tick(index))
    return recorder


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1500), st.sampled_from([1.0, 2.0, 7.0]))
def test_the_newest_ticks_come_back_in_order(
    tmp_path_factory: pytest.TempPathFactory, count: int, seconds: float
) -> None:
    recorder = filled(tmp_path_factory.mktemp("ring"), count, seconds)
    recording = load(recorder.write(header(), "a"))
    wanted = round(50 * seconds)
    np.testing.assert_array_equal(recording.ticks["index"], np.arange(max(0, count - wanted), count))
    np.testing.assert_array_equal(recording.ticks["height"], -recording.ticks["index"].astype(float))
    assert recording.header == header()


def test_a_whole_record_comes_back_bit_for_bit(tmp_path: Path) -> None:
    generator = np.random.default_rng(1)
    recorder = Recorder(tmp_path, 50.0, 2.0, 3, 10**9)
    rows = np.frombuffer(generator.bytes(20 * TICK_DTYPE.itemsize), TICK_DTYPE)
    for index in range(20):
        recorder.keep(rows[index : index + 1])
    ticks = load(recorder.write(header(), "a")).ticks
    for name in TICK_DTYPE.names or ():
        assert ticks[name].tobytes() == rows[name].tobytes()


def test_ticks_that_go_on_while_it_writes_leave_no_torn_records(tmp_path: Path) -> None:
    recorder = filled(tmp_path, 3000, seconds=10.0)
    stop = threading.Event()

    def go_on() -> None:
        index = 3000
        while not stop.is_set() and index < 3000 + CHUNK:
            recorder.keep(tick(index))
            index += 1

    ticking = threading.Thread(target=go_on)
    ticking.start()
    try:
        paths = [recorder.write(header(), f"w{n}") for n in range(3)]
    finally:
        stop.set()
        ticking.join()
    for path in paths:
        ticks = load(path).ticks
        assert (np.diff(ticks["index"].astype(int)) == 1).all()
        np.testing.assert_array_equal(ticks["joint_position"][:, 0, 0], ticks["index"] * 0.5)


def test_the_oldest_files_go_when_there_are_too_many(tmp_path: Path) -> None:
    recorder = filled(tmp_path, 10)
    for name in "abcde":
        recorder.write(header(), name)
    assert [path.stem for path in list_recordings(tmp_path)] == ["c", "d", "e"]


def test_the_oldest_files_go_when_they_are_too_large(tmp_path: Path) -> None:
    recorder = filled(tmp_path, 10)
    size = recorder.write(header(), "a").stat().st_size
    recorder = Recorder(tmp_path, 50.0, 2.0, 100, int(2.5 * size))
    for index in range(10):
        recorder.keep(tick(index))
    for name in "bcd":
        recorder.write(header(), name)
    assert [path.stem for path in list_recordings(tmp_path)] == ["c", "d"]


def test_a_write_that_fails_leaves_nothing_and_keeps_what_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = filled(tmp_path, 10)
    kept = recorder.write(header(), "a")
    before = kept.read_bytes()

    def full_disk(_fd: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(OSError, match="No space"):
        recorder.write(header(), "a")
    assert [path.name for path in tmp_path.iterdir()] == ["a.trotd"]
    assert kept.read_bytes() == before


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_damaged_file_is_named_and_never_half_read(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    path = filled(folder, 3).write(header(), "a")
    whole = path.read_bytes()
    cut = data.draw(st.integers(0, len(whole) - 1))
    path.write_bytes(whole[:cut] + data.draw(st.binary(max_size=8)))
    try:
        recording = load(path)
    except RecordingError as error:
        assert str(path) in str(error)
    else:  # cut at a record's edge: fewer whole records
        np.testing.assert_array_equal(recording.ticks["index"], np.arange(len(recording.ticks)))


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="No such file"):
        load(tmp_path / "nothing.trotd")


@pytest.mark.parametrize(
    ("mark", "words"),
    [
        (b"trotd recording 2\n", "version 2, this program reads 1; update trotd"),
        (b"trotd recording 0\n", "version 0, this program reads 1; read it with the trotd that wrote it"),
        (b"trotd recording x\n", "not a trotd recording"),
    ],
)
def test_another_versions_file_is_refused_with_its_version(tmp_path: Path, mark: bytes, words: str) -> None:
    path = tmp_path / "other.trotd"
    path.write_bytes(mark + bytes(100))
    with pytest.raises(RecordingError, match=words):
        load(path)
