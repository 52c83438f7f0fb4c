"""How long a simulated second takes when nothing waits for the clock."""

from __future__ import annotations

import time
from collections.abc import Iterator

from trotd.bench.report import Figure, Finding, shown
from trotd.bench.walk import record_walk

RATE, PHYSICS = 200.0, 1000.0


def measure(quick: bool) -> Iterator[Finding]:
    """A walk of some simulated seconds: controller and world, and each of them alone."""
    from sim.scenario import Scenario
    from sim.world import World

    walked = record_walk(50)
    known = walked.config
    world = World(known.robot, RATE, known.control.gait.walking_height, PHYSICS)
    controller = walked.controller()
    measured = world.reset(Scenario())
    controller.reset(measured)
    seconds = 3 if quick else 20
    in_world = in_control = 0.0
    for _ in shown(range(seconds), "simulated seconds", seconds):
        for _ in range(round(RATE)):
            first = time.perf_counter()
            command = controller.step(measured, walked.command)
            second = time.perf_counter()
            measured = world.step(command)
            in_world += time.perf_counter() - second
            in_control += second - first
    fallen = world.fallen()
    world.close()
    taken = in_world + in_control
    name = f"at {RATE:g} Hz control and {PHYSICS:g} Hz physics"
    yield Figure("sim", f"a simulated second takes, {name}", taken / seconds, "s")
    yield Figure("sim", "of which the controller", 100 * in_control / taken, "%")
    yield Figure("sim", "times real time", seconds / taken, "x", 5.0, ">=", "it fell" if fallen else "")
