"""What a cycle remembers from tick to tick, as one record: with it a replay can begin in the middle."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drivers.robot import JointCommand
from runtime.control.posture import POSTURE_DTYPE
from runtime.control.records import Records, VelocityCommand
from runtime.control.state import STATE_DTYPE
from runtime.messages.mode import Mode
from runtime.messages.tick import TUNED
from runtime.modes import ModeState
from runtime.reasons import Reason
from runtime.sources import COMMAND_FIELDS
from runtime.verdict import MEMORY_DTYPE

if TYPE_CHECKING:
    from runtime.cycle import Cycle

KEYFRAME_DTYPE = np.dtype(
    [
        ("index", "u8"),  # of the tick at whose end it was taken
        ("control", STATE_DTYPE),
        ("posture", POSTURE_DTYPE),
        ("guard", MEMORY_DTYPE),
        ("command", "f8", (5, 4, 3)),
        ("blend_from", "f8", (5, 4, 3)),
        ("blend_left", "f8"),
        ("fall_left", "f8"),
        ("velocity", "f8", (3,)),
        ("velocity_stamp", "f8"),
        ("mode", "u1"),
        ("armed", "u1"),
        ("reason", "u2"),
        ("fault", "u2"),
        ("verdict", "u2"),
    ],
    align=True,
)


def remember(cycle: Cycle) -> Records:
    """All that the next tick depends on beside this tick's record. Shape (1,) of ``KEYFRAME_DTYPE``."""
    keyframe = np.zeros(1, KEYFRAME_DTYPE)
    k, state, sources = keyframe[0], cycle.state, cycle.sources
    k["index"], k["control"], k["guard"] = cycle.tick[0]["index"], cycle.controller.state[0], cycle.guard.memory[0]
    for key, command in (("command", sources.command), ("blend_from", sources.blend_from)):
        for row, name in enumerate(COMMAND_FIELDS):
            k[key][row] = getattr(command, name)
    k["blend_left"], k["fall_left"] = sources.blend_left, sources.fall_left
    k["velocity"][:2], k["velocity"][2] = sources.velocity.linear, sources.velocity.yaw_rate
    k["velocity_stamp"] = sources.velocity.stamp
    k["mode"], k["armed"], k["reason"] = int(state.mode), state.armed, int(state.reason)
    k["fault"], k["verdict"] = int(state.fault), int(cycle.verdict)
    sources.posture.remember(k["posture"])
    return keyframe


def recall(cycle: Cycle, keyframe: Records, tick: Records) -> None:
    """Be as after the tick ``tick`` (1,), at whose end ``keyframe`` (1,) was remembered."""
    k, sources = keyframe[0], cycle.sources
    cycle.tick[:] = tick
    cycle.controller.state[:] = keyframe["control"]
    cycle.guard.memory[:] = keyframe["guard"]
    sources.command = JointCommand(*k["command"].copy())
    sources.blend_from = JointCommand(*k["blend_from"].copy())
    sources.blend_left, sources.fall_left = float(k["blend_left"]), float(k["fall_left"])
    velocity = k["velocity"].copy()
    sources.velocity = VelocityCommand(float(k["velocity_stamp"]), velocity[:2], float(velocity[2]))
    cycle.state = ModeState(Mode(int(k["mode"])), bool(k["armed"]), Reason(int(k["reason"])), Reason(int(k["fault"])))
    cycle.verdict = Reason(int(k["verdict"]))
    cycle.generation, cycle.outgoing = int(tick["policy"][0]), int(tick["outgoing"][0])
    cycle.tune(cycle.tick.view(np.float64)[TUNED])
    sources.posture.recall(k["posture"])
