"""What the robot believes of itself over emulated wires, against the world's truth: contacts, speed, height.

Lock-step on the wire twin with the noise, bias, quantisation and latency of real sensors, so the figures are the same
on every computer.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.robot import Array
from runtime.messages.mode import Request
from trotd.bench.report import Figure, Finding, shown

Contacts = NDArray[np.bool_]
"""One truth value a leg. Shape (4,)."""
SPEED = (0.8, 0.0, 0.0)
"""m/s, m/s, rad/s."""
SETTLE = 1.5
"""s of walking before anything counts."""
AIRBORNE = 0.03
"""s in the air after which a touchdown is one."""


@dataclass
class Watch:
    """What was felt and what was so: by tick, and for the ground under each foot by step of the world."""

    felt: list[Contacts] = field(default_factory=list)
    so: list[Contacts] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    steps: list[tuple[float, Contacts]] = field(default_factory=list)
    velocity: list[Array] = field(default_factory=list)
    """Of the estimate less the truth, vx and vy, m/s."""
    height: list[float] = field(default_factory=list)

    @property
    def false_positives(self) -> float:
        """Share of the time in the air that was felt as ground."""
        felt, so = np.array(self.felt), np.array(self.so)
        return float((felt & ~so).sum() / (~so).sum())

    @property
    def false_negatives(self) -> float:
        """Share of the time on the ground that was felt as air."""
        felt, so = np.array(self.felt), np.array(self.so)
        return float((~felt & so).sum() / so.sum())

    @property
    def latencies(self) -> Array:
        """From each touchdown to the tick that felt it, s; those never felt are as long as the stance."""
        moments, ground = np.array([time for time, _ in self.steps]), np.array([row for _, row in self.steps])
        ticks, felt = np.array(self.times), np.array(self.felt)
        found: list[float] = []
        for leg in range(4):
            lifted = -np.inf
            for k in range(1, len(moments)):
                if ground[k - 1, leg] and not ground[k, leg]:
                    lifted = moments[k]
                if ground[k, leg] and not ground[k - 1, leg] and moments[k] - lifted > AIRBORNE:
                    later = ticks[(ticks >= moments[k] - 1e-9) & felt[:, leg]]
                    if len(later):
                        found.append(float(later[0] - moments[k]))
        return np.array(found)


def watch_walk(seconds: float) -> Watch:
    """Stoch3 on the twin at ``SPEED`` for ``seconds`` that count.

    Raises:
        RuntimeError: it did not stand up, or not walk to the end.
    """
    from trotd.lockstep import TwinWalk

    walk, seen = TwinWalk(), Watch()
    walk.stand()
    walk.ask(Request.WALK)
    walk.run(SETTLE, SPEED)
    walk.after_step = lambda: seen.steps.append((walk.now, walk.world.truth.foot_contacts.copy()))
    for _ in shown(range(round(seconds * walk.config.control.rate_hz)), "walking", round(seconds * 200)):
        truth, velocity, now = walk.world.truth, walk.velocity, walk.now
        walk.tick(SPEED)
        tick = walk.cycle.tick[0]
        seen.felt.append(tick["contacts"].astype(bool))
        seen.so.append(truth.foot_contacts.copy())
        seen.times.append(now)
        seen.velocity.append(tick["twist"][:2] - velocity[:2])
        seen.height.append(float(tick["height"] - truth.position[2]))
    if walk.faults:
        raise RuntimeError(walk.faults[0])
    walk.world.close()
    return seen


def measure(quick: bool) -> Iterator[Finding]:
    """The figures of a noisy walk at 0.8 m/s and 200 Hz."""
    seen = watch_walk(4.0 if quick else 20.0)
    latencies = 1e3 * seen.latencies
    yield Figure("senses", "contact felt in the air", 100 * seen.false_positives, "%", 3.0)
    yield Figure("senses", "contact not felt on the ground", 100 * seen.false_negatives, "%", 3.0)
    yield Figure("senses", "touchdown to the tick that feels it, median", float(np.median(latencies)), "ms", 10.0)
    yield Figure("senses", "of which the slowest twentieth beyond", float(np.percentile(latencies, 95)), "ms")
    velocity = np.sqrt(np.square(seen.velocity).mean(axis=0)).max()
    yield Figure("senses", "velocity, rms error", float(velocity), "m/s", 0.05, note=f"walking at {SPEED[0]} m/s")
    yield Figure("senses", "height, rms error", 1e3 * float(np.sqrt(np.square(seen.height).mean())), "mm", 10.0)
