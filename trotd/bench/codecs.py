"""What our end of the wires costs: codecs against the makers' own and plain walks, a whole exchange without wires."""

from __future__ import annotations

import asyncio
import gc
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from drivers import xbus
from drivers.bus import Frame, InProcessBus
from drivers.hardware import HardwareRobot
from drivers.motor_codec import as_array, build_codec
from drivers.motors import Motors
from drivers.mtdata2 import Data
from drivers.robot import ImuSample, JointCommand, damp_command
from drivers.xbus import Message, XbusParser
from runtime import config
from trotd.bench.report import Figure, Finding, Missing, shown

SLOWER_PI = 7.0
"""How many times slower a Raspberry Pi 4 is assumed to run the interpreter than this machine; nothing was measured."""
ROBOT = "stoch3"
now = time.perf_counter_ns


def measure(quick: bool) -> Iterator[Finding]:
    """Everything of this section."""
    rounds = 2_000 if quick else 20_000
    loaded = config.load(config.find_robot(ROBOT))
    yield from against_moteus(loaded, rounds // 10)
    yield from against_plain_walk(rounds)
    yield from exchange(loaded, rounds)


def in_turns(rounds: int, words: str, *acts: Callable[[], object]) -> list[float]:
    """Median time of each act, µs; they take turns, so that what disturbs one disturbs all."""
    taken: list[list[int]] = [[] for _ in acts]
    gc.collect()
    gc.disable()
    try:
        for _ in shown(range(rounds), words, rounds):
            for times, act in zip(taken, acts, strict=True):
                first = now()
                act()
                times.append(now() - first)
    finally:
        gc.enable()
    return [float(np.median(times)) / 1e3 for times in taken]


def against_moteus(loaded: config.Config, rounds: int) -> Iterator[Finding]:
    """Twelve commands out and twelve replies in, by our codec and by the maker's package, of the same registers."""
    name = "encode 12 and decode 12 frames"
    try:
        import moteus
    except ImportError as error:
        yield Missing("codecs", f"{name} over the moteus package's", f"{error}; pip install moteus")
        return
    assert loaded.motors is not None
    codec = build_codec(loaded.motors)
    ids = [motor for leg in loaded.motors.id for motor in leg]
    commands = np.tile([0.3, 0.5, 1.5, 30.0, 1.0], (12, 1))
    replies = [_reply(0.125, -0.5, 3.25)] * 12
    theirs = [_controller(moteus, motor) for motor in ids]

    def ours() -> None:
        codec.encode(commands)
        codec.to_si(as_array([codec.decode(reply) for reply in replies]))

    def makers() -> None:
        for controller, (position, velocity, torque, kp, kd) in zip(theirs, commands.tolist(), strict=True):
            controller.make_position(
                position=position,
                velocity=velocity,
                feedforward_torque=torque,
                kp_scale=kp,
                kd_scale=kd,
                maximum_torque=18.0,
                watchdog_timeout=0.1,
                query=True,
            )
        for reply in replies:
            moteus.parse_registers(reply)

    mine, other = in_turns(rounds, name, ours, makers)
    yield Figure("codecs", f"{name}, p50", mine, "µs")
    yield Figure("codecs", "the same by the moteus package, p50", other, "µs")
    yield Figure("codecs", "ours over the moteus package's", mine / other, "x", 0.1)


def _controller(moteus: Any, motor: int) -> Any:
    resolution = moteus.PositionResolution()
    for name in ("position", "velocity", "feedforward_torque", "kp_scale", "kd_scale", "maximum_torque"):
        setattr(resolution, name, moteus.F32)
    resolution.watchdog_timeout = moteus.F32
    return moteus.Controller(id=motor, position_resolution=resolution)


def _reply(position: float, velocity: float, torque: float) -> bytes:
    """A servo's answer to our query: mode, three floats, voltage, temperature, fault; padded."""
    head = struct.pack("<HbHfff", 0x0021, 10, 0x012F, position, velocity, torque)
    return (head + bytes.fromhex("230d302300")).ljust(24, b"\x50")


def measurement(counter: int) -> bytes:
    """An Xbus frame with all that the driver asks for: 73 bytes."""
    data = struct.pack(">HBHHBI", Data.PACKET_COUNTER, 2, counter, Data.SAMPLE_TIME_FINE, 4, 25 * counter)
    data += struct.pack(">HB4f", Data.QUATERNION, 16, 1.0, 0.0, 0.0, 0.0)
    data += struct.pack(">HB3f", Data.ACCELERATION, 12, 0.1, 0.2, 9.8)
    data += struct.pack(">HB3f", Data.RATE_OF_TURN, 12, 0.1, 0.2, 0.3)
    return xbus.encode(Message.MTDATA2, data + struct.pack(">HBI", Data.STATUS_WORD, 4, 3))


def plain_walk(data: bytes) -> list[tuple[int, bytes]]:
    """The frame format read a byte at a time: what the parser is measured against. Same answer on a whole frame."""
    packets, index = [], 0
    while index < len(data):
        if data[index] != xbus.PREAMBLE or data[index + 1] != xbus.MASTER:
            index += 1
            continue
        length = data[index + 3]
        total = 0
        for byte in data[index + 1 : index + 5 + length]:
            total = total + byte & 0xFF
        if total == 0:
            packets.append((data[index + 2], data[index + 4 : index + 4 + length]))
        index += 5 + length
    return packets


def against_plain_walk(rounds: int) -> Iterator[Finding]:
    """Finding and checking one whole frame."""
    frame, parser = measurement(7), XbusParser()
    assert plain_walk(frame) == parser.feed(frame)
    mine, other = in_turns(rounds, "xbus", lambda: parser.feed(frame), lambda: plain_walk(frame))
    yield Figure("codecs", f"xbus: parse {len(frame)} bytes, p50", mine, "µs")
    yield Figure("codecs", "the same by a plain walk, p50", other, "µs")
    yield Figure("codecs", "ours over the plain walk", mine / other, "x", 0.5)


class _Still:
    """An IMU that always has the same sample."""

    sample = ImuSample(0.0, np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.array([0.0, 0.0, 9.81]))

    async def connect(self) -> None:
        """Nothing to open."""

    def latest(self) -> ImuSample:
        """See ``Imu``."""
        return self.sample

    def troubles(self) -> dict[str, int]:
        return {}

    async def close(self) -> None:
        """Nothing to close."""


def exchange(loaded: config.Config, rounds: int) -> Iterator[Finding]:
    """A whole ``HardwareRobot.exchange`` where the motors answer at once: what is ours of it, and what that leaves."""
    assert loaded.motors is not None
    taken = asyncio.run(_exchanges(loaded, rounds))
    p50 = float(np.median(taken)) / 1e3
    yield Figure("codecs", "exchange without wires, p50", p50, "µs", 150.0)
    yield Figure("codecs", "exchange without wires, p99", float(np.percentile(taken, 99)) / 1e3, "µs")
    for rate in (200.0, 400.0):
        left = 1e3 / rate - SLOWER_PI * p50 / 1e3
        note = f"of {1e3 / rate:g}, were a Pi {SLOWER_PI:g} times slower than this machine"
        yield Figure("codecs", f"left for wires and control at {rate:g} Hz", left, "ms", note=note)


async def _exchanges(loaded: config.Config, rounds: int) -> list[int]:
    assert loaded.motors is not None
    robot = HardwareRobot(loaded.robot, Motors(loaded.motors, _answering(loaded), 0.003), _Still())
    await robot.connect()
    command: JointCommand = damp_command(3.0)
    taken = []
    gc.collect()
    gc.disable()
    try:
        for _ in shown(range(rounds), "exchange", rounds):
            first = now()
            await robot.exchange(command)
            taken.append(now() - first)
    finally:
        gc.enable()
        await robot.close()
    return taken[rounds // 10 :]


def _answering(loaded: config.Config) -> InProcessBus:
    """A bus whose servos stand folded and answer with frames that were made before."""
    assert loaded.motors is not None
    motors = loaded.motors
    codec = build_codec(motors)
    middle = (np.array(loaded.robot.joints.lower) + np.array(loaded.robot.joints.upper)) / 2
    revolutions = (np.array(motors.direction) * (middle + np.array(motors.offset))).ravel() / (2 * np.pi)
    buses = [number - 1 for leg in motors.bus for number in leg]
    replies: dict[tuple[int, int], list[Frame]] = {
        (bus, command): [(bus, reply, _reply(turn, 0.0, 0.0))]
        for bus, command, reply, turn in zip(
            buses, codec.command_ids, codec.reply_ids, revolutions.tolist(), strict=True
        )
    }
    return InProcessBus(lambda frame: replies[frame[:2]])
