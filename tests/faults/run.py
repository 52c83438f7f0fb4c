"""Running the matrix: one robot is led to where the faults begin, and a process is forked off it for each of them.

A fault is named by body, gait, row and seed; the seed says which robot (noise), when, and what numbers. Forked or
alone, the same name gives the same bits.
"""

from __future__ import annotations

import contextlib
import gc
import os
import select
import signal
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from zlib import crc32

import msgspec
import numpy as np

from faults.matrix import BY_NAME
from faults.rig import Fault, Rig
from faults.watch import Outcome, Watch

GAITS = ("stand", "walk")
BODIES = ("sim", "wire")
BASES = 4
"""Robots that differ in their sensors' noise."""
WINDOW = 160
"""Ticks among which the one of the injection is drawn: two cycles of the gait."""
REST = 1.5
"""s that a damped robot is watched on its way to the ground."""
WIRE_REST = 0.3
"""The same over the wires, which are five times slower: the fall is the same as on the simulator."""
BRIEF, BRIEF_REST = 0.8, 0.2
"""The same in a brief case: of the fault, and of the damped robot, s."""
PATIENCE = 120.0
"""s that one fault may take before it is called hung."""


@dataclass(frozen=True, order=True)
class Case:
    """One fault's name."""

    body: str
    gait: str
    row: str
    seed: int
    brief: bool = False
    """Watched for no longer than it takes to see the robot's answer."""

    @property
    def base(self) -> int:
        return self.seed % BASES

    @property
    def trunk(self) -> tuple[str, str, int]:
        return self.body, self.gait, self.base

    def draw(self) -> tuple[int, np.random.Generator]:
        """When it is injected, and the rest of its dice."""
        dice = np.random.default_rng((crc32(self.row.encode()), self.seed))
        return int(dice.integers(WINDOW)), dice


def replay(case: Case) -> Outcome:
    """One fault alone."""
    rig = lead(case)
    tick, dice = case.draw()
    for _ in range(tick):
        rig.tick()
    return suffer(rig, case, dice)


def run_trunk(cases: Iterable[Case], tell: Callable[[Outcome], None]) -> None:
    """The faults of one robot: body, gait and base are the same for all ``cases``."""
    waiting = sorted(cases, key=lambda case: case.draw()[0])
    rig = lead(waiting[0])
    gc.collect()
    gc.freeze()
    tick = 0
    for case in waiting:
        at, dice = case.draw()
        while tick < at:
            rig.tick()
            tick += 1
        tell(_forked(rig, case, dice))


def lead(case: Case) -> Rig:
    """A robot where the window of injections begins."""
    rig = Rig(case.body, case.base)
    rig.stand()
    if case.gait == "walk":
        rig.walk_on()
    return rig


def suffer(rig: Rig, case: Case, dice: np.random.Generator) -> Outcome:
    """Inject, and look until nothing more can happen."""
    row = BY_NAME[case.row]
    fault = row.draw(case.body)(dice)
    outcome = Outcome(row=case.row, gait=case.gait, seed=case.seed, body=case.body, fault=repr(fault), violations=[])
    mode, watch = rig.mode, Watch(rig, outcome)
    try:
        rest = REST if case.body == "sim" else WIRE_REST
        _live(rig, watch, fault, *((BRIEF, BRIEF_REST) if case.brief else (row.seconds, rest)))
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        watch.violate(f"{type(error).__name__} in {place.name}: {error}")
    watch.judge()
    if not fault.happened():
        watch.violate("never happened")
    if row.must == "damp" and (outcome.answered is None or (row.within and outcome.answered > row.within)):
        watch.violate(f"damped in tick {outcome.answered}, bound {row.within}")
    if row.must == "stay" and (outcome.fell or rig.mode is not mode):
        watch.violate(f"{'fell' if outcome.fell else f'is in {rig.mode.name}'}: it must not mind")
    return outcome


def _live(rig: Rig, watch: Watch, fault: Fault, seconds: float, after: float) -> None:
    rig.inject(fault)
    limit, rest = round(seconds / rig.period), round(after / rig.period)
    while watch.ticks < limit and not watch.over:
        before = watch.outcome.answered
        rig.tick()
        watch.look()
        if before is None and watch.outcome.answered is not None:
            limit = watch.ticks + rest


def _forked(rig: Rig, case: Case, dice: np.random.Generator) -> Outcome:
    near, far = os.pipe()
    child = os.fork()
    if child == 0:
        code = 1
        with contextlib.suppress(BaseException):
            os.close(near)
            with os.fdopen(far, "wb") as pipe:
                pipe.write(msgspec.json.encode(suffer(rig, case, dice)))
            code = 0
        os._exit(code)
    os.close(far)
    with os.fdopen(near, "rb") as pipe:
        data = _all(pipe.fileno(), time.monotonic() + PATIENCE)
    if data is None:
        os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    if data:
        return msgspec.json.decode(data, type=Outcome)
    words = "hung" if data is None else "the process died"
    return Outcome(row=case.row, gait=case.gait, seed=case.seed, body=case.body, fault="", violations=[words])


def _all(fd: int, end: float) -> bytes | None:
    """Everything from ``fd`` to its end; None where that does not come in time."""
    data = b""
    while True:
        ready, _, _ = select.select([fd], [], [], max(0.0, end - time.monotonic()))
        if not ready:
            return None
        part = os.read(fd, 65536)
        if not part:
            return data
        data += part


def trunks(cases: Iterable[Case], largest: int = 60) -> Iterator[list[Case]]:
    """``cases`` by their robot, in portions that a worker takes at a time."""
    by_trunk: dict[tuple[str, str, int], list[Case]] = {}
    for case in cases:
        by_trunk.setdefault(case.trunk, []).append(case)
    for members in by_trunk.values():
        for first in range(0, len(members), largest):
            yield members[first : first + largest]
