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
from drivers.wiring import BusConfig, ImuConfig, MotorsConfig
from runtime.control.parameters import ControlConfig
from runtime.motor_range import uncarried
from runtime.parameters import (
    ArmingConfig,
    AuditionConfig,
    CommandConfig,
    DampConfig,
    DegradeConfig,
    LimitsConfig,
    LinkConfig,
    PostureConfig,
    RealtimeConfig,
    RecorderConfig,
    TourConfig,
    TuningConfig,
)

ROBOTS = Path(__file__).parent / "robots"


class ConfigError(ValueError):
    """A configuration that cannot be used: the message names the file, the key, the value and the bound."""


class Config(Record, frozen=True, kw_only=True):
    """One robot's TOML, whole."""

    robot: RobotDescription
    control: ControlConfig
    limits: LimitsConfig = LimitsConfig()
    arming: ArmingConfig = ArmingConfig()
    degrade: DegradeConfig = DegradeConfig()
    posture: PostureConfig = PostureConfig()
    command: CommandConfig = CommandConfig()
    damp: DampConfig = DampConfig()
    link: LinkConfig = LinkConfig()
    audition: AuditionConfig = AuditionConfig()
    tuning: TuningConfig = TuningConfig()
    recorder: RecorderConfig = RecorderConfig()
    realtime: RealtimeConfig = RealtimeConfig()
    tour: TourConfig = TourConfig()
    bus: BusConfig | None = None
    """The wires to the motors; a robot that is only simulated has none, and neither of the next two."""
    motors: MotorsConfig | None = None
    imu: ImuConfig | None = None


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
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: not TOML: {error}") from error
    return parse(table, str(path))


def parse(table: dict[str, Any], place: str) -> Config:
    """Check a TOML table; ``place`` is how messages name where it came from."""
    for key, value in _numbers(table, ""):
        if not math.isfinite(value):
            raise ConfigError(f"{place}: {_one_line(key)} = {value}: must be finite")
    try:
        config = msgspec.convert(table, Config)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{place}: {_one_line(_explain(str(error), table))}") from error
    for problem in _contradictions(config):
        raise ConfigError(f"{place}: {_one_line(problem)}")
    return config


def override(config: Config, place: str, changes: dict[str, Any]) -> Config:
    """``config`` with dotted keys replaced, such as ``{"control.rate_hz": 500.0}``, checked like a file.

    Raises:
        ConfigError: as ``parse``, naming ``place``.
    """
    table = msgspec.to_builtins(config)
    for key, value in changes.items():
        *path, last = key.split(".")
        target = table
        for part in path:
            target = target[part]
        target[last] = value
    return parse(table, place)


def _contradictions(config: Config) -> Iterator[str]:
    """Pairs of numbers that are each in their bounds but cannot both be true."""
    yield from _impossible_body(config)
    yield from _crossed_bounds(config)
    yield from _unfit_links(config)


def _impossible_body(config: Config) -> Iterator[str]:
    joints, grf = config.robot.joints, config.control.grf
    for leg, (lower, upper) in enumerate(zip(joints.lower, joints.upper, strict=True)):
        for joint in range(3):
            if lower[joint] >= upper[joint]:
                place = f"[{leg}][{joint}]"
                yield f"robot.joints.lower{place} = {lower[joint]}: must be below upper{place} = {upper[joint]}"
    standing = config.control.gait.walking_height - config.robot.foot_radius + config.robot.hip_position[2]
    if not 0 < standing < config.robot.reach:
        height = config.control.gait.walking_height
        yield f"control.gait.walking_height = {height}: the leg reaches {config.robot.reach:.3f} m"
    if grf.min_force >= grf.max_force:
        yield f"control.grf.min_force = {grf.min_force}: must be below max_force = {grf.max_force}"


def _crossed_bounds(config: Config) -> Iterator[str]:
    limits = config.limits
    for name in config.tuning.__struct_fields__:
        bounds = getattr(config.tuning, name)
        if isinstance(bounds, tuple) and not bounds[0] < bounds[1]:
            yield f"tuning.{name} = {list(bounds)}: the lower bound must be below the upper one"
    if limits.arming_tilt > limits.max_tilt:
        yield f"limits.arming_tilt = {limits.arming_tilt}: must not pass max_tilt = {limits.max_tilt}"
    if limits.arming_temperature > limits.max_temperature:
        yield (
            f"limits.arming_temperature = {limits.arming_temperature}:"
            f" must not pass max_temperature = {limits.max_temperature}"
        )
    if config.degrade.thermal_start >= limits.max_temperature:
        yield (
            f"degrade.thermal_start = {config.degrade.thermal_start}:"
            f" must be below limits.max_temperature = {limits.max_temperature}"
        )
    if 0.0 < config.degrade.voltage_start <= limits.min_voltage:
        yield f"degrade.voltage_start = {config.degrade.voltage_start}: must pass limits.min_voltage"
    if limits.stall_stand > limits.stall_damp:
        yield f"limits.stall_stand = {limits.stall_stand}: must not pass stall_damp = {limits.stall_damp}"


def _unfit_links(config: Config) -> Iterator[str]:
    """Of the wires to the motors and of the network."""
    if config.bus is not None and config.motors is not None:
        held_up = config.bus.reply_timeout + 2.0 / config.control.rate_hz
        if held_up >= config.motors.watchdog:
            yield (
                f"bus.reply_timeout = {config.bus.reply_timeout}: with two ticks beside it as long as"
                f" motors.watchdog = {config.motors.watchdog}: one lost reply would time every motor out"
            )
    if config.motors is not None:
        yield from uncarried(config.motors, config.robot, config.control.gains, config.damp, config.tuning)
    if not config.link.allow_unprotected:
        for endpoint in config.link.listen:
            if not _loopback(endpoint) and not (config.link.certificates and endpoint.startswith("tls/")):
                yield (
                    f"link.listen = {endpoint!r}: off the loopback interface needs a tls/ endpoint and"
                    " link.certificates (trotd keys makes them), or link.allow_unprotected = true"
                )


def _loopback(endpoint: str) -> bool:
    host = endpoint.partition("/")[2].rpartition(":")[0]
    return host == "localhost" or host.startswith("127.") or host == "[::1]"


def _numbers(value: Any, key: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, dict):
        for name, item in value.items():
            yield from _numbers(item, f"{key}.{name}" if key else name)
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from _numbers(item, f"{key}[{index}]")
    elif isinstance(value, float):
        yield key, value


def _one_line(words: str) -> str:
    """The same with what would break the line escaped: a key may be any text."""
    return "".join(sign if sign.isprintable() else repr(sign)[1:-1] for sign in words)


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
