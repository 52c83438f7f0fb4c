"""``trotd monitor`` and ``trotd health``: the last moments in numbers, and whether they are in order."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from enum import IntEnum

import msgspec
import numpy as np
from rich.table import Table

from drivers.robot import JOINTS, LEGS, Array
from runtime.config import Config
from runtime.control.records import Clamp, Records, SolverStatus
from runtime.messages.event import Event
from runtime.messages.mode import Mode
from runtime.messages.status import Status
from station.session import Station
from station.ticks import TickStream

VELOCITY_UNITS = ("m/s", "m/s", "rad/s")
WRENCH_NAMES = ("force x", "force y", "force z", "moment x", "moment y", "moment z")
CLAMP_WORDS = {
    Clamp.SHIFT: "foot shift at its bound",
    Clamp.WRENCH: "wanted force or moment at its bound",
    Clamp.REACH: "foot target out of reach",
    Clamp.FRICTION: "force at the friction pyramid's edge",
    Clamp.JOINT_LIMIT: "joint target at its range's end",
    Clamp.JOINT_SPEED: "joint target too fast",
    Clamp.TORQUE: "motor torque at its peak",
    Clamp.COMMAND: "velocity command beyond the bounds",
    Clamp.EXPIRED: "velocity command too old",
    Clamp.OBSERVATION: "velocity error beyond the observation's bound",
    Clamp.THERMAL: "torque bound of a warm motor",
    Clamp.CURRENT: "torque bound near the continuous rating",
    Clamp.SOFT_START: "torque bound of the soft start",
    Clamp.FALLBACK: "no solver's forces: least squares",
    Clamp.SPEED: "speed bound from heat or supply",
    Clamp.DEADMAN: "operator gone: standing",
    Clamp.BLEND: "hand-over between two commands",
    Clamp.COASTED: "a motor's reading older than a tick",
    Clamp.EXTRAPOLATED: "IMU sample carried on by its rate",
    Clamp.STOPPING: "stopping: at rest instead of the velocity asked",
    Clamp.CONTACT: "a foot's feel contradicts its leg: the gait's schedule",
}
"""Every bit of ``clamps`` as people would say it."""


class Pair(msgspec.Struct, frozen=True):
    """Asked for, and got, on the mean of the time."""

    name: str
    asked: float
    applied: float


class Summary(msgspec.Struct, frozen=True):
    """What a few ticks were like: one line of ``trotd monitor --json``."""

    stamp: float
    """Of the last tick, s, the robot's monotonic clock."""
    ticks: int
    lost: int
    """Never arrived here, since the start."""
    mode: str
    velocity: tuple[Pair, ...]
    """Commanded against measured."""
    wrench: tuple[Pair, ...]
    """The policy's wish against what was passed on, N and N·m."""
    torque_share: float
    """Largest joint torque as a share of its peak."""
    torque_joint: str
    clamps: dict[str, float]
    """Why less than asked was applied: reason → share of the ticks."""
    solver: dict[str, float]
    """Share of the ticks by solver status."""
    period_p50: float
    """s, as the other times here."""
    lateness_p99: float
    compute_p99: float
    overruns: int
    """Deadlines missed in these ticks."""
    policy: int
    """Number of the active policy since the start."""
    policy_share: float
    """Of it in what is asked for; below one while it is blended in."""
    events: tuple[Event, ...]
    """What happened since the last summary."""


def summarise(ticks: Records, peak: Array, lost: int = 0, events: Iterable[Event] = ()) -> Summary:
    """Ticks (n,), n ≥ 1, of a robot whose joints bear ``peak`` (3,) N·m, and what happened meanwhile."""
    last = ticks[-1]
    share = np.abs(ticks["joint_torque"]) / peak
    leg, joint = np.unravel_index(int(share.max(axis=0).argmax()), (4, 3))
    asked, measured = ticks["asked_velocity"].mean(axis=0), ticks["twist"][:, (0, 1, 5)].mean(axis=0)
    wish, passed = ticks["asked"][:, 12:].mean(axis=0), ticks["action"][:, 12:].mean(axis=0)
    acts = {words: float(((ticks["clamps"] & int(clamp)) != 0).mean()) for clamp, words in CLAMP_WORDS.items()}
    statuses = {status.name: float((ticks["solver_status"] == status).mean()) for status in SolverStatus}
    return Summary(
        stamp=float(last["stamp"]),
        ticks=len(ticks),
        lost=lost,
        mode=Mode(int(last["mode"])).name,
        velocity=_pairs(("forward", "left", "turn"), asked, measured),
        wrench=_pairs(WRENCH_NAMES, wish, passed),
        torque_share=float(share.max()),
        torque_joint=f"{LEGS[leg]} {JOINTS[joint]}",
        clamps={words: value for words, value in acts.items() if value},
        solver={name: value for name, value in statuses.items() if value},
        period_p50=float(np.median(ticks["period"])),
        lateness_p99=float(np.percentile(ticks["lateness"], 99)),
        compute_p99=float(np.percentile(ticks["compute"], 99)),
        overruns=int(last["overruns"]) - int(ticks["overruns"][0]),
        policy=int(last["policy"]),
        policy_share=float(last["policy_share"]),
        events=tuple(events),
    )


def _pairs(names: tuple[str, ...], asked: Array, applied: Array) -> tuple[Pair, ...]:
    return tuple(Pair(*row) for row in zip(names, asked.tolist(), applied.tolist(), strict=True))


def watch(station: Station, peak: Array, hz: float) -> Iterator[Summary | None]:
    """A summary ``hz`` times a second; None where no tick came."""
    with TickStream(station) as stream:
        while True:
            time.sleep(1.0 / hz)
            ticks, events = stream.take(), stream.take_events()
            yield summarise(ticks, peak, stream.lost, events) if len(ticks) else None


def draw_table(summary: Summary, lately: Iterable[Event] = ()) -> Table:
    """A summary for the terminal, and what happened ``lately`` below it."""
    table = Table(title=f"{summary.mode}   {summary.ticks} ticks, {summary.lost} lost", show_edge=False)
    for column in ("", "asked", "applied or measured"):
        table.add_column(column, justify="right" if column else "left")
    units = (*VELOCITY_UNITS, "N", "N", "N", "N·m", "N·m", "N·m")
    for pair, unit in zip((*summary.velocity, *summary.wrench), units, strict=True):
        table.add_row(f"{pair.name}, {unit}", f"{pair.asked:+.3f}", f"{pair.applied:+.3f}")
    table.add_section()
    table.add_row("highest torque", summary.torque_joint, f"{summary.torque_share:.0%} of peak")
    for words, share in summary.clamps.items():
        table.add_row(words, "", f"{share:.0%} of the ticks", style="yellow")
    for name, share in summary.solver.items():
        table.add_row(f"solver {name.lower()}", "", f"{share:.0%} of the ticks")
    table.add_section()
    table.add_row(
        "period p50 / lateness p99, ms", f"{summary.period_p50 * 1e3:.3f}", f"{summary.lateness_p99 * 1e3:.3f}"
    )
    table.add_row("compute p99, ms / overruns", f"{summary.compute_p99 * 1e3:.3f}", str(summary.overruns))
    table.add_row("policy, its share", str(summary.policy), f"{summary.policy_share:.0%}")
    table.add_section()
    for event in lately:
        table.add_row(event.kind, f"{event.stamp - summary.stamp:+.1f} s", event.text)
    return table


class Level(IntEnum):
    """How a check came out: the exit code of ``trotd health`` is the worst one."""

    OK = 0
    WARNING = 1
    BAD = 2


class Check(msgspec.Struct, frozen=True):
    """One line of ``trotd health``."""

    name: str
    level: Level
    words: str


def examine(ticks: Records, status: Status, config: Config, lost: int) -> list[Check]:
    """Every check on ticks (n,), n ≥ 2, and the status of a robot of this configuration."""
    limits, period = config.limits, 1.0 / status.rate_hz
    seconds = float(ticks["stamp"][-1] - ticks["stamp"][0])
    rate = (len(ticks) - 1 + lost) / seconds if seconds > 0 else 0.0
    missed = int(ticks["overruns"][-1]) - int(ticks["overruns"][0])
    median, compute = np.percentile(ticks["compute"], (50, 99)).tolist()
    age = float(ticks["joint_age"].max())
    imu_age = float((ticks["measured_stamp"] - ticks["imu_stamp"]).max())
    hottest = float(ticks["joint_temperature"][-1].max())
    voltage = float(ticks["voltage"][-1])
    fell_back = float((ticks["solver_status"] > SolverStatus.SOLVED).mean())
    share, wrong = rate / status.rate_hz, sum(status.wires.values()) / max(1, status.ticks)
    return [
        Check("mode", Level.BAD if status.fault else Level.OK, f"{status.mode}, {status.fault or status.reason}"),
        Check("rate", _level(1 - share, 0.01, 0.05), f"{rate:.1f} of {status.rate_hz:g} Hz"),
        Check("deadlines", _level(missed / len(ticks), 0.001, 0.05), f"{missed} missed in {len(ticks)} ticks"),
        Check(
            "compute",
            max(_level(compute, 0.5 * period, math.inf), _level(median, 0.8 * period, 0.8 * period)),
            f"p50 {median * 1e3:.2f}, p99 {compute * 1e3:.2f} of {period * 1e3:.2f} ms",
        ),
        Check("motors", _level(age, 1.5 * period, limits.max_age), f"oldest reply {age * 1e3:.1f} ms"),
        Check("imu", _level(imu_age, 0.5 * limits.max_age, limits.max_age), f"oldest sample {imu_age * 1e3:.1f} ms"),
        Check(
            "temperature",
            _level(hottest, limits.arming_temperature, limits.max_temperature),
            f"hottest motor {hottest:.0f} °C, bound {limits.max_temperature:g}",
        ),
        Check(
            "supply",
            _level(-voltage, -limits.arming_voltage - 1e-9, -limits.min_voltage - 1e-9),
            f"{voltage:.1f} V, bound {limits.min_voltage:g}",
        ),
        Check("solver", _level(fell_back, 0.001, 0.05), f"{fell_back:.1%} of the ticks not by the first solver"),
        Check("wires", _level(wrong, 0.001, math.inf), wires_in_words(status)),
        Check(
            "disk",
            Level.WARNING if status.recordings_refused else Level.OK,
            ", ".join(f"{why} ({count} times)" for why, count in status.recordings_refused.items())
            or "takes what is written",
        ),
        Check("link", _level(lost / len(ticks), 0.01, 0.5), f"{lost} ticks lost on the way here"),
    ]


def wires_in_words(status: Status) -> str:
    """What went wrong on the wires since the daemon's start."""
    return ", ".join(f"{count} {name}" for name, count in status.wires.items()) or "nothing lost, nothing late"


def _level(value: float, warning: float, bad: float) -> Level:
    if not value <= bad:
        return Level.BAD
    return Level.WARNING if value > warning else Level.OK


def gather(station: Station, seconds: float) -> tuple[Records, int]:
    """The ticks of the next ``seconds``, and how many were lost between them."""
    batches = []
    with TickStream(station) as stream:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(0.05)
            batches.append(stream.take())
        return np.concatenate(batches), stream.lost
