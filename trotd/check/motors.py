"""The motors and their buses: who answers, how it is, where its joint stands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from drivers.bus import Bus
from drivers.commissioning import MotorPlace, joint_name
from drivers.errors import DriverError
from drivers.hardware import build_bus
from drivers.moteus_registers import Mode
from drivers.motors import Motors
from drivers.robot import Array
from drivers.survey import FoundMotor, build_question, survey
from drivers.wiring import BusConfig, MotorsConfig
from runtime.config import Config
from runtime.parameters import LimitsConfig
from trotd.check.rows import Row
from trotd.wire import Wires

LEAST_QUEUE = 100
"""Frames that a CAN interface's transmit queue should hold."""
_LOOKS = 5


async def check_motors(config: Config, wires: Wires) -> list[Row]:
    """Every motor, every bus, every joint; energises nothing."""
    motors = wires.motors
    wanted = {
        (number, motor): joint_name(leg, joint)
        for leg, (ids, buses) in enumerate(zip(motors.id, motors.bus, strict=True))
        for joint, (motor, number) in enumerate(zip(ids, buses, strict=True))
    }
    numbers = range(1, len(wires.bus.channels) + 1)
    try:
        bus = build_bus(wires.bus, motors)
        question = build_question(motors)
        found = await survey(bus, numbers, question, sorted({motor for _, motor in wanted}))
        if not set(wanted) <= {(motor.bus, motor.id) for motor in found}:
            found = await survey(bus, numbers, question)  # whoever is missing may have any id
    except (DriverError, ValueError) as error:
        return [Row("buses", "fail", line, "nothing was asked") for line in str(error).splitlines()]
    rows = judge_motors(wanted, found, config.limits)
    rows += [judge_bus(bus), *check_interfaces(wires.bus)]
    if any(row.verdict == "fail" for row in rows):
        return [*rows, Row("joints", "warn", "not looked at", "once all motors answer")]
    return rows + await _check_joints(config, wires)


def judge_motors(wanted: dict[MotorPlace, str], found: Sequence[FoundMotor], limits: LimitsConfig) -> list[Row]:
    """One row a motor, found or not, one for each that nobody asked for, and one for their firmware.

    Args:
        wanted: (bus, id) → joint.
        found: what a survey brought.
        limits: supply and temperature that arming asks for.
    """
    rows, by_place = [], {(motor.bus, motor.id): motor for motor in found}
    for place, name in wanted.items():
        what = f"{name} (id {place[1]}, bus {place[0]})"
        motor = by_place.pop(place, None)
        if motor is None:
            rows.append(Row(what, "fail", "no answer", _where_else(place, set(by_place) - set(wanted))))
        else:
            rows.append(_judge_motor(what, motor, limits))
    rows += [
        Row(f"id {motor.id}, bus {motor.bus}", "warn", f"{motor.state}; no joint of ours", "wrong plug, or spare?")
        for motor in by_place.values()
    ]
    firmware = sorted({motor.firmware for motor in found if motor.firmware})
    if len(firmware) > 1:
        rows.append(Row("firmware", "warn", f"the motors differ: {', '.join(firmware)}", "bring all to the newest"))
    return rows


def _where_else(place: MotorPlace, strangers: set[MotorPlace]) -> str:
    """Where a motor that does not answer at ``place`` may be instead."""
    others = sorted(bus for bus, motor in strangers if motor == place[1])
    if others:
        return f"it answers on bus {', '.join(map(str, others))}: plug or table?"
    neighbours = sorted(motor for bus, motor in strangers if bus == place[0])
    if neighbours:
        return f"supply, cable, id? Bus {place[0]} has id {', '.join(map(str, neighbours))} that nobody asked for"
    return "supply, cable, id?"


def _judge_motor(what: str, motor: FoundMotor, limits: LimitsConfig) -> Row:
    voltage = "voltage not told" if math.isnan(motor.voltage) else f"{motor.voltage:.1f} V"
    celsius = "temperature not told" if math.isnan(motor.temperature) else f"{motor.temperature:.0f} °C"
    firmware = f"firmware {motor.firmware}" if motor.firmware else "firmware not told"
    text = f"{motor.state}, {voltage}, {celsius}, {firmware}"
    if motor.replies > 1:
        return Row(what, "fail", f"{motor.replies} answers to one question", "two motors share this id")
    if motor.mode == Mode.FAULT:
        return Row(what, "fail", text, "mend the cause, then switch it off and on")
    if motor.voltage < limits.arming_voltage:
        return Row(what, "fail", text, f"charge the battery: arming asks for {limits.arming_voltage:g} V")
    if motor.temperature > limits.arming_temperature:
        return Row(what, "fail", text, f"let it cool: arming asks for at most {limits.arming_temperature:g} °C")
    if motor.mode != Mode.STOPPED:
        return Row(what, "warn", text, "somebody else drives it, or did; a daemon's start stops it")
    return Row(what, "ok", text)


def judge_bus(bus: Bus) -> Row:
    """What the wires did while the motors were asked."""
    counters = bus.counters
    trouble = counters.error_frames + counters.bus_off + counters.send_failures
    text = f"{counters.error_frames} error frames, {counters.bus_off} bus-off, {counters.send_failures} not sent"
    return Row("buses", "warn" if trouble else "ok", text, "look at plugs and termination" if trouble else "")


def check_interfaces(bus: BusConfig, root: Path = Path("/")) -> list[Row]:
    """What the kernel counted on each SocketCAN interface since it is up; ``root`` is where /sys is."""
    if bus.backend != "socketcan":
        return []
    rows = []
    for name in bus.channels:
        folder = root / "sys/class/net" / name
        errors = {kind: _number(folder / "statistics" / kind) for kind in ("rx_errors", "tx_errors", "rx_dropped")}
        queue = _number(folder / "tx_queue_len")
        text = ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in errors.items())
        if any(errors.values()):
            rows.append(Row(name, "warn", text, "look at plugs, termination and bit timing"))
        elif queue < LEAST_QUEUE:
            advice = f"ip link set {name} txqueuelen {LEAST_QUEUE} (deploy/networkd does it)"
            rows.append(Row(name, "warn", f"transmit queue of {queue} frames", advice))
        else:
            rows.append(Row(name, "ok", text))
    return rows


def _number(path: Path) -> int:
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return 0


async def _check_joints(config: Config, wires: Wires) -> list[Row]:
    position = await _read_joints(wires.motors, wires.bus)
    return judge_joints(config, position)


async def _read_joints(config: MotorsConfig, bus: BusConfig) -> Array:
    motors = Motors(config, build_bus(bus, config), bus.reply_timeout)
    await motors.open()
    try:
        for _ in range(_LOOKS):
            await motors.query()
    finally:
        await motors.close()
    return motors.joint_state().position


def judge_joints(config: Config, position: Array) -> list[Row]:
    """A row for each joint, of angles (4, 3), rad, outside its range; one where none is."""
    lower, upper = np.array(config.robot.joints.lower), np.array(config.robot.joints.upper)
    margin = config.limits.joint_margin
    inside = (position >= lower - margin) & (position <= upper + margin)
    return [
        Row(
            joint_name(leg, joint),
            "fail",
            f"at {position[leg, joint]:.2f} rad, range {lower[leg, joint]:g} to {upper[leg, joint]:g}",
            "move it inside; if it is inside, its zero is wrong: power up folded, or trotd commission",
        )
        for leg, joint in np.argwhere(~inside)
    ] or [Row("joints", "ok", "all inside their ranges")]
