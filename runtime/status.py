"""The daemon's state for people, put together from what the rooms know."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from drivers.robot import Array
from runtime.control.records import Clamp, SolverStatus
from runtime.cycle import Cycle
from runtime.messages.status import Status
from runtime.reasons import Reason
from runtime.shelf import PolicyFile


def build_status(
    cycle: Cycle,
    active: PolicyFile,
    compute: Array,
    refused: Mapping[str, int],
    unwritten: Mapping[str, int],
    wires: Mapping[str, int],
) -> Status:
    """Everything that people want to see; ``compute`` holds the last ticks' times (n,), n >= 1, s."""
    tick, current, config = cycle.tick[0], cycle.state, cycle.config
    p50, p99 = np.percentile(compute, (50, 99))
    return Status(
        robot=config.robot.name,
        mode=current.mode.name,
        armed=current.armed,
        fault="" if current.fault is Reason.OK else current.fault.words,
        evidence=cycle.evidence,
        health=cycle.health,
        reason=current.reason.words,
        policy=f"{active.policy.name} {active.sha256[:12]}",
        rate_hz=config.control.rate_hz,
        ticks=int(tick["index"]),
        overruns=int(tick["overruns"]),
        velocity_command=_triple(tick["asked_velocity"]),
        velocity=_triple(tick["twist"][[0, 1, 5]]),
        height=float(tick["height"]),
        rpy=_triple(tick["rpy"]),
        voltage=float(tick["voltage"]),
        max_temperature=float(tick["joint_temperature"].max()),
        speed_share=cycle.guard.speed_share,
        torque_share=cycle.guard.torque_share,
        tick_p50=float(p50),
        tick_p99=float(p99),
        clamps={str(clamp.name): int(n) for clamp, n in zip(Clamp, cycle.clamps, strict=True) if n},
        solver={status.name: int(n) for status, n in zip(SolverStatus, cycle.solver, strict=True) if n},
        recordings_refused=dict(unwritten),
        refused=dict(refused),
        wires=dict(wires),
    )


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
