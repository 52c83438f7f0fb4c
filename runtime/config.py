"""A robot's TOML → frozen records. Unknown key, wrong shape or a number out of range is a ``ConfigError``."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from drivers.description import Record, RobotDescription
from runtime.control.parameters import ControlConfig

ROBOTS = Path(__file__).parent / "robots"


class ConfigError(ValueError):
    """A configuration that cannot be used: the message names the file, the key, the value and the bound."""


class Config(Record, frozen=True, kw_only=True):
    """One robot's TOML, whole."""

    robot: RobotDescription
    control: ControlConfig


def find_robot(name: str) -> Path:
    """The TOML that ``name`` means: a path to a file, or the name of a shipped robot.

    Raises:
        ConfigError: neither; the message lists the shipped robots.
    """
    path = Path(name)
    if path.suffix == ".toml":
        if path.is_file():
            return path
        raise ConfigError(f"{name}: no such file")
    shipped = ROBOTS / f"{name}.toml"
    if shipped.is_file():
        return shipped
    known = ", ".join(sorted(file.stem for file in ROBOTS.glob("*.toml")))
    raise ConfigError(f"robot {name!r} is not known; the shipped ones are {known}; or name a .toml file")


def load(path: Path) -> Config:
    """Read and check a robot's TOML.

    Raises:
        ConfigError: unreadable, not TOML, an unknown key, a wrong type or shape, or a number out of its bounds.
    """
    try:
        with path.open("rb") as file:
            table = tomllib.load(file)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not TOML: {error}") from error
    return parse(table, str(path))


def parse(table: dict[str, Any], place: str) -> Config:
    """Check a TOML table; ``place`` is how messages name where it came from."""
    for key, value in _numbers(table, ""):
        if not math.isfinite(value):
            raise ConfigError(f"{place}: {key} = {value}: must be finite")
    try:
        return msgspec.convert(table, Config)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{place}: {_explain(str(error), table)}") from error


def _numbers(value: Any, key: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, dict):
        for name, item in value.items():
            yield from _numbers(item, f"{key}.{name}" if key else name)
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from _numbers(item, f"{key}[{index}]")
    elif isinstance(value, float):
        yield key, value


def _explain(message: str, table: dict[str, Any]) -> str:
    """msgspec's ``Expected `float` > 0 - at `$.control.gait.swing_time``` with key and value put first."""
    match = re.fullmatch(r"(?P<what>.*?)(?: - at `\$\.?(?P<key>[^`]*)`)?", message, re.DOTALL)
    if match is None or not match["key"]:
        return message
    value: Any = table
    for part in re.findall(r"[^.\[\]]+", match["key"]):
        try:
            value = value[int(part)] if isinstance(value, list) else value[part]
        except (KeyError, IndexError, ValueError, TypeError):
            return f"{match['key']}: {match['what']}"
    if isinstance(value, dict):
        return f"{match['key']}: {match['what']}"
    return f"{match['key']} = {value!r}: {match['what']}"
