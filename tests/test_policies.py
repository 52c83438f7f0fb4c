"""Policy files: what is refused, and how: one line that names the place, the key, the value and the bound."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import policy

from runtime.control.policy import GRF_NAMES, SHIFT_NAMES, encode_policy
from runtime.control.state import HIDDEN
from runtime.policies import LARGEST_FILE, SHIPPED, PolicyError, decode, find_policy, load

PLACE = "/flash/new.json"


def table() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(encode_policy(policy()))
    return found


def refusal(changed: dict[str, Any] | bytes, robot: str = "stoch3") -> str:
    data = changed if isinstance(changed, bytes) else json.dumps(changed).encode()
    with pytest.raises(PolicyError) as caught:
        decode(data, robot, PLACE)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(PLACE + ": ")
    return message.removeprefix(PLACE + ": ")


def test_what_was_written_is_read_again() -> None:
    assert decode(encode_policy(policy()), "stoch3", PLACE) == policy()


@pytest.mark.parametrize("name", sorted(path.stem for path in SHIPPED.glob("*.json")))
def test_shipped_files_load_for_their_robot(name: str) -> None:
    path = find_policy(name)
    robot = json.loads(path.read_bytes())["robot"]
    assert load(path, robot).name


def test_another_robots_policy() -> None:
    message = refusal(table(), "a1")
    assert "robot = 'stoch3'" in message and "'a1'" in message


@pytest.mark.parametrize("key", ["matrix", "observation_scale", "action_scale", "action_bound"])
@pytest.mark.parametrize("poison", [float("nan"), float("inf"), -float("inf"), "0.1", None, True, [], 1e999])
def test_a_number_that_is_none(key: str, poison: Any) -> None:
    changed = table()
    row = changed[key][3] if key == "matrix" else changed[key]
    row[5] = poison
    message = refusal(changed)
    assert key in message or "JSON is malformed" in message


@pytest.mark.parametrize("key", ["matrix", "observation_scale"])
def test_a_number_that_is_enormous(key: str) -> None:
    changed = table()
    (changed[key][3] if key == "matrix" else changed[key])[5] = 1e7
    message = refusal(changed)
    assert key in message and "1000000" in message


@pytest.mark.parametrize("value", [0.0, -0.1])
def test_a_bound_that_is_not_positive(value: float) -> None:
    changed = table()
    changed["action_bound"][2] = value
    message = refusal(changed)
    assert "action_bound" in message and "> 0" in message


@given(height=st.integers(0, 30), width=st.integers(0, 40))
def test_wrong_shape(height: int, width: int) -> None:
    changed = table()
    changed["matrix"] = [[0.0] * width for _ in range(height)]
    data = json.dumps(changed).encode()
    if (height, width) == (18, 28):
        decode(data, "stoch3", PLACE)
        return
    with pytest.raises(PolicyError, match="matrix") as caught:
        decode(data, "stoch3", PLACE)
    assert height == 0 or "18" in str(caught.value) or "28" in str(caught.value)


@pytest.mark.parametrize(
    ("key", "length", "wanted"),
    [
        ("observation_scale", 27, "28"),
        ("observation_offset", 14, "28"),
        ("action_scale", 19, "18"),
        ("action_bound", 0, "18"),
    ],
)
def test_wrong_length(key: str, length: int, wanted: str) -> None:
    message = refusal({**table(), key: [1.0] * length})
    assert key in message and wanted in message and str(length) in message


def test_a_row_that_is_short_is_named_by_its_index() -> None:
    changed = table()
    changed["matrix"][7].pop()
    message = refusal(changed)
    assert "matrix" in message and "row 7" in message and "27" in message


def test_unknown_and_missing_keys_are_named() -> None:
    assert "gain" in refusal({**table(), "gain": 1.0})
    for key in ("name", "robot", "observation_scale", "action_bound"):
        changed = table()
        del changed[key]
        assert key in refusal(changed)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("format", 2),
        ("reading", "absolute"),
        ("output", "torque"),
        ("name", "../../etc"),
        ("shift_time_constant", -1.0),
    ],
)
def test_a_value_outside_its_choices_names_its_key(key: str, value: Any) -> None:
    assert key in refusal({**table(), key: value})


def test_unknown_term_and_negative_term() -> None:
    changed = table()
    changed["terms"]["boost"] = 1.0
    assert "boost" in refusal(changed)
    changed = table()
    changed["terms"]["capture_point"] = -0.1
    assert "capture_point" in refusal(changed)


def test_another_layout_names_the_first_difference() -> None:
    changed = table()
    changed["observation_names"][4], changed["observation_names"][5] = "velocity_y", "velocity_x"
    message = refusal(changed)
    assert "observation_names[4]" in message and "'velocity_y'" in message and "'velocity_x'" in message
    changed = table()
    changed["action_names"] = list(SHIFT_NAMES + GRF_NAMES)
    assert "action_names" in refusal(changed)


def test_layers() -> None:
    both = {**table(), "hidden": [[0.0] * 28], "readout": [[0.0]] * 18}
    assert "either a matrix or hidden" in refusal(both)
    assert "either a matrix or hidden" in refusal({**table(), "matrix": []})
    wide = {**both, "matrix": [], "hidden": [[0.0] * 28] * (HIDDEN + 1)}
    message = refusal(wide)
    assert "hidden" in message and str(HIDDEN) in message and str(HIDDEN + 1) in message
    assert "readout" in refusal({**both, "matrix": [], "readout": [[0.0]] * 17})
    decode(json.dumps({**both, "matrix": []}).encode(), "stoch3", PLACE)


@given(data=st.binary(max_size=200))
def test_any_bytes(data: bytes) -> None:
    assert len(refusal(data)) > len(PLACE) + 2, "it says what is wrong with them"


@given(value=st.recursive(st.none() | st.booleans() | st.floats() | st.text(max_size=5), st.lists, max_leaves=8),
       key=st.sampled_from(sorted(table())))  # fmt: skip
def test_any_value_under_any_key_is_taken_or_refused_by_name(value: Any, key: str) -> None:
    changed = {**table(), key: value}
    try:
        decode(json.dumps(changed).encode(), "stoch3", PLACE)
    except PolicyError as error:
        assert str(error).startswith(PLACE) and "\n" not in str(error)


def test_a_file_that_is_too_large_is_not_read_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "big.json"
    path.write_bytes(b" " * (LARGEST_FILE + 10))
    with pytest.raises(PolicyError, match=str(LARGEST_FILE)):
        load(path, "stoch3")


def test_missing_files_are_named_with_the_shipped_ones(tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match=r"'nothing'.*shipped ones: .*balance"):
        find_policy("nothing", tmp_path)
    with pytest.raises(PolicyError, match=r"gone\.json: No such file"):
        load(tmp_path / "gone.json", "stoch3")
    with pytest.raises(PolicyError, match="directory"):
        load(tmp_path, "stoch3")


def test_a_file_beside_the_robot_comes_before_a_shipped_one(tmp_path: Path) -> None:
    own = tmp_path / "balance.json"
    own.write_bytes(b"{}")
    assert find_policy("balance", tmp_path) == own
    assert find_policy("balance.json") == SHIPPED / "balance.json"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": 2}, "format = 2: this program reads 1; update trotd"),
        ({"format": 0}, "format = 0: this program reads 1; train or export it anew"),
        ({"format": None}, "format"),
        ({}, "missing required field `format`"),
    ],
)
def test_another_versions_file_is_refused_with_its_version(change: dict[str, Any], words: str) -> None:
    table = json.loads(find_policy("balance").read_bytes())
    del table["format"]
    with pytest.raises(PolicyError, match=words):
        decode(json.dumps(table | change).encode(), "stoch3", "here")
