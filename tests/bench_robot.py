"""Twelve emulated servos on an in-process bus, with a clock that the test turns: what the driver tests stand on."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from drivers.bus import Frame, InProcessBus
from drivers.motors import Motors
from drivers.robot import JointCommand
from drivers.wiring import MotorsConfig
from sim.mit_emulator import MitEmulator
from sim.moteus_emulator import MoteusEmulator
from sim.servo import Drive, ServoEmulator

DIRECTION = ((-1, -1, -1), (-1, 1, 1), (1, -1, -1), (1, 1, 1))
OFFSET = ((-0.184, -1.474, 2.873), (0.153, -1.467, 2.851), (-0.174, -1.426, 2.873), (0.22, -1.433, 2.854))
IDS = ((11, 12, 13), (21, 22, 23), (31, 32, 33), (41, 42, 43))
BUSES = ((1, 1, 1), (2, 2, 2), (3, 3, 3), (4, 4, 4))


def motors_config(**changes: object) -> MotorsConfig:
    table: dict[str, object] = {
        "id": IDS,
        "bus": BUSES,
        "direction": DIRECTION,
        "offset": OFFSET,
        "max_torque": (40.0, 40.0, 40.0),
    }
    return MotorsConfig(**(table | changes))  # type: ignore[arg-type]


class Clock:
    """Monotonic time, by hand."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class BenchBus(InProcessBus):
    """The in-process bus over emulators, with the wire's faults as a hook."""

    def __init__(self, servos: dict[tuple[int, int], ServoEmulator], clock: Clock) -> None:
        super().__init__(self._wire)
        self.servos, self.clock = servos, clock
        self.fault: Callable[[Frame], list[Frame]] = lambda reply: [reply]
        self.sent: list[Frame] = []

    def _wire(self, frame: Frame) -> list[Frame]:
        self.sent.append(frame)
        bus, identifier, data = frame
        replies: list[Frame] = []
        for (where, _), servo in self.servos.items():
            if where == bus and (reply := servo.answer(identifier, data, self.clock())) is not None:
                replies += self.fault((bus, *reply))
        return replies

    def drives(self) -> dict[tuple[int, int], Drive]:
        return {key: servo.step(self.clock()) for key, servo in self.servos.items()}


class Bench:
    """Motors, their emulators, and time."""

    def __init__(self, **changes: object) -> None:
        self.clock = Clock()
        config = motors_config(**changes)
        places = [
            (bus - 1, motor)
            for buses, ids in zip(config.bus, config.id, strict=True)
            for bus, motor in zip(buses, ids, strict=True)
        ]
        self.servos: list[ServoEmulator] = [
            MitEmulator(motor, config.model) if config.protocol == "mit" else MoteusEmulator(motor)
            for _, motor in places
        ]
        self.bus = BenchBus(dict(zip(places, self.servos, strict=True)), self.clock)
        self.motors = Motors(config, self.bus, 0.003, clock=self.clock)

    def tick(self, seconds: float = 0.005) -> None:
        self.clock.now += seconds
        for servo in self.servos:
            servo.step(self.clock.now)


def command(**fields: object) -> JointCommand:
    values = {name: np.zeros((4, 3)) for name in ("position", "velocity", "kp", "kd", "torque")}
    for name, value in fields.items():
        values[name] = np.broadcast_to(np.asarray(value, dtype=float), (4, 3)).copy()
    return JointCommand(**values)
