"""The IMU: who it is, how often it speaks, where it feels gravity."""

from __future__ import annotations

import asyncio
import os
import time
from pathlib import Path

import numpy as np

from drivers.commissioning import GRAVITY, GRAVITY_TOLERANCE
from drivers.errors import DriverError
from drivers.robot import Array
from drivers.wiring import ImuConfig
from drivers.xsens import ImuCounters, ImuIdentity, Xsens
from trotd.check.rows import Row

LISTENING_TIME = 1.0
"""s."""
LEVEL = 0.35
"""rad between the felt gravity and the body's z."""
LEAST_RATE = 0.95
"""Share of the wanted rate."""


async def check_imu(config: ImuConfig) -> list[Row]:
    """All that it tells in a second."""
    imu = Xsens(config)
    try:
        await imu.connect()
    except DriverError as error:
        return [Row("IMU", "fail", str(error))]
    try:
        before, start = imu.counters.samples, time.monotonic()
        await asyncio.sleep(LISTENING_TIME)
        rate = (imu.counters.samples - before) / (time.monotonic() - start)
        force, counters, identity = imu.latest().linear_acceleration, imu.counters, imu.identity
    finally:
        await imu.close()
    assert identity is not None
    return [
        judge_identity(identity),
        judge_rate(rate, config, counters),
        *judge_health(counters),
        judge_gravity(force),
        check_latency(config.port),
    ]


def judge_identity(identity: ImuIdentity) -> Row:
    """Product code, and whether orientation is its own."""
    own = "" if identity.gives_orientation else ", orientation by our own filter (yaw is relative)"
    found = f"{identity.product_code}, firmware {identity.firmware}{own}"
    if not identity.product_code.upper().startswith("MTI-6"):
        return Row("IMU", "warn", found, "an MTi-600 is expected; see that its axes and ranges are right")
    return Row("IMU", "ok", found)


def judge_rate(rate: float, config: ImuConfig, counters: ImuCounters) -> Row:
    """Samples a second against what was asked."""
    slow = rate < LEAST_RATE * config.rate_hz
    text = f"{rate:.0f} Hz of {config.rate_hz}, {counters.lost} lost"
    return Row("IMU rate", "warn" if slow else "ok", text, "serial latency, a busy computer, imu.baud?" if slow else "")


def judge_health(counters: ImuCounters) -> list[Row]:
    """What its status word complains of; nothing where it does not."""
    rows = []
    if counters.self_test_failed:
        rows.append(Row("IMU self test", "fail", "failed", "switch it off and on; else it is broken"))
    if counters.clipped:
        rows.append(Row("IMU range", "warn", f"{counters.clipped} samples clipped", "hold still; is it loose?"))
    return rows


def judge_gravity(force: Array) -> Row:
    """The felt force (3,) at rest, body frame, m/s²: its size and its direction."""
    size = float(np.linalg.norm(force))
    tilt = float(np.arccos(np.clip(force[2] / size, -1.0, 1.0))) if size > 0.0 else np.pi
    text = f"{size:.2f} m/s², {tilt:.2f} rad from the body's z"
    if not abs(size - GRAVITY) <= GRAVITY_TOLERANCE:
        return Row("gravity", "fail", text, "hold the robot still; else the accelerometer is wrong")
    if tilt > np.pi / 2:
        return Row("gravity", "fail", text, "the IMU is upside down to its calibration: trotd commission --undo mount")
    if tilt > LEVEL:
        return Row("gravity", "warn", text, "level the robot; if it is level: trotd commission --undo mount")
    return Row("gravity", "ok", text)


def check_latency(port: str, root: Path = Path("/")) -> Row:
    """How long the serial adapter holds bytes back; ``root`` is where /sys is."""
    device = Path(os.path.realpath(port)).name
    path = root / f"sys/bus/usb-serial/devices/{device}/latency_timer"
    try:
        value = int(path.read_text())
    except (OSError, ValueError):
        return Row("serial latency", "ok", f"{device}: no latency timer")
    if value <= 1:
        return Row("serial latency", "ok", f"{value} ms")
    return Row("serial latency", "warn", f"{value} ms", f"echo 1 > {path} (deploy/udev does it)")
