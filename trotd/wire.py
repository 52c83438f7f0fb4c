"""Bodies on wires: the real robot, and the wire twin that stands in for it in a process of its own.

The twin's folder holds what it shares with its daemon: the link to its IMU, the UDP port of its buses, and the
calibration of its body.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
from pathlib import Path

import msgspec

from drivers import calibration
from drivers.errors import DriverError
from drivers.hardware import HardwareRobot, build_bus
from drivers.motors import Motors
from drivers.robot import JointCommand, Measurement, Robot
from drivers.wiring import BusConfig, ImuConfig, MotorsConfig
from drivers.xsens import Xsens
from runtime.config import Config
from runtime.messages.mode import ArmingCheck

TWIN_REPLY_TIME = 0.04
"""How long a twin's replies are waited for, s: its process shares the computer with everybody, and its time with us.
Well below the servos' watchdogs, as on a robot: a lost reply must cost a tick, not the walk."""
TWIN_PATIENCE = 0.8
"""How long a twin's time stands still for a daemon that this computer does not let run, s."""
IMU_PATIENCE = 0.1
"""How long a twin's daemon waits for the IMU's bytes of the tick before, s: a terminal's go through a worker of the
kernel, which a busy computer keeps waiting."""
_POLL = 2e-4
MEETING, IMU_LINK, KNOWN = "wire.json", "imu", "calibration.json"
_GROUPS = "239.74.163.{}"


class Wires(msgspec.Struct, frozen=True):
    """The three sections that a robot on wires has."""

    bus: BusConfig
    motors: MotorsConfig
    imu: ImuConfig


def calibration_file(kind: str, config: Config, folder: Path) -> Path:
    """Where the calibration of the real robot, or of its twin, is kept."""
    name = config.robot.name
    return twin_folder(folder, name) / KNOWN if kind == "twin" else folder / "calibration" / f"{name}.json"


def twin_folder(folder: Path, robot: str) -> Path:
    """Where the twin of ``robot`` and its daemon meet."""
    return folder / "twin" / robot


def wires_of(kind: str, config: Config, folder: Path) -> Wires:
    """The wires of the real robot, or of its twin, before any calibration.

    Raises:
        DriverError: the robot has none, or its twin does not run.
    """
    wires = own_wires(config)
    if kind == "hardware":
        return wires
    meeting = twin_folder(folder, config.robot.name)
    try:
        port = int(json.loads((meeting / MEETING).read_bytes())["port"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DriverError(f"no twin of {config.robot.name!r} in {meeting}: start it with trotd twin") from error
    return twin_wires(wires, meeting, port)


def own_wires(config: Config) -> Wires:
    """The wires that the robot's TOML names.

    Raises:
        DriverError: it names none.
    """
    if config.bus is None or config.motors is None or config.imu is None:
        raise DriverError(f"robot {config.robot.name!r} has no [bus], [motors] and [imu]: it is only simulated")
    return Wires(config.bus, config.motors, config.imu)


def twin_wires(wires: Wires, meeting: Path, port: int) -> Wires:
    """The twin's: one multicast group a bus, from UDP ``port`` up, the IMU at the end of a pseudo-terminal."""
    channels = tuple(_GROUPS.format(bus + 2) for bus in range(len(wires.bus.channels)))
    bus = BusConfig(backend="udp_multicast", channels=channels, port=port, reply_timeout=TWIN_REPLY_TIME)
    return Wires(bus, wires.motors, msgspec.structs.replace(wires.imu, port=str(meeting / IMU_LINK)))


def wired_body(kind: str, config: Config, folder: Path, observe: bool) -> Robot:
    """The drivers on the wires, with the calibration in them.

    Raises:
        DriverError: no wires, or no calibration that is valid for this robot now; observing does without one.
    """
    wires = wires_of(kind, config, folder)
    path = calibration_file(kind, config, folder)
    motors, imu = wires.motors, wires.imu
    if path.exists() or not observe:
        motors, imu = calibration.apply(calibration.load(path, config.robot, motors), motors, imu)
    receiver = Xsens(imu)
    drivers = Motors(motors, build_bus(wires.bus, motors), wires.bus.reply_timeout)
    robot = HardwareRobot(config.robot, drivers, receiver, observe=observe)
    if kind == "twin":
        return LockstepRobot(robot, receiver, max(1, int(imu.rate_hz / config.control.rate_hz)))
    return robot


class LockstepRobot:
    """The drivers on a twin's wires: no exchange before the IMU's word of the tick before is in.

    A real IMU's bytes are never late, and the real robot does not wait for them. A twin's may be by tens of ms, while
    its servos answer at once: readings of different times, which no estimator of a robot meets.
    """

    def __init__(self, robot: HardwareRobot, imu: Xsens, samples: int) -> None:
        """``samples`` of the IMU belong to a tick."""
        self._robot, self._imu, self._samples = robot, imu, samples
        self._seen = 0
        self._silent = True

    async def connect(self) -> None:
        """See ``Robot.connect``."""
        await self._robot.connect()

    async def exchange(self, command: JointCommand) -> Measurement:
        """See ``Robot.exchange``."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(0.0 if self._silent else IMU_PATIENCE):
                while self._packets() < self._seen + self._samples:  # noqa: ASYNC110
                    await asyncio.sleep(_POLL)
        packets = self._packets()
        self._silent, self._seen = packets == self._seen, packets
        return await self._robot.exchange(command)

    async def close(self) -> None:
        """See ``Robot.close``."""
        await self._robot.close()

    @property
    def troubles(self) -> dict[str, int]:
        """See ``Robot.troubles``."""
        return self._robot.troubles

    def _packets(self) -> int:
        counters = self._imu.counters
        return counters.samples + counters.lost + counters.corrupt + self._imu.link.corrupt


def with_baseline(kind: str, config: Config, folder: Path) -> Config:
    """``config`` with the foot forces that this body's legs feign, where its calibration tells.

    Raises:
        DriverError: no wires, or a calibration that is not valid for this robot now.
    """
    path = calibration_file(kind, config, folder)
    if not path.exists():
        return config
    found = calibration.load(path, config.robot, own_wires(config).motors)
    contact = msgspec.structs.replace(config.control.contact, baseline=found.contact_baseline)
    return msgspec.structs.replace(config, control=msgspec.structs.replace(config.control, contact=contact))


def check_calibration(kind: str, config: Config, folder: Path) -> ArmingCheck:
    """A line of the arming list: whether the calibration on the disk is valid for this robot now."""
    try:
        wires = wires_of(kind, config, folder)
        path = calibration_file(kind, config, folder)
        found = calibration.load(path, config.robot, wires.motors)
    except DriverError as error:
        return ArmingCheck("calibration", False, str(error))
    return ArmingCheck("calibration", True, f"of {found.date:%Y-%m-%d %H:%M}")


def favour(process: int) -> None:
    """Let the main thread of ``process`` (0: this one) run before ordinary ones, where the kernel grants it.

    For the twin alone: a daemon favoured as well starves the kernel's workers that carry the terminal's bytes.
    """
    with contextlib.suppress(OSError):
        os.sched_setscheduler(process, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
