"""The wire's doors, fuzzed: nothing but a message that is whole and within bounds gets through."""

from __future__ import annotations

import json
import math

import msgspec
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from runtime.control.records import CONTROL_DTYPE
from runtime.messages.decoding import MessageError
from runtime.messages.mode import Request, decode_request
from runtime.messages.motion import decode_velocity
from runtime.messages.simulation import decode_push
from runtime.messages.tick import CONTROL_OFFSET, TICK_DTYPE, tick_schema

LINEAR, YAW = (2.0, 0.8), 1.5
anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=9), inner, max_size=3),
    max_leaves=6,
)
numbers = st.floats() | st.integers() | st.floats(-3, 3)
nearly = st.fixed_dictionaries(
    {"linear": st.lists(numbers, max_size=3) | anything, "yaw_rate": numbers | anything},
    optional={"extra": anything},
)


@given(
    st.binary() | anything.map(lambda value: json.dumps(value).encode()) | nearly.map(lambda m: json.dumps(m).encode())
)
@example(b'{"linear": [1e999, 0], "yaw_rate": 0}')
@example(b'{"linear": [NaN, 0], "yaw_rate": 0}')
@example(b"[" * 5000)
@example(b'{"linear": [0.1, 0.1], "yaw_rate": 0.1}')
def test_a_velocity_that_gets_through_is_finite_and_within_bounds(data: bytes) -> None:
    try:
        message = decode_velocity(data, LINEAR, YAW)
    except MessageError as error:
        assert str(error)
        return
    values = (*message.linear, message.yaw_rate)
    assert all(math.isfinite(value) for value in values)
    assert all(abs(value) <= bound for value, bound in zip(values, (*LINEAR, YAW), strict=True))


@given(st.floats(-2, 2), st.floats(-0.8, 0.8), st.floats(-1.5, 1.5))
def test_every_velocity_within_bounds_gets_through_unchanged(x: float, y: float, yaw: float) -> None:
    message = decode_velocity(json.dumps({"linear": [x, y], "yaw_rate": yaw}).encode(), LINEAR, YAW)
    assert (*message.linear, message.yaw_rate) == (x, y, yaw)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b'{"linear": [2.5, 0], "yaw_rate": 0}', "linear[0] = 2.5: must be within ±2"),
        (b'{"linear": [0, -0.9], "yaw_rate": 0}', "linear[1] = -0.9: must be within ±0.8"),
        (b'{"linear": [0, 0], "yaw_rate": 2}', "yaw_rate = 2.0: must be within ±1.5"),
        (b'{"linear": [0, 0]}', "yaw_rate"),
        (b'{"linear": [0], "yaw_rate": 0}', "length 2"),
        (b'{"linear": [0, 0], "yaw_rate": 0, "z": 1}', "z"),
        (b" " * 5000, "5000 bytes"),
    ],
)
def test_a_refused_velocity_names_what_is_wrong(data: bytes, words: str) -> None:
    with pytest.raises(MessageError) as caught:
        decode_velocity(data, LINEAR, YAW)
    assert words in str(caught.value)


@given(st.binary() | st.text().map(str.encode) | st.sampled_from([word.value.encode() for word in Request]))
def test_only_the_six_words_ask_for_a_mode(data: bytes) -> None:
    words = {word.value for word in Request}
    try:
        request = decode_request(data)
    except MessageError as error:
        assert "must be one of arm, stand, walk, sit, damp, clear" in str(error)
        assert "\n" not in str(error)
    else:
        assert request.value in words
        assert data.decode().strip() == request.value


@given(
    st.binary()
    | nearly.map(lambda m: json.dumps(m).encode())
    | st.builds(
        lambda force, duration: json.dumps({"force": force, "duration": duration}).encode(),
        st.lists(numbers, min_size=2, max_size=4),
        numbers,
    )
)
def test_a_push_that_gets_through_makes_sense(data: bytes) -> None:
    try:
        push = decode_push(data)
    except MessageError:
        return
    assert all(abs(value) <= 5000.0 for value in push.force)
    assert 0.0 < push.duration <= 10.0


def test_any_language_can_read_a_tick_by_the_schema() -> None:
    schema = msgspec.json.decode(tick_schema())
    tick = np.zeros(1, TICK_DTYPE)
    tick["joint_position"] = np.arange(12).reshape(4, 3)
    tick["index"] = 7
    data = tick.tobytes()
    assert schema["itemsize"] == len(data)
    read = {}
    for row in schema["fields"]:
        count = int(np.prod(row["shape"])) if row["shape"] else 1
        values = np.frombuffer(data, row["type"], count, row["offset"])
        read[row["name"]] = values.reshape(row["shape"]) if row["shape"] else values[0]
    assert read["index"] == 7
    np.testing.assert_array_equal(read["joint_position"], np.arange(12).reshape(4, 3))


def test_the_cores_part_is_the_tail_of_the_tick() -> None:
    assert TICK_DTYPE.fields is not None and CONTROL_DTYPE.fields is not None
    for name in CONTROL_DTYPE.names or ():
        assert TICK_DTYPE.fields[name][1] == CONTROL_OFFSET + CONTROL_DTYPE.fields[name][1]
        assert TICK_DTYPE.fields[name][0] == CONTROL_DTYPE.fields[name][0]
