"""The wiring in the shipped robots' TOMLs."""

from __future__ import annotations

import tomllib

import msgspec
import pytest

from drivers.hardware import build_bus
from drivers.motor_codec import build_codec
from runtime import config
from runtime.config import ROBOTS, ConfigError


def table(name: str) -> dict:
    return tomllib.loads((ROBOTS / f"{name}.toml").read_text())


def test_the_two_stoch3_differ_in_nothing_but_the_bus():
    pi3hat, socketcan = table("stoch3"), table("stoch3-socketcan")
    assert pi3hat.pop("bus") != socketcan.pop("bus")
    assert pi3hat == socketcan


@pytest.mark.parametrize("name", ["stoch3", "stoch3-socketcan"])
def test_bus_and_motors_fit_together(name):
    loaded = config.load(config.find_robot(name))
    assert loaded.bus is not None
    assert loaded.motors is not None
    build_bus(loaded.bus, loaded.motors)
    assert build_codec(loaded.motors).command_ids[0] == 0x800B


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        (("bus", "backend"), "carrier pigeon", "bus.backend = 'carrier pigeon'"),
        (("bus", "reply_timeout"), 0.0, "bus.reply_timeout = 0"),
        (("motors", "watchdog"), 0.0, "motors.watchdog = 0.0"),
        (("motors", "direction"), [[1, 1, 0]] * 4, "motors.direction"),
        (("motors", "id"), [[1, 2, 127]] * 4, "motors.id"),
        (("imu", "baud"), 9600, "imu.baud = 9600"),
        (("imu", "colour"), "red", "imu"),
    ],
)
def test_what_cannot_be_is_refused_by_name(key, value, message):
    changed = table("stoch3")
    changed[key[0]][key[1]] = value
    with pytest.raises(ConfigError, match=message):
        config.parse(changed, "stoch3.toml")


def test_a_simulated_robot_needs_no_wires():
    bare = {name: part for name, part in table("stoch3").items() if name not in ("bus", "motors", "imu")}
    loaded = config.parse(bare, "bare.toml")
    assert (loaded.bus, loaded.motors, loaded.imu) == (None, None, None)
    assert msgspec.to_builtins(loaded)["bus"] is None
