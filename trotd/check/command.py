"""All that the pre-flight looks at, in order."""

from __future__ import annotations

from pathlib import Path

from drivers import calibration
from drivers.calibration import CalibrationError
from runtime.config import Config
from trotd.check.computer import SOAK_TIME, check_system, check_timing
from trotd.check.imu import check_imu
from trotd.check.motors import check_motors
from trotd.check.rows import Row
from trotd.wire import Wires, calibration_file, wires_of


async def check(kind: str, config: Config, folder: Path, soak: float = SOAK_TIME) -> list[Row]:
    """Look at everything, the timing for ``soak`` s; energise nothing.

    Raises:
        DriverError: the robot has no wires at all.
    """
    wires = wires_of(kind, config, folder)
    row, wires = judge_calibration(kind, config, folder, wires)
    rows = [row, *await check_motors(config, wires), *await check_imu(wires.imu)]
    return [*rows, await check_timing(config.control.rate_hz, soak), *check_system()]


def judge_calibration(kind: str, config: Config, folder: Path, wires: Wires) -> tuple[Row, Wires]:
    """Whether there is one that is valid now, and the wires with it in them."""
    path = calibration_file(kind, config, folder)
    try:
        found = calibration.load(path, config.robot, wires.motors)
    except CalibrationError as error:
        return Row("calibration", "fail", str(error), "trotd commission"), wires
    motors, imu = calibration.apply(found, wires.motors, wires.imu)
    return Row("calibration", "ok", f"{found.date:%Y-%m-%d %H:%M}, {found.hash[:12]}"), Wires(wires.bus, motors, imu)
