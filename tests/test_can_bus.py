"""Bus back-ends: frames as the kernel wants them, buses that go away and come back, two real transports, the pi3hat."""

from __future__ import annotations

import asyncio
import errno
import socket
import threading
import time
from collections.abc import Callable, Sequence
from types import SimpleNamespace

import can
import msgpack
import pytest
from can.interfaces.socketcan.socketcan import build_can_frame

from drivers.bus import BusCounters
from drivers.can_bus import PythonCanBus
from drivers.can_channels import SocketCanChannel, open_channel
from drivers.errors import DriverError
from drivers.pi3hat import Pi3HatBus, load_library
from drivers.wiring import BusConfig


def config(backend: str = "virtual", *channels: str, **changes: object) -> BusConfig:
    return BusConfig(backend=backend, channels=channels or ("a",), **changes)  # type: ignore[arg-type]


class Wire:
    """A SocketCAN channel over a socket pair: the kernel's side is ``far``."""

    def __init__(self, fd: bool = True) -> None:
        near, self.far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.counters = BusCounters()
        self.channel = SocketCanChannel(SimpleNamespace(socket=near, shutdown=near.close), self.counters, fd)

    def close(self) -> None:
        self.channel.close()
        self.far.close()


@pytest.fixture
def wire():
    wire = Wire()
    yield wire
    wire.close()


def without_dlc(frame: bytes) -> bytes:
    """Byte 7 is reserved, or the raw DLC of special controllers; python-can fills it always, the kernel ignores it."""
    return frame[:7] + frame[8:]


@pytest.mark.parametrize("identifier", [0x7FF, 0x800, 0x800B])
@pytest.mark.parametrize("size", [0, 8, 12, 48, 64])
def test_frames_are_laid_out_as_python_can_lays_them(wire, identifier, size):
    data = bytes(range(size))
    wire.channel.send(identifier, data)
    message = can.Message(
        arbitration_id=identifier, is_extended_id=identifier > 0x7FF, data=data, is_fd=True, bitrate_switch=True
    )
    assert without_dlc(wire.far.recv(200)) == without_dlc(build_can_frame(message))


def test_classic_frames_are_laid_out_as_python_can_lays_them():
    wire = Wire(fd=False)
    wire.channel.send(3, b"\xff" * 7 + b"\xfc")
    message = can.Message(arbitration_id=3, is_extended_id=False, data=b"\xff" * 7 + b"\xfc")
    assert without_dlc(wire.far.recv(200)) == without_dlc(build_can_frame(message))
    wire.close()


def test_received_frames_and_error_frames(wire):
    wire.far.send(build_can_frame(can.Message(arbitration_id=0xB00, data=b"12345", is_fd=True, is_extended_id=True)))
    wire.far.send(build_can_frame(can.Message(arbitration_id=0x40, is_error_frame=True, dlc=8, data=bytes(8))))
    wire.far.send(build_can_frame(can.Message(arbitration_id=3, data=b"6", is_extended_id=False)))
    wire.far.send(b"short")
    assert wire.channel.read() == [(0xB00, b"12345"), (3, b"6")]
    assert (wire.counters.error_frames, wire.counters.bus_off) == (2, 1)


class FakeChannel:
    """A channel that can fail."""

    def __init__(self) -> None:
        self.failure: OSError | None = None
        self.closed = False
        self.sent: list[tuple[int, bytes]] = []
        self.waiting: list[tuple[int, bytes]] = []

    def send(self, identifier: int, data: bytes) -> None:
        if self.failure is not None:
            raise self.failure
        self.sent.append((identifier, data))
        self.waiting.append((identifier, data))

    def read(self) -> list[tuple[int, bytes]]:
        frames, self.waiting = self.waiting, []
        return frames

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self.closed = True


def fake_bus(*channels: FakeChannel, refuse: Callable[[int], bool] = lambda index: False):
    now = SimpleNamespace(time=0.0)

    def opener(config: BusConfig, index: int, counters: BusCounters, fd: bool) -> FakeChannel:
        if refuse(index):
            raise DriverError(f"bus {index + 1} is not there")
        return channels[index]

    names = tuple(str(i) for i in range(len(channels)))
    bus = PythonCanBus(config("virtual", *names), fd=True, open_channel=opener, clock=lambda: now.time)  # type: ignore[arg-type]
    return bus, now


def test_all_frames_go_out_and_the_cycle_ends_with_the_last_reply():
    left, right = FakeChannel(), FakeChannel()
    bus, _ = fake_bus(left, right)
    got: list[tuple[int, int, bytes]] = []

    async def go() -> float:
        await bus.open(lambda *frame: got.append(frame) or len(got) == 3)
        start = asyncio.get_running_loop().time()
        await bus.cycle([(0, 1, b"a"), (1, 2, b"b"), (0, 3, b"c")], 5.0)
        return asyncio.get_running_loop().time() - start

    assert asyncio.run(go()) < 5.0
    assert sorted(got) == [(0, 1, b"a"), (0, 3, b"c"), (1, 2, b"b")]
    assert (bus.counters.sent, bus.counters.received) == (3, 3)


def test_a_bus_that_goes_down_is_opened_again_and_the_other_keeps_working():
    left, right = FakeChannel(), FakeChannel()
    absent = {0: False}
    bus, now = fake_bus(left, right, refuse=lambda index: absent.get(index, False))

    async def cycle() -> None:
        await bus.cycle([(0, 1, b"a"), (1, 2, b"b")], 0.001)

    async def go() -> None:
        await bus.open(lambda *frame: False)
        left.failure = OSError(errno.ENETDOWN, "down")
        await cycle()
        assert left.closed
        left.failure, absent[0] = None, True
        await cycle()
        now.time = 1.0
        await cycle()  # tried, still absent
        absent[0] = False
        now.time = 1.2
        await cycle()  # not yet time
        assert left.sent == []
        now.time = 2.0
        await cycle()
        assert left.sent == [(1, b"a")]

    asyncio.run(go())
    assert len(right.sent) == 5
    assert (bus.counters.reopened, bus.counters.send_failures) == (1, 4)


def test_a_full_queue_costs_a_frame_and_no_bus():
    only = FakeChannel()
    only.failure = OSError(errno.ENOBUFS, "queue")
    bus, _ = fake_bus(only)

    async def go() -> None:
        await bus.open(lambda *frame: False)
        await bus.cycle([(0, 1, b"a")], 0.001)

    asyncio.run(go())
    assert (bus.counters.send_failures, only.closed) == (1, False)


def test_every_bus_that_cannot_be_opened_is_in_one_report():
    channels = [FakeChannel() for _ in range(3)]
    bus, _ = fake_bus(*channels, refuse=lambda index: index != 1)
    with pytest.raises(DriverError, match=r"bus 1 is not there\nbus 3 is not there"):
        asyncio.run(bus.open(lambda *frame: False))
    assert channels[1].closed


def test_no_socketcan_here_says_what_to_do():
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        with pytest.raises(DriverError, match=r"bus 1 \(socketcan can7\).*; ") as caught:
            open_channel(config("socketcan", "can7"), 0, BusCounters(), True)
        assert "kernel" in str(caught.value)
    else:
        pytest.skip("this kernel has CAN")


def echo_motors(bus: can.BusABC, stop: threading.Event) -> None:
    while not stop.is_set():
        message = bus.recv(0.01)
        if message is not None and message.arbitration_id & 0x8000:
            reply = (message.arbitration_id & 0x7F) << 8
            bus.send(can.Message(arbitration_id=reply, is_extended_id=True, data=message.data, is_fd=True))


@pytest.mark.parametrize("backend", ["virtual", "udp_multicast"])
def test_real_transports_carry_a_cycle_and_its_echoes(backend):
    channels = ("239.74.163.61", "239.74.163.62") if backend == "udp_multicast" else ("left", "right")
    settings = config(backend, *channels, port=47113)
    extra = [{"port": 47113 + bus, "hop_limit": 0} if backend == "udp_multicast" else {} for bus in (0, 1)]
    try:
        far = [
            can.Bus(interface=backend, channel=name, fd=True, **more)
            for name, more in zip(channels, extra, strict=True)
        ]
    except (OSError, can.CanError) as error:
        pytest.skip(f"no {backend} here: {error}")
    stop = threading.Event()
    threads = [threading.Thread(target=echo_motors, args=(bus, stop)) for bus in far]
    got: set[tuple[int, int, bytes]] = set()

    def receive(bus: int, identifier: int, data: bytes) -> bool:
        if not identifier & 0x8000:
            got.add((bus, identifier, data))
        return len(got) == 4

    async def go() -> None:
        bus = PythonCanBus(settings, fd=True)
        await bus.open(receive)
        try:
            frames = [(0, 0x800B, b"1" * 48), (0, 0x800C, b"2" * 48), (1, 0x8015, b"3" * 48), (1, 0x8016, b"4" * 48)]
            await bus.cycle(frames, 3.0)
        finally:
            await bus.close()

    for thread in threads:
        thread.start()
    try:
        asyncio.run(go())
    except OSError as error:
        pytest.skip(f"no {backend} here: {error}")
    finally:
        stop.set()
        for thread in threads:
            thread.join()
        for bus in far:
            bus.shutdown()
    wanted = {(0, 11, b"1"), (0, 12, b"2"), (1, 21, b"3"), (1, 22, b"4")}
    assert got == {(bus, motor << 8, letter * 48) for bus, motor, letter in wanted}


GARBAGE = (
    b"", b"\xc1", b"\x81", b"\xa1\xff", msgpack.packb(7), msgpack.packb([1, 2]), msgpack.packb({"data": b"x"}),
    msgpack.packb({"arbitration_id": "1", "data": b"x", "is_error_frame": False}),
    msgpack.packb({"arbitration_id": 1, "data": None, "is_error_frame": False}),
    msgpack.packb({"arbitration_id": 1, "data": b"x", "is_error_frame": True}),
)  # fmt: skip


def test_datagrams_that_are_no_frames_are_counted_and_passed_over():
    group, port, counters = "239.74.163.63", 47119, BusCounters()
    try:
        channel = open_channel(config("udp_multicast", group, port=port), 0, counters, True)
    except DriverError as error:
        pytest.skip(f"no multicast here: {error}")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for raw in GARBAGE:
            stranger.sendto(raw, (group, port))
    channel.send(0x800B, b"1" * 48)
    frames, end = [], time.monotonic() + 5.0
    while not frames and time.monotonic() < end:
        frames += channel.read()
    channel.close()
    assert frames == [(0x800B, b"1" * 48)]
    assert counters.error_frames == len(GARBAGE)


class StandIn:
    """The API of moteus-pi3hat's native module, from its public source: Options, Input, SingleCan, Pi3HatDevice."""

    def __init__(self, answer: Callable[[SimpleNamespace], Sequence[SimpleNamespace]]) -> None:
        self.inputs: list[SimpleNamespace] = []
        self.options = SimpleNamespace()
        self.Options = lambda: self.options
        self.Input = SimpleNamespace
        self.SingleCan = SimpleNamespace
        outer = self

        class Pi3HatDevice:
            def __init__(self, options: SimpleNamespace) -> None:
                if options.cpu == 63:
                    raise RuntimeError("could not open /dev/mem")
                self.active = False

            def cycle(self, cycle: SimpleNamespace, callback: Callable[[SimpleNamespace], None]) -> None:
                assert not self.active, "cannot invoke multiple cycles at the same time"
                self.active = True
                outer.inputs.append(cycle)

                def work() -> None:
                    replies = answer(cycle)
                    self.active = False
                    callback(SimpleNamespace(rx_can=replies))

                threading.Thread(target=work).start()

        self.Pi3HatDevice = Pi3HatDevice


def answer_all(cycle: SimpleNamespace) -> list[SimpleNamespace]:
    return [
        SimpleNamespace(arbitration_id=(frame.arbitration_id & 0x7F) << 8, bus=frame.bus, data=frame.data)
        for frame in cycle.tx_can
    ]


def test_pi3hat_is_one_native_cycle_a_tick():
    library = StandIn(answer_all)
    got: list[tuple[int, int, bytes]] = []

    async def go() -> None:
        bus = Pi3HatBus(config("pi3hat", "JC1", "JC3", cpu=2), fd=True, library=library)
        await bus.open(lambda *frame: got.append(frame) or False)
        for _ in range(2):
            await bus.cycle([(0, 0x800B, b"a"), (1, 0x8015, b"b")], 0.0005)
        await bus.close()

    asyncio.run(go())
    assert library.options.cpu == 2
    assert len(library.inputs) == 2
    cycle = library.inputs[0]
    assert [(frame.bus, frame.arbitration_id, frame.expect_reply) for frame in cycle.tx_can] == [
        (1, 0x800B, True),
        (3, 0x8015, True),
    ]
    assert cycle.force_can_check == 1 << 1 | 1 << 3
    assert cycle.rx_baseline_wait_ns == 500_000
    assert got == [(0, 0x0B00, b"a"), (1, 0x1500, b"b")] * 2


def test_a_cancelled_pi3hat_cycle_still_ends_before_the_next():
    release = threading.Event()

    def slow(cycle: SimpleNamespace) -> list[SimpleNamespace]:
        release.wait(60.0)
        return answer_all(cycle)

    library = StandIn(slow)

    async def go() -> None:
        bus = Pi3HatBus(config("pi3hat", "JC1"), fd=True, library=library)
        await bus.open(lambda *frame: False)
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.02):
                await bus.cycle([(0, 0x800B, b"a")], 0.001)
        release.set()
        await bus.cycle([(0, 0x800B, b"a")], 0.001)
        await bus.close()

    asyncio.run(go())
    assert len(library.inputs) == 2


def test_pi3hat_says_what_is_missing():
    with pytest.raises(DriverError, match="moteus-pi3hat"):
        load_library()
    with pytest.raises(ValueError, match="can0"):
        Pi3HatBus(config("pi3hat", "can0"), fd=True)
    bus = Pi3HatBus(config("pi3hat", "JC1", cpu=63), fd=True, library=StandIn(answer_all))
    with pytest.raises(DriverError, match=r"/dev/mem; it needs root"):
        asyncio.run(bus.open(lambda *frame: False))
