"""Two network namespaces and a cable between them whose faults a test decides: delay, loss, silence.

The kernel's netem is missing from many kernels, so the cable is a thread that carries IP packets between two TUN
devices: TCP on both ends is the kernel's own, with its retransmissions. Needs root and /dev/net/tun.
"""

from __future__ import annotations

import contextlib
import fcntl
import heapq
import os
import random
import select
import shutil
import struct
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pytest

TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
MTU = 1500


@dataclass
class Cable:
    """Both directions alike; every attribute may be changed at any time."""

    delay: float = 0.0
    """One way, s."""
    loss: float = 0.0
    """Share of packets that are lost."""
    silent: bool = False
    """Nothing arrives."""
    carried: int = 0
    lost: int = 0
    random: random.Random = field(default_factory=lambda: random.Random(1))

    def takes(self) -> bool:
        """Whether the next packet arrives."""
        arrives = not self.silent and self.random.random() >= self.loss
        self.carried += arrives
        self.lost += not arrives
        return arrives


@dataclass(frozen=True)
class End:
    """One namespace."""

    name: str
    address: str

    def command(self, *words: str) -> list[str]:
        """A command line that runs inside."""
        return ["ip", "netns", "exec", self.name, *words]


@contextlib.contextmanager
def cabled() -> Iterator[tuple[End, End, Cable]]:
    """Two ends and their cable; skips where that cannot be had."""
    if os.geteuid() != 0 or shutil.which("ip") is None or not Path("/dev/net/tun").exists():
        pytest.skip("network namespaces need root, iproute2 and /dev/net/tun")
    ends = [End(f"trotd-{os.getpid()}-{side}", f"10.77.0.{number}") for number, side in ((1, "robot"), (2, "desk"))]
    cable, stop = Cable(), threading.Event()
    with contextlib.ExitStack() as stack:
        devices = [stack.enter_context(_device(end)) for end in ends]
        thread = threading.Thread(target=_carry, args=(devices, cable, stop))
        thread.start()
        stack.callback(thread.join)
        stack.callback(stop.set)
        yield ends[0], ends[1], cable


@contextlib.contextmanager
def _device(end: End) -> Iterator[int]:
    fd = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    try:
        device = f"tr{os.getpid()}{end.address[-1]}"[-15:]
        fcntl.ioctl(fd, TUNSETIFF, struct.pack("16sH22x", device.encode(), IFF_TUN | IFF_NO_PI))
        if subprocess.run(["ip", "netns", "add", end.name], capture_output=True, check=False).returncode != 0:
            pytest.skip("no network namespace can be made here")
        try:
            _ip("link", "set", device, "netns", end.name)
            _ip("-n", end.name, "addr", "add", f"{end.address}/24", "dev", device)
            _ip("-n", end.name, "link", "set", device, "up", "mtu", str(MTU))
            _ip("-n", end.name, "link", "set", "lo", "up")
            yield fd
        finally:
            _ip("netns", "del", end.name)
    finally:
        os.close(fd)


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


def _carry(devices: Sequence[int], cable: Cable, stop: threading.Event) -> None:
    """Read here, wait, write there, until ``stop``."""
    waiting: list[tuple[float, int, int, bytes]] = []
    count = 0
    while not stop.is_set():
        now = time.monotonic()
        while waiting and waiting[0][0] <= now:
            _, _, target, packet = heapq.heappop(waiting)
            with contextlib.suppress(OSError):  # that end is being taken down
                os.write(target, packet)
        pause = min(0.05, waiting[0][0] - now) if waiting else 0.05
        for fd in select.select(devices, [], [], pause)[0]:
            with contextlib.suppress(OSError):
                packet = os.read(fd, MTU + 100)
                if cable.takes():
                    count += 1
                    target = devices[1 - devices.index(fd)]
                    heapq.heappush(waiting, (time.monotonic() + cable.delay, count, target, packet))
