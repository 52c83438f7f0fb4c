"""The doors that are fuzzed, by name. A new one is a function of a scratch folder under ``@door``."""

from __future__ import annotations

import asyncio
import contextlib
import struct
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np
from bench_robot import motors_config
from fuzz import Door

from drivers import calibration, xbus
from drivers.bus import InProcessBus, Receive
from drivers.calibration import VERSION, Calibration, CalibrationError, fingerprint
from drivers.commissioning import CommissionError
from drivers.errors import CorruptFrame
from drivers.moteus_registers import pad, parse
from drivers.motors import Motors
from drivers.mtdata2 import Data, SampleDecoder
from drivers.survey import MitQuestion, MoteusQuestion, Question
from drivers.xbus import Message, XbusParser
from runtime import config, crash, policies, recording
from runtime.config import ConfigError
from runtime.keyframe import KEYFRAME_DTYPE
from runtime.messages.decoding import MessageError
from runtime.messages.mode import decode_request
from runtime.messages.motion import decode_velocity
from runtime.messages.simulation import decode_hold, decode_push
from runtime.messages.tick import TICK_DTYPE, tick_schema
from runtime.policies import PolicyError
from runtime.recorder import EVENT_DTYPE, Recorder
from runtime.recording import Header, RecordingError
from runtime.ring import Kind, create
from station import pad as station_pad
from station.session import StationError
from station.ticks import read_schema
from trotd.commission.steps import Commission

DOORS: dict[str, Callable[[Path], Door]] = {}
Maker = Callable[[Path], Door]


def door(name: str) -> Callable[[Maker], Maker]:
    """Register what makes one door."""

    def register(make: Maker) -> Maker:
        DOORS[name] = make
        return make

    return register


@contextlib.contextmanager
def open_doors(names: Sequence[str] | None = None) -> Iterator[dict[str, Door]]:
    """The doors called ``names``, all without any, in a scratch folder of their own (in memory where there is one)."""
    unknown = set(names or ()) - set(DOORS)
    if unknown:
        raise SystemExit(f"no door {', '.join(sorted(unknown))}; there are {', '.join(DOORS)}")
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(prefix="trotd-fuzz-", dir=memory if memory.is_dir() else None) as folder:
        yield {name: DOORS[name](Path(folder)) for name in names or DOORS}


# Wires -----------------------------------------------------------------------------------------------------------


def measurement(counter: int, orientation: bool = True) -> bytes:
    """A good Xbus measurement, 73 bytes with orientation."""
    data = struct.pack(">HBHHBI", Data.PACKET_COUNTER, 2, counter, Data.SAMPLE_TIME_FINE, 4, 25 * counter)
    if orientation:
        data += struct.pack(">HB4f", Data.QUATERNION, 16, 1.0, 0.0, 0.0, 0.0)
    data += struct.pack(">HB3f", Data.ACCELERATION, 12, 0.1, 0.2, 9.8)
    data += struct.pack(">HB3f", Data.RATE_OF_TURN, 12, 0.1, 0.2, 0.3)
    return xbus.encode(Message.MTDATA2, data + struct.pack(">HBI", Data.STATUS_WORD, 4, 3))


@door("xbus")
def xbus_door(_folder: Path) -> Door:
    parser, decoder = XbusParser(), SampleDecoder()
    good = measurement(7)
    (wanted,) = XbusParser().feed(good)

    def take(data: bytes) -> None:
        cut = len(data) // 3
        for part in (data[:cut], data[cut:]):
            for message, content in parser.feed(part):
                if message == Message.MTDATA2:
                    with contextlib.suppress(CorruptFrame):
                        decoder.decode(content)
                elif message == Message.OUTPUT_CONFIGURATION:
                    with contextlib.suppress(CorruptFrame):
                        xbus.decode_outputs(content)

    def recover() -> None:
        """At most one good frame is lost: whatever came before it may have begun like a frame that ends within."""
        parser.feed(good)
        assert parser.feed(good)[-1:] == [wanted], "no packet from the second good frame on"
        assert decoder.decode(wanted[1]).counter == 7

    seeds = [good, measurement(8, orientation=False), good + measurement(8) + xbus.encode(Message.ERROR, b"\x29")]
    seeds.append(xbus.encode(Message.OUTPUT_CONFIGURATION, bytes(range(24))) + xbus.encode(Message.WAKE_UP))
    seeds.append(xbus.encode(Message.CONFIGURATION, bytes(300)))
    return Door(take, (), seeds, recover, share=3.0)


class Tap(InProcessBus):
    """A bus whose replies are whatever the fuzzer says."""

    receive: Receive

    def __init__(self) -> None:
        super().__init__(lambda _frame: ())

    async def open(self, receive: Receive) -> None:
        """See ``Bus.open``."""
        self.receive = receive


def motor_door(motors: Motors, tap: Tap, question: Question, reply: bytes, seeds: Sequence[bytes]) -> Door:
    """Frames at the motors' end: two bytes of bus and arbitration id, then the data."""
    asyncio.run(motors.open())
    place, turns = motors.codec.reply_ids[0], iter(range(10**12))

    def take(data: bytes) -> None:
        identifier = int.from_bytes(data[1:3], "big")
        tap.receive(data[0] & 3 if data else 0, identifier, data[3:])
        tap.receive(0, place, data[3:])
        for read in (motors.codec.decode, parse, lambda frame: question.read(1, 11, [frame])):
            with contextlib.suppress(CorruptFrame):
                read(data[3:])

    def recover() -> None:
        tap.receive(0, place, reply)
        assert motors._readings[0] == expected, f"reads {motors._readings[0]} after a good reply"
        if next(turns) % 20 == 0:
            motors._si = motors.codec.to_si(np.array(motors._readings))
            assert np.isfinite(motors.joint_state().position[0, 0])

    expected = motors.codec.decode(reply)
    head = b"\x00" + place.to_bytes(2, "big")
    return Door(take, (), [head + seed for seed in (reply, *seeds)], recover, share=2.0)


@door("moteus")
def moteus_door(_folder: Path) -> Door:
    tap = Tap()
    reply = pad(bytes.fromhex("21000a2f010000003e000000bf0000504023") + b"\x0d\x30\x23\x00")
    seeds = [
        bytes.fromhex("21000a270104e80307d0000a230d302300"),
        bytes.fromhex("2404000a005000000170ff230d181400"),
        bytes.fromhex("01000a0c0620cdcccc3d0000003f0000c03f0000803f0000803f000090410d27cdcccc3d11001f01130d"),
        bytes.fromhex("310101300702") + b"\x50\x50",
        bytes.fromhex("410105616263646543010203414243"),
    ]
    return motor_door(Motors(motors_config(), tap, 0.003), tap, MoteusQuestion(), reply, seeds)


@door("mit")
def mit_door(_folder: Path) -> Door:
    tap = Tap()
    ids = ((1, 2, 3), (4, 5, 6), (7, 8, 9), (10, 11, 12))
    motors = Motors(motors_config(id=ids, protocol="mit", model="DM4340"), tap, 0.003)
    replies = [bytes([0x10 | motor, 0x7F, 0xFF, 0x80, 0x07, 0xFF, 30, 31]) for motor in (1, 2, 3)]
    return motor_door(motors, tap, MitQuestion("AK80-9"), replies[0], [*replies[1:], b"\x01\x80\x00\x7f\xf8\x00"])


# Messages --------------------------------------------------------------------------------------------------------

ROBOT = config.load(config.find_robot("stoch3"))


@door("zenoh")
def zenoh_door(_folder: Path) -> Door:
    """Whatever the daemon, its twin and the desk hear from the network, but for policies."""
    listeners: tuple[Callable[[bytes], object], ...] = (
        lambda data: decode_velocity(data, (1.6, 0.6), 1.5),
        decode_request,
        decode_push,
        decode_hold,
        read_schema,
    )
    seeds = [b'{"linear": [0.5, -0.1], "yaw_rate": 0.3}', b"stand", b'{"force":[10,0,0],"duration":0.1}']
    seeds += [b'{"rpy":[0,0.5,0],"joints":[0,1,-1,0,1,-1,0,1,-1,0,1,-1]}', b'{"rpy":[0,0,0],"down":true}']

    def take(data: bytes) -> None:
        for listen in listeners:
            with contextlib.suppress(MessageError, StationError):
                listen(data)

    def recover() -> None:
        assert decode_velocity(seeds[0], (1.6, 0.6), 1.5).yaw_rate == 0.3

    return Door(take, (), [*seeds, tick_schema()[:900]], recover, share=1.5, text=True)


@door("policy")
def policy_door(_folder: Path) -> Door:
    shipped = policies.find_policy("balance").read_bytes()
    small = policies.SHIPPED.joinpath("trot.json").read_bytes()

    def take(data: bytes) -> None:
        policies.decode(data, "stoch3", "fuzz")

    def recover() -> None:
        if next(turn) % 50 == 0:
            assert policies.decode(shipped, "stoch3", "fuzz").name == "balance"

    turn = iter(range(10**12))
    return Door(take, (PolicyError,), [shipped, small], recover, share=0.3, text=True)


# Files -----------------------------------------------------------------------------------------------------------


def file_door(path: Path, load: Callable[[Path], object], refusal: type[Exception], seeds: Sequence[bytes]) -> Door:
    """A loader of one file: the first seed must load after every other one."""

    def take(data: bytes) -> None:
        path.write_bytes(data)
        load(path)

    def recover() -> None:
        if next(turn) % 50 == 0:
            path.write_bytes(seeds[0])
            load(path)

    turn = iter(range(10**12))
    return Door(take, (refusal,), seeds, recover, share=0.1, text=True)


@door("config")
def config_door(folder: Path) -> Door:
    shipped = [config.find_robot(name).read_bytes() for name in ("stoch3", "mini_cheetah", "a1")]
    return file_door(folder / "robot.toml", config.load, ConfigError, shipped)


@door("calibration")
def calibration_door(folder: Path) -> Door:
    motors = motors_config()
    made = msgspec.convert(
        {
            "version": VERSION,
            "robot": "stoch3",
            "body": fingerprint(ROBOT.robot, motors),
            "date": "2026-11-22T12:00:00Z",
            "id": motors.id,
            "bus": motors.bus,
            "direction": motors.direction,
            "offset": motors.offset,
            "mount": [1.0, 0.0, 0.0, 0.0],
        },
        Calibration,
    )
    calibration.save(made, folder / "good.json")
    seed = (folder / "good.json").read_bytes()

    def load(path: Path) -> object:
        return calibration.load(path, ROBOT.robot, motors)

    return file_door(folder / "calibration.json", load, CalibrationError, [seed])


def header() -> Header:
    """Of a recording that says little."""
    return Header(
        robot="stoch3",
        robot_toml="",
        policy="",
        rate_hz=200.0,
        reason="fuzz",
        written="2026-11-22T12:00:00",
        versions={"trotd": "0"},
        layout=recording.layout(),
        itemsize=TICK_DTYPE.itemsize,
        events=[],
    )


@door("recording")
def recording_door(folder: Path) -> Door:
    kept = Recorder(folder, 200.0, 1.0, 10, 10**9)
    for _ in range(3):
        kept.keep(np.zeros(1, TICK_DTYPE))
    seed = kept.write(header(), "good").read_bytes()
    return file_door(folder / "mutated.trotd", recording.load, RecordingError, [seed])


@door("crash")
def crash_door(folder: Path) -> Door:
    """What a killed run left in memory: ``h`` and another header beside a good ring, or ``r`` and another ring."""
    left, shelf = folder / "left", folder / "shelf"
    kinds = [Kind(TICK_DTYPE, 4), Kind(KEYFRAME_DTYPE, 2), Kind(EVENT_DTYPE, 2)]
    ticks, *_ = create(kinds, folder / "good-ring")
    for index in range(3):
        tick = np.zeros(1, TICK_DTYPE)
        tick["index"] = index
        ticks.put(tick)
    crash.keep_header(folder, header())
    good = (folder / crash.HEADER).read_bytes(), (folder / "good-ring").read_bytes()

    def put(head: bytes, ring: bytes) -> object:
        left.mkdir(exist_ok=True)
        (left / crash.HEADER).write_bytes(head)
        (left / crash.RING).write_bytes(ring)
        return crash.salvage(left, shelf, 3, 10**6)

    def take(data: bytes) -> None:
        put(data[1:] if data[:1] == b"h" else good[0], good[1] if data[:1] == b"h" else data[1:])

    def recover() -> None:
        if next(turn) % 50 == 0:
            put(*good)

    turn = iter(range(10**12))
    return Door(take, (crash.CrashError,), [b"h" + good[0], b"r" + good[1]], recover, share=0.1, text=True)


@door("pad")
def pad_door(folder: Path) -> Door:
    """How a gamepad's keys are laid out."""
    shipped = [path.read_bytes() for path in sorted(Path(station_pad.__file__).parent.rglob("*.toml"))]
    return file_door(folder / "pad.toml", station_pad.load_mapping, StationError, shipped)


@door("progress")
def progress_door(folder: Path) -> Door:
    """What commissioning found so far."""
    path = folder / "progress.json"
    seed = b'{"version":2,"robot":"stoch3","joints":{"FL knee":[1,13,-1]},"zeros":{"FL knee":[0.1,2.9]},'
    seed += b'"mount":[[0,0,9.8]]}'

    def load(place: Path) -> object:
        unused: object = None
        return Commission(ROBOT, motors_config(), place, unused, unused).complete  # type: ignore[arg-type]

    return file_door(path, load, CommissionError, [seed])
