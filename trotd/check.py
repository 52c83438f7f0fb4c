"""``trotd check``: the pre-flight. Every row says what was found, and what to do about it where it is not right."""

from __future__ import annotations

import asyncio
import os
import resource
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from rich.console import Console
from rich.table import Table

from drivers import calibration
from drivers.calibration import CalibrationError
from drivers.commissioning import GRAVITY, GRAVITY_TOLERANCE, joint_name
from drivers.errors import DriverError
from drivers.hardware import build_bus
from drivers.moteus_registers import Mode
from drivers.motors import Motors
from drivers.survey import FoundMotor, survey
from drivers.wiring import ImuConfig
from drivers.xsens import Xsens
from runtime.config import Config
from runtime.ticker import Ticker
from trotd.wire import Wires, calibration_file, wires_of

Verdict = Literal["ok", "warn", "fail"]
SOAK_TIME = 2.0
"""s of the timing soak."""
LATENESS_SHARE = 0.25
"""Of a tick: how late the slowest percent may wake."""
IMU_TIME = 1.0
LEVEL = 0.35
"""rad between the felt gravity and the body's z."""
_COLOURS = {"ok": "green", "warn": "yellow", "fail": "red"}


@dataclass(frozen=True, slots=True)
class Row:
    """One thing that was looked at."""

    what: str
    verdict: Verdict
    found: str
    advice: str = ""


async def check(kind: str, config: Config, folder: Path) -> list[Row]:
    """Look at everything; energise nothing.

    Raises:
        DriverError: the robot has no wires at all.
    """
    wires = wires_of(kind, config, folder)
    rows, wires = _calibrated(kind, config, folder, wires)
    rows += await _check_motors(config, wires)
    rows += await _check_imu(wires.imu)
    rows += await check_timing(config.control.rate_hz)
    return rows + check_system()


def show(rows: Sequence[Row], console: Console) -> bool:
    """Print the table; whether nothing failed."""
    table = Table("", "what", "found", "what to do")
    for row in rows:
        colour = _COLOURS[row.verdict]
        table.add_row(f"[{colour}]{row.verdict}[/{colour}]", row.what, row.found, row.advice)
    console.print(table)
    return all(row.verdict != "fail" for row in rows)


def _calibrated(kind: str, config: Config, folder: Path, wires: Wires) -> tuple[list[Row], Wires]:
    path = calibration_file(kind, config, folder)
    try:
        found = calibration.load(path, config.robot, wires.motors)
    except CalibrationError as error:
        return [Row("calibration", "fail", str(error), "trotd commission")], wires
    motors, imu = calibration.apply(found, wires.motors, wires.imu)
    return [Row("calibration", "ok", f"{found.date:%Y-%m-%d %H:%M}, {found.hash[:12]}")], Wires(wires.bus, motors, imu)


async def _check_motors(config: Config, wires: Wires) -> list[Row]:
    motors = wires.motors
    if motors.protocol != "moteus":
        return [Row("motors", "warn", f"protocol {motors.protocol} has no question", "try trotd run --observe")]
    bus = build_bus(wires.bus, motors)
    wanted = {
        (number, motor): joint_name(leg, joint)
        for leg, (ids, buses) in enumerate(zip(motors.id, motors.bus, strict=True))
        for joint, (motor, number) in enumerate(zip(ids, buses, strict=True))
    }
    try:
        numbers = range(1, len(wires.bus.channels) + 1)
        found = await survey(bus, numbers, sorted({motor for _, motor in wanted}))
    except DriverError as error:
        return [Row("buses", "fail", line) for line in str(error).splitlines()]
    rows = judge_motors(wanted, found)
    counters = bus.counters
    trouble = counters.error_frames + counters.bus_off + counters.send_failures
    text = f"{counters.error_frames} error frames, {counters.bus_off} bus-off, {counters.send_failures} not sent"
    rows.append(Row("buses", "warn" if trouble else "ok", text, "look at plugs and termination" if trouble else ""))
    return rows + await _check_joints(config, wires)


def judge_motors(wanted: dict[tuple[int, int], str], found: Sequence[FoundMotor]) -> list[Row]:
    """One row a motor, found or not, and one for each that nobody asked for.

    Args:
        wanted: (bus, id) → joint.
        found: what a survey brought.
    """
    rows, by_place = [], {(motor.bus, motor.id): motor for motor in found}
    for place, name in wanted.items():
        what = f"{name} (id {place[1]}, bus {place[0]})"
        motor = by_place.pop(place, None)
        if motor is None:
            others = [str(number) for number, identifier in by_place if identifier == place[1]]
            advice = f"it answers on bus {', '.join(others)}: plug or table?" if others else "supply, cable, id?"
            rows.append(Row(what, "fail", "no answer", advice))
            continue
        text = f"{motor.state}, {motor.voltage:.1f} V, {motor.temperature:.0f} °C, firmware {motor.firmware}"
        if motor.replies > 1:
            rows.append(Row(what, "fail", f"{motor.replies} answers to one question", "two motors share this id"))
        elif motor.mode == Mode.FAULT:
            rows.append(Row(what, "fail", text, "mend the cause, then switch it off and on"))
        elif motor.mode != Mode.STOPPED:
            rows.append(Row(what, "warn", text, "somebody else drives it, or did; a daemon's start stops it"))
        else:
            rows.append(Row(what, "ok", text))
    rows += [
        Row(f"id {motor.id}, bus {motor.bus}", "warn", f"{motor.state}; no joint of ours", "wrong plug, or spare?")
        for motor in by_place.values()
    ]
    return rows


async def _check_joints(config: Config, wires: Wires) -> list[Row]:
    motors = Motors(wires.motors, build_bus(wires.bus, wires.motors), wires.bus.reply_timeout)
    await motors.open()
    try:
        for _ in range(5):
            await motors.query()
    finally:
        await motors.close()
    lower, upper = np.array(config.robot.joints.lower), np.array(config.robot.joints.upper)
    position, margin = motors.joint_state().position, config.limits.joint_margin
    return [
        Row(
            joint_name(leg, joint),
            "fail",
            f"at {position[leg, joint]:.2f} rad, range {lower[leg, joint]:g} to {upper[leg, joint]:g}",
            "move it inside; if it is inside, its zero is wrong: power up folded, or trotd commission",
        )
        for leg, joint in np.argwhere((position < lower - margin) | (position > upper + margin))
    ] or [Row("joints", "ok", "all inside their ranges")]


async def _check_imu(config: ImuConfig) -> list[Row]:
    imu = Xsens(config)
    try:
        await imu.connect()
    except DriverError as error:
        return [Row("IMU", "fail", str(error))]
    try:
        before, start = imu.counters.samples, time.monotonic()
        await asyncio.sleep(IMU_TIME)
        rate = (imu.counters.samples - before) / (time.monotonic() - start)
        force, counters, identity = imu.latest().linear_acceleration, imu.counters, imu.identity
    finally:
        await imu.close()
    assert identity is not None
    own = "" if identity.gives_orientation else ", orientation by our own filter (yaw is relative)"
    rows = [Row("IMU", "ok", f"{identity.product_code}, firmware {identity.firmware}{own}")]
    slow = rate < 0.95 * config.rate_hz
    rows.append(Row("IMU rate", "warn" if slow else "ok", f"{rate:.0f} Hz of {config.rate_hz}, {counters.lost} lost"))
    if counters.self_test_failed:
        rows.append(Row("IMU self test", "fail", "failed", "switch it off and on; else it is broken"))
    return [*rows, judge_gravity(force), _latency_timer(config.port)]


def judge_gravity(force: np.ndarray) -> Row:
    """The felt force (3,) at rest, body frame, m/s²: its size and its direction."""
    size = float(np.linalg.norm(force))
    tilt = float(np.arccos(np.clip(force[2] / size, -1.0, 1.0))) if size > 0.0 else np.pi
    text = f"{size:.2f} m/s², {tilt:.2f} rad from the body's z"
    if abs(size - GRAVITY) > GRAVITY_TOLERANCE:
        return Row("gravity", "fail", text, "hold the robot still; else the accelerometer is wrong")
    if tilt > np.pi / 2:
        return Row("gravity", "fail", text, "the IMU is upside down to its calibration: trotd commission")
    if tilt > LEVEL:
        return Row("gravity", "warn", text, "level the robot; if it is level: trotd commission")
    return Row("gravity", "ok", text)


def _latency_timer(port: str) -> Row:
    device = Path(os.path.realpath(port)).name
    path = Path(f"/sys/bus/usb-serial/devices/{device}/latency_timer")
    try:
        value = int(path.read_text())
    except (OSError, ValueError):
        return Row("serial latency", "ok", f"{device}: no latency timer")
    if value <= 1:
        return Row("serial latency", "ok", f"{value} ms")
    return Row("serial latency", "warn", f"{value} ms", f"echo 1 > {path} (deploy/udev does it)")


async def check_timing(rate_hz: float, seconds: float = SOAK_TIME) -> list[Row]:
    """How late ticks wake at ``rate_hz`` when nothing else is done in them."""
    lateness = []
    with Ticker(rate_hz) as ticker:
        for _ in range(max(2, round(seconds * rate_hz))):
            await ticker.wait()
            lateness.append(ticker.lateness)
        overruns = ticker.overruns
    p99 = float(np.percentile(lateness, 99))
    text = f"lateness p50 {np.median(lateness) * 1e6:.0f}, p99 {p99 * 1e6:.0f} µs, {overruns} overruns"
    bad = overruns > 0 or p99 > LATENESS_SHARE / rate_hz
    return [
        Row(
            f"timing at {rate_hz:g} Hz",
            "warn" if bad else "ok",
            text,
            "realtime settings, docs/operations.md" if bad else "",
        )
    ]


def check_system(root: Path = Path("/")) -> list[Row]:
    """What the kernel and the environment grant; ``root`` is where /sys is."""
    rows = []
    governors = {
        file.read_text().strip() for file in root.glob("sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor")
    }
    if governors:
        slow = governors != {"performance"}
        rows.append(
            Row("CPU governor", "warn" if slow else "ok", ", ".join(sorted(governors)), "performance" if slow else "")
        )
    isolated = root / "sys/devices/system/cpu/isolated"
    cores = isolated.read_text().strip() if isolated.exists() else ""
    rows.append(Row("isolated cores", "ok" if cores else "warn", cores or "none", "" if cores else "isolcpus= at boot"))
    for name, limit, least in (
        ("real-time priority", resource.RLIMIT_RTPRIO, 1),
        ("locked memory", resource.RLIMIT_MEMLOCK, 1 << 28),
    ):
        soft = resource.getrlimit(limit)[0]
        granted = soft == resource.RLIM_INFINITY or soft >= least or os.geteuid() == 0
        text = "unlimited" if soft == resource.RLIM_INFINITY else str(soft)
        rows.append(Row(name, "ok" if granted else "warn", text, "" if granted else "the systemd unit grants it"))
    threads = {key: os.environ.get(key, "unset") for key in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    one = set(threads.values()) == {"1"}
    rows.append(Row("BLAS threads", "ok" if one else "warn", str(threads), "" if one else "set both to 1"))
    return rows
