"""``trotd twin``: the wire twin as a process, with its truth told to the daemon that drives it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import socket
import time
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import uvloop

from drivers import calibration
from drivers.calibration import VERSION, Calibration, fingerprint
from drivers.wiring import MotorsConfig
from runtime.config import Config
from runtime.control.posture import Posture
from runtime.link import session_config
from runtime.messages.decoding import MessageError
from runtime.messages.keys import Keys
from runtime.realtime import settle_garbage
from sim.build import Build, build_of, lab_build, scrambled
from sim.scenario import Noise, Scenario
from sim.twin import RATE_HZ, REAL_NOISE, TwinSetup, WireTwin, run_twin
from sim.world import World
from sim.xbus_emulator import Product
from trotd.bodies import hold_world, push_world, truth_message
from trotd.wire import IMU_LINK, KNOWN, MEETING, TWIN_PATIENCE, favour, own_wires, twin_folder, twin_wires

TRUTH_EVERY = round(RATE_HZ / 100)
"""Steps between two messages of the truth."""
PHYSICS_RATE_HZ = 2 * RATE_HZ
LAB = "stoch3"
"""The robot whose build is known from its lab's own files."""


@dataclass(frozen=True, slots=True)
class TwinOptions:
    """How the twin is put together."""

    scramble: int | None = None
    """Seed of a body that nobody knows, which then has no calibration."""
    product: Product = "MTI-630"
    noise: bool = True
    patience: float = TWIN_PATIENCE
    """How long the world waits for a daemon that does not speak, s; 0 lets it go on by the clock at once."""


def serve_twin(config: Config, folder: Path, endpoint: str, options: TwinOptions) -> None:
    """Be the robot's body on wires until SIGTERM or SIGINT; the daemon at ``endpoint`` may start later.

    Raises:
        DriverError: the robot has no wires, or a bus cannot be opened.
    """
    wires = own_wires(config)
    meeting = twin_folder(folder, config.robot.name)
    meeting.mkdir(parents=True, exist_ok=True)
    port = free_ports(len(wires.bus.channels))
    build = lab_build() if config.robot.name == LAB else build_of(wires.motors, wires.imu.mount)
    known = meeting / KNOWN
    known.unlink(missing_ok=True)
    if options.scramble is None:
        calibration.save(true_calibration(build, config, wires.motors), known)
    else:
        build = scrambled(build, options.scramble)
    world = World(config.robot, RATE_HZ, config.control.gait.walking_height, PHYSICS_RATE_HZ)
    pose = Posture(config.robot, config.control, config.posture).folded_joints
    scenario = Scenario(joint_position=pose, noise=REAL_NOISE if options.noise else Noise())
    twin = WireTwin(world, TwinSetup(build, wires.motors, scenario, options.product), meeting / IMU_LINK)
    bus = twin_wires(wires, meeting, port).bus
    place = meeting / MEETING
    favour(0)
    settle_garbage()
    try:
        with _told(config.robot.name, endpoint, world) as tell:
            live = _live(
                lambda: run_twin(twin, bus, 1.0 / config.control.rate_hz, options.patience, tell),
                lambda: place.write_text(json.dumps({"port": port})),
            )
            with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
                runner.run(live)
    finally:
        place.unlink(missing_ok=True)
        world.close()


def true_calibration(build: Build, config: Config, motors: MotorsConfig) -> Calibration:
    """What a perfect commissioning of ``build`` would write."""
    table = {
        "version": VERSION,
        "robot": config.robot.name,
        "body": fingerprint(config.robot, motors),
        "date": datetime.now(UTC),
        "id": build.id.tolist(),
        "bus": build.bus.tolist(),
        "direction": build.direction.astype(int).tolist(),
        "offset": build.offset.tolist(),
        "mount": build.mount.tolist(),
    }
    return msgspec.convert(table, Calibration)


async def _live(run: Callable[[], Coroutine[Any, Any, None]], ready: Callable[[], object]) -> None:
    loop = asyncio.get_running_loop()
    async with asyncio.TaskGroup() as group:
        task = group.create_task(run(), name="twin")
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, task.cancel)
        await asyncio.sleep(0.05)  # its buses are open, or it has failed
        ready()


@contextlib.contextmanager
def _told(robot: str, endpoint: str, world: World) -> Iterator[Callable[[], None]]:
    """What to call after each step: it tells the world's truth and does the pushes that came in."""
    import zenoh

    keys = Keys(robot)
    settings = session_config("peer", [], [endpoint])
    settings.insert_json5("connect/exit_on_failure", "false")
    settings.insert_json5("connect/timeout_ms", "-1")
    steps = 0
    with zenoh.open(settings) as session:
        truth = session.declare_publisher(keys.sim_truth)
        heard = [
            (act, session.declare_subscriber(key, zenoh.handlers.RingChannel(16)))
            for key, act in ((keys.sim_push, push_world), (keys.sim_hold, hold_world))
        ]

        def tell() -> None:
            nonlocal steps
            steps += 1
            for act, channel in heard:
                while (sample := channel.try_recv()) is not None:
                    with contextlib.suppress(MessageError):
                        act(world, sample.payload.to_bytes())
            if steps % TRUTH_EVERY == 0:
                truth.put(truth_message(world, time.monotonic()))

        yield tell


def free_ports(count: int) -> int:
    """The first of ``count`` UDP ports in a row that nobody uses now."""
    for first in range(43113, 65000, 64):
        with contextlib.ExitStack() as stack:
            try:
                for port in range(first, first + count):
                    stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)).bind(("", port))
            except OSError:
                continue
            return first
    raise OSError("no free UDP ports")
