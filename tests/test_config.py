"""The configuration's door: every mistake is one line that names key, value and bound."""

from __future__ import annotations

import copy
import math
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runtime import config
from runtime.config import ROBOTS, Config, ConfigError

STOCH3: dict[str, Any] = tomllib.loads((ROBOTS / "stoch3.toml").read_text())


def leaves(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(leaf for key, item in items for leaf in leaves(item, (*path, key)))] if path or items else [path]


PLACES = [path for path in leaves(STOCH3) if path]


def changed(path: tuple[Any, ...], value: Any) -> dict[str, Any]:
    table = copy.deepcopy(STOCH3)
    target: Any = table
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    return table


@pytest.mark.parametrize("path", sorted(ROBOTS.glob("*.toml")), ids=lambda path: path.stem)
def test_every_shipped_robot_loads(path: Path) -> None:
    assert path.stem.startswith(config.load(path).robot.name)


@settings(max_examples=400, deadline=None)
@given(
    st.sampled_from(PLACES),
    st.none()
    | st.booleans()
    | st.text(max_size=4)
    | st.floats()
    | st.integers(-5, 5)
    | st.lists(st.floats(), max_size=4)
    | st.dictionaries(st.text(max_size=4), st.integers(), max_size=2)
    | st.datetimes(),
)
def test_whatever_stands_in_the_file_loads_or_is_one_line(path: tuple[Any, ...], value: Any) -> None:
    try:
        made = config.parse(changed(path, value), "my.toml")
    except ConfigError as error:
        text = str(error)
        assert text.startswith("my.toml: ")
        assert "\n" not in text
    else:
        assert isinstance(made, Config)


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("robot",), {"\n": 0}, r"unknown field `\n`"),
        (("robot",), {"a\r": math.nan}, r"robot.a\r = nan"),
        (("motors", "gear", 0), 3e-183, "motors.gear[0] = 3e-183"),
        (("motors", "gear", 0), 1.4e154, "motors.gear[0] = 1.4e+154"),
        (("motors", "max_torque", 2), 1e200, "motors.max_torque[2] = 1e+200"),
    ],
)
def test_odd_keys_and_numbers_are_named_on_one_line(path: tuple[Any, ...], value: Any, words: str) -> None:
    with pytest.raises(ConfigError) as refused:
        config.parse(changed(path, value), "my.toml")
    assert words in str(refused.value) and str(refused.value).isprintable()


@settings(max_examples=200, deadline=None)
@given(st.text(max_size=200) | st.binary(max_size=200))
def test_whatever_the_file_is_it_loads_or_is_one_line(
    tmp_path_factory: pytest.TempPathFactory, data: str | bytes
) -> None:
    path = tmp_path_factory.mktemp("config") / "robot.toml"
    path.write_bytes(data if isinstance(data, bytes) else data.encode(errors="surrogatepass"))
    with pytest.raises(ConfigError, match=str(path)):
        config.load(path)


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("control", "rate_hz"), 20.0, "control.rate_hz = 20.0: Expected `float` >= 50"),
        (("control", "rate_hz"), "fast", "control.rate_hz = 'fast': Expected `float`"),
        (("control", "gaits"), 1, "gaits"),
        (("control", "gait", "name"), "gallop", "control.gait.name = 'gallop'"),
        (("control", "gait", "walking_height"), 0.9, "control.gait.walking_height = 0.9: the leg reaches 0.614 m"),
        (("control", "gains", "kp"), [1.0, 2.0], "control.gains.kp = [1.0, 2.0]: Expected `array` of length 3"),
        (("control", "grf", "min_force"), 500.0, "control.grf.min_force = 500.0: must be below max_force = 400.0"),
        (("robot", "joints", "lower", 0, 1), 3.0, "robot.joints.lower[0][1] = 3.0: must be below upper[0][1]"),
        (("robot", "thigh_length"), math.nan, "robot.thigh_length = nan: must be finite"),
        (("robot", "name"), "no spaces", "robot.name = 'no spaces'"),
        (("limits",), {"max_tilt": 0.2}, "limits.arming_tilt = 0.35: must not pass max_tilt = 0.2"),
        (("link",), {"listen": ["tcp/0.0.0.0:7447"]}, "link.listen = 'tcp/0.0.0.0:7447': off the loopback"),
        (("link",), {"listen": ["7447"]}, "link.listen[0] = '7447'"),
        (("realtime",), {"priority": 99}, "realtime.priority = 99"),
        (("recorder",), {"seconds": 0}, "recorder.seconds = 0"),
    ],
)
def test_a_mistake_is_named(path: tuple[Any, ...], value: Any, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        config.parse(changed(path, value), "my.toml")
    assert words in str(caught.value)


def test_off_loopback_is_allowed_when_it_says_so() -> None:
    link = {"listen": ["tcp/0.0.0.0:7447"], "allow_unprotected": True}
    assert config.parse(changed(("link",), link), "my.toml").link.listen == ("tcp/0.0.0.0:7447",)


def test_an_override_is_checked_like_a_file() -> None:
    made = config.load(ROBOTS / "stoch3.toml")
    assert config.override(made, "command line", {"control.rate_hz": 500.0}).control.rate_hz == 500.0
    assert config.override(made, "command line", {}) == made
    with pytest.raises(ConfigError, match=r"command line: control\.rate_hz = 5000"):
        config.override(made, "command line", {"control.rate_hz": 5000.0})


def test_an_unknown_robot_lists_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="stoch3"):
        config.find_robot("spot")
    with pytest.raises(ConfigError, match="no such file"):
        config.find_robot(str(tmp_path / "mine.toml"))
