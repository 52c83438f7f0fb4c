"""How one robot is wired: the records of ``[bus]``, ``[motors]`` and ``[imu]`` in its TOML."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from drivers.description import PerLeg, Positive, Record

Id = Annotated[int, Meta(ge=1, le=126)]
BusNumber = Annotated[int, Meta(ge=1, le=16)]
Direction = Literal[-1, 1]
PerLegIds = tuple[tuple[Id, Id, Id], tuple[Id, Id, Id], tuple[Id, Id, Id], tuple[Id, Id, Id]]
PerLegBuses = tuple[
    tuple[BusNumber, BusNumber, BusNumber],
    tuple[BusNumber, BusNumber, BusNumber],
    tuple[BusNumber, BusNumber, BusNumber],
    tuple[BusNumber, BusNumber, BusNumber],
]
PerLegDirections = tuple[
    tuple[Direction, Direction, Direction],
    tuple[Direction, Direction, Direction],
    tuple[Direction, Direction, Direction],
    tuple[Direction, Direction, Direction],
]
Gear = Annotated[float, Meta(ge=0.01, le=1e4)]
MotorTorque = Annotated[float, Meta(gt=0, le=1e6)]
Format = Literal["float", "compact"]
Baud = Literal[115200, 230400, 460800, 921600, 2000000, 3500000, 4000000]
Quaternion = tuple[float, float, float, float]


class BusConfig(Record, frozen=True, kw_only=True):
    """``[bus]``: the wires between this computer and the motors."""

    backend: Literal["pi3hat", "socketcan", "udp_multicast", "virtual"]
    channels: Annotated[tuple[str, ...], Meta(min_length=1, max_length=16)]
    """One name a bus: ``JC1`` (pi3hat), ``can0`` (socketcan), an IPv4 group (udp_multicast), any (virtual)."""
    reply_timeout: Annotated[float, Meta(gt=0, le=0.1)] = 0.003
    """How long a tick waits for the replies, s."""
    port: Annotated[int, Meta(ge=1024, le=65535)] = 43113
    """UDP port of the first bus of udp_multicast; the others follow, since a host hears all groups of a port."""
    cpu: Annotated[int, Meta(ge=0, le=63)] = 3
    """The core that the pi3hat's thread occupies."""
    reopen_interval: Positive = 0.5
    """How often a bus that went away is opened anew, s."""


class MotorsConfig(Record, frozen=True, kw_only=True):
    """``[motors]``: which motor moves which joint, and how. Rows FL FR BL BR, columns abduction hip knee."""

    protocol: Literal["moteus", "mit"] = "moteus"
    id: PerLegIds
    bus: PerLegBuses
    """Which of ``[bus] channels``, counted from 1."""
    direction: PerLegDirections
    """+1 where the motor turns as the joint does."""
    offset: PerLeg
    """rad: joint = direction · motor / gear − offset."""
    gear: tuple[Gear, Gear, Gear] = (1.0, 1.0, 1.0)
    """Turns that the motor reports in one turn of the joint, for abduction, hip, knee."""
    max_torque: tuple[MotorTorque, MotorTorque, MotorTorque]
    """Bound sent with every command, N·m at the joint."""
    watchdog: Annotated[float, Meta(ge=0.01, le=1.0)] = 0.1
    """s without a command after which a motor goes limp by itself."""
    coasted_ticks: Annotated[int, Meta(ge=0, le=10)] = 2
    """Replies in a row that a motor may miss, its last reading standing in, before that is a fault."""
    servo_kp: Positive = 200.0
    """moteus: ``servo.pid_position.kp`` that the servos are configured with, N·m per revolution."""
    servo_kd: Positive = 10.0
    """moteus: ``servo.pid_position.kd`` that the servos are configured with, N·m per revolution/s."""
    format: Format = "float"
    """moteus: ``float``, or ``compact`` for smaller frames, which carry gains up to ``servo_kp`` and ``servo_kd``; a
    robot whose numbers they cannot carry is refused."""
    wiggle_torque: Positive = 3.0
    """The most that commissioning's powered wiggle asks of one motor, N·m at the motor."""
    model: str = ""
    """MIT protocol: the motors' model, which tells its ranges."""


class ImuConfig(Record, frozen=True, kw_only=True):
    """``[imu]``: an Xsens MTi."""

    port: str = "/dev/xsens"
    baud: Baud = 921600
    rate_hz: Annotated[int, Meta(ge=10, le=400)] = 400
    """A divisor of 400."""
    mount: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """w x y z that turns the sensor's axes into the body's; the calibration file has the last word."""
    set_options: Annotated[int, Meta(ge=0)] = 0
    """Option flags to set (low-level protocol manual, SetOptionFlags); 0: as stored in the device."""
    clear_options: Annotated[int, Meta(ge=0)] = 0
    reopen_interval: Positive = 0.5
