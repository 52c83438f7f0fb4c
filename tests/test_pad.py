"""A pad's event bytes through a pipe and a terminal's keys: what becomes of them, whatever they are."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pad_events import (
    BACK,
    BUMPER,
    CENTRED,
    DROPPED,
    FORWARD,
    LEFT,
    REPORT,
    TURN,
    XPAD,
    B,
    axis,
    button,
)

from station.driving import Driving
from station.keyboard import HOLD_SECONDS, Keys
from station.pad import EVENT, Pad, PadDevice, SourceLost, Sticks, load_mapping, shipped_mappings, used_axes
from station.session import StationError


def test_an_event_is_twenty_four_bytes_on_this_machine() -> None:
    assert EVENT.size == 24


def test_sticks_are_unknown_until_every_axis_has_spoken() -> None:
    pad = Pad(XPAD)
    pad.feed(axis(FORWARD, 0) + axis(TURN, 0))
    assert pad.sticks is None
    pad.feed(axis(LEFT, 0))
    assert pad.sticks == Sticks()


def test_up_is_forward_and_left_is_left_and_the_bumper_holds() -> None:
    pad = Pad(XPAD)
    pad.feed(axis(FORWARD, -32768) + axis(TURN, -32768) + axis(LEFT, -32768) + button(BUMPER))
    assert pad.sticks == Sticks(forward=1.0, left=1.0, turn=1.0, held=True)
    pad.feed(button(BUMPER, 0))
    assert pad.sticks is not None and not pad.sticks.held


@given(st.binary(max_size=30), st.lists(st.integers(1, 30), max_size=20))
def test_bytes_cut_anywhere_mean_the_same(noise: bytes, cuts: list[int]) -> None:
    data = CENTRED + axis(FORWARD, -20000) + button(B) + REPORT + button(BUMPER) + button(BACK) + noise
    whole, parts = Pad(XPAD), Pad(XPAD)
    wanted = whole.feed(data)
    got = []
    for cut in cuts:
        got += parts.feed(data[:cut])
        data = data[cut:]
    got += parts.feed(data)
    assert (got, parts.sticks) == (wanted, whole.sticks)
    assert got[:2] == ["walk", "idle"]


def test_lost_events_make_the_sticks_unknown_and_release_the_dead_man() -> None:
    pad = Pad(XPAD)
    pad.feed(CENTRED + button(BUMPER) + REPORT)
    assert pad.feed(DROPPED + axis(FORWARD, -32768) + button(B) + REPORT) == []
    assert pad.sticks is None
    pad.feed(CENTRED)
    assert pad.sticks == Sticks(held=False)


@given(st.integers(-(2**31), 2**31 - 1), st.integers(-(2**31), 2**31 - 1))
def test_a_stick_never_asks_for_more_than_all(value: int, other: int) -> None:
    pad = Pad(XPAD)
    pad.feed(CENTRED + axis(FORWARD, value) + axis(LEFT, other))
    sticks = pad.sticks
    assert sticks is not None
    assert -1 <= sticks.forward <= 1 and -1 <= sticks.left <= 1
    assert abs(value) > 32768 * XPAD.dead_zone * 0.99 or sticks.forward == 0


@pytest.mark.parametrize("name", [name for name, _ in shipped_mappings()])
def test_shipped_mappings_give_every_stick_and_button_a_code_of_its_own(name: str) -> None:
    mapping = dict(shipped_mappings())[name]
    codes = [getattr(mapping.buttons, field) for field in mapping.buttons.__struct_fields__]
    assert len(set(codes)) == len(codes) and None not in codes
    assert len({axis.code for axis in used_axes(mapping).values()}) == 4


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = [", "Invalid value|x"),
        ("[axes]", "forward|required"),
        ("nonsense = 1", "nonsense"),
        ("dead_zone = 1.5", "dead_zone|<"),
    ],
)
def test_a_mapping_that_cannot_be_used_is_refused_by_name(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "pad.toml"
    path.write_text(text)
    with pytest.raises(StationError, match=words) as refused:
        load_mapping(path)
    assert str(path) in str(refused.value)


def test_a_pad_that_is_pulled_out_is_lost(fifo: tuple[Path, int]) -> None:
    path, fd = fifo
    device = PadDevice(path, XPAD)
    assert device.read() == []
    os.write(fd, CENTRED + button(B))
    assert device.read() == ["walk"]
    assert device.sticks == Sticks()
    device.close()
    with pytest.raises(SourceLost, match="No such file"):
        PadDevice(path.with_name("event1"), XPAD)


def test_a_key_counts_as_held_only_while_it_repeats() -> None:
    now = 0.0
    keys = Keys(lambda: now)
    keys.feed(b"9w")
    assert keys.sticks.forward == 1.0
    now = HOLD_SECONDS
    assert keys.sticks.centred


@given(st.binary(max_size=50))
def test_any_bytes_from_the_terminal_are_borne(data: bytes) -> None:
    keys = Keys()
    for name in keys.feed(data):
        assert name in ("pose", "gait") or Driving.requests(name, keys.sticks, armed=False)
    assert all(abs(share) <= 1 for share in (keys.sticks.forward, keys.sticks.left, keys.sticks.turn))
