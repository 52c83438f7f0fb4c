"""The calibration file: what commissioning found out about one robot, and only about that one.

JSON with a version, the robot's name, the date and a hash over all of it. A file that was edited, is of another robot,
of another wiring, of an older or a newer format, or from the future is refused: whoever walks on a wrong zero falls.
"""

from __future__ import annotations

import hashlib
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from drivers.description import UNDECODABLE, Name, PerLeg, Record, RobotDescription
from drivers.durable import write_whole
from drivers.errors import DriverError
from drivers.wiring import ImuConfig, MotorsConfig, PerLegBuses, PerLegDirections, PerLegIds, Quaternion

VERSION = 1
_CLOCK_TOLERANCE = timedelta(days=1)


class CalibrationError(DriverError):
    """A calibration that cannot be used: the message names the file, what is wrong, and what to do."""


class Calibration(Record, frozen=True, kw_only=True):
    """What was found. Rows FL FR BL BR, columns abduction hip knee."""

    version: int
    robot: Name
    body: str
    """Fingerprint of the description and the motors' make that it was found with."""
    date: Annotated[datetime, Meta(tz=True)]
    id: PerLegIds
    bus: PerLegBuses
    direction: PerLegDirections
    offset: PerLeg
    """rad: joint = direction · motor / gear − offset."""
    mount: Quaternion
    """Sensor → body."""
    contact_baseline: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Vertical foot force that each leg's torque feigns while the robot stands still, N."""
    hash: Annotated[str, Meta(pattern=r"^([0-9a-f]{64})?$")] = ""


def fingerprint(description: RobotDescription, motors: MotorsConfig) -> str:
    """What a calibration depends on: geometry and ranges of the legs, protocol and gear of the motors."""
    parts = (
        description.abduction_length,
        description.thigh_length,
        description.shank_length,
        description.joints.lower,
        description.joints.upper,
        motors.protocol,
        motors.model,
        motors.gear,
    )
    return hashlib.sha256(msgspec.json.encode(parts)).hexdigest()[:16]


def seal(calibration: Calibration) -> Calibration:
    """The same with its hash."""
    blank = msgspec.structs.replace(calibration, hash="")
    return msgspec.structs.replace(blank, hash=hashlib.sha256(msgspec.json.encode(blank)).hexdigest())


def save(calibration: Calibration, path: Path) -> None:
    """Write it, sealed; the old file stays whole until the new one is."""
    write_whole(path, msgspec.json.format(msgspec.json.encode(seal(calibration)), indent=1) + b"\n")


def load(path: Path, description: RobotDescription, motors: MotorsConfig, now: datetime | None = None) -> Calibration:
    """Read and judge a calibration.

    Raises:
        CalibrationError: missing, not readable, not ours, stale, newer or changed by hand.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CalibrationError(f"calibration {path}: {error.strerror}; run trotd commission") from error
    _check_version(data, path)
    try:
        calibration = msgspec.json.decode(data, type=Calibration)
    except UNDECODABLE as error:
        raise CalibrationError(f"calibration {path}: {error}; run trotd commission") from error
    for wrong, words in (
        (calibration.robot != description.name, f"is of robot {calibration.robot!r}, this is {description.name!r}"),
        (calibration != seal(calibration), "was changed since it was made: its hash does not fit"),
        (calibration.body != fingerprint(description, motors), "is stale: legs, ranges or motors changed since"),
        (calibration.date > (now or datetime.now(UTC)) + _CLOCK_TOLERANCE, f"is from the future ({calibration.date})"),
    ):
        if wrong:
            raise CalibrationError(f"calibration {path} {words}; run trotd commission")
    return calibration


def apply(calibration: Calibration, motors: MotorsConfig, imu: ImuConfig) -> tuple[MotorsConfig, ImuConfig]:
    """The wiring with what was found in it."""
    wired = msgspec.structs.replace(
        motors,
        id=calibration.id,
        bus=calibration.bus,
        direction=calibration.direction,
        offset=calibration.offset,
    )
    return wired, msgspec.structs.replace(imu, mount=calibration.mount)


def _check_version(data: bytes, path: Path) -> None:
    try:
        version = msgspec.json.decode(data).get("version")
    except (*UNDECODABLE, AttributeError) as error:
        raise CalibrationError(f"calibration {path}: not JSON of ours; run trotd commission") from error
    if version != VERSION:
        age = "newer" if isinstance(version, int) and version > VERSION else "stale"
        raise CalibrationError(
            f"calibration {path} is {age}: format {version!r}, this program reads {VERSION}; "
            + ("update trotd" if age == "newer" else "run trotd commission")
        )
