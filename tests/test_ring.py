"""Rings in memory that outlives the process: whatever the moment of the end, only whole rows come back, in order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.ring import Kind, RingError, create, open_left

ROW = np.dtype([("number", "u8"), ("payload", "u1", (37,))])
KINDS = [Kind(ROW, 7), Kind(np.dtype("S20"), 3)]


def row(number: int) -> np.ndarray:
    made = np.zeros(1, ROW)
    made["number"], made["payload"] = number, number % 251
    return made


@given(st.integers(0, 40), st.sampled_from(["between rows", "row begun", "row half written"]))
def test_what_was_whole_comes_back_in_order(tmp_path_factory: pytest.TempPathFactory, count: int, moment: str) -> None:
    path = tmp_path_factory.mktemp("ring") / "ring"
    rows, words = create(KINDS, path)
    for number in range(count):
        rows.put(row(number))
        words.put(np.array([b"word %d" % number], KINDS[1].dtype))
    kept = min(count, 7)
    if moment != "between rows":
        place = count % 7
        rows.sequence[place] = 0
        if moment == "row half written":
            rows.rows["payload"][place, :18] = 255
        kept = min(count, 6)
    left, words_left = open_left(path, 2)
    found = left.rows.view(ROW)[left.whole()]
    np.testing.assert_array_equal(found["number"], np.arange(count - kept, count))
    np.testing.assert_array_equal(found["payload"], np.repeat(found["number"][:, None] % 251, 37, axis=1))
    said = [words_left.rows[place].tobytes().rstrip(b"\0") for place in words_left.whole()]
    assert said == [b"word %d" % number for number in range(max(0, count - 3), count)]


def test_rows_beyond_a_gap_are_not_joined_to_the_newest(tmp_path: Path) -> None:
    rows, _ = create(KINDS, tmp_path / "ring")
    for number in range(20):
        rows.put(row(number))
    rows.sequence[16 % 7] = 3  # what a page that never reached its place would say
    left, _ = open_left(tmp_path / "ring", 2)
    np.testing.assert_array_equal(left.rows.view(ROW)[left.whole()]["number"], [17, 18, 19])


@given(st.data())
def test_a_damaged_file_is_named_or_gives_whole_rows(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("ring") / "ring"
    rows, _ = create(KINDS, path)
    for number in range(9):
        rows.put(row(number))
    whole = path.read_bytes()
    cut = data.draw(st.integers(0, len(whole)))
    at = data.draw(st.integers(0, 60))
    spoilt = whole[:at] + data.draw(st.binary(max_size=4)) + whole[at:]
    path.write_bytes(spoilt[:cut])
    if path.read_bytes() == whole:
        return
    try:
        open_left(path, 2)
    except RingError as error:
        assert str(path) in str(error)
    else:
        assert len(path.read_bytes()) == len(whole), "its size alone gives it away"


def test_no_room_is_refused_before_the_first_row(tmp_path: Path) -> None:
    huge = Kind(np.dtype("S4096"), 2**40)
    with pytest.raises(OSError):
        create([huge], tmp_path / "ring")
