"""The paper's figures 4 to 7, the learning curve and the polar push map, on one page."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from math import cos, pi, sin
from typing import Any

import matplotlib as mpl
import numpy as np

from drivers.robot import JOINTS, LEGS, Array
from runtime.config import Config
from sim.scenario import Push, Scenario
from sim.terrain import HeightField
from sim.world import World
from training.checkpoint import Row
from training.contest import TRACE_COLUMNS, Contender, Contest, Trial, run_trial
from training.randomize import SENSORS, Conditions
from training.reference import Reference

mpl.use("Agg")
from matplotlib import pyplot as plt

PUSHES = (15.0, 30.0, 45.0)
"""N·s of Fig. 6."""
DIRECTIONS = 8
MAP_STEP, MAP_END = 10.0, 90.0
"""N·s: grid of the polar map."""


class Recorder:
    """Walks that are looked at tick by tick."""

    def __init__(self, config: Config) -> None:
        control = config.control
        self._config = config
        self._world = World(config.robot, control.rate_hz, control.gait.walking_height)
        self.rate_hz = control.rate_hz

    def record(self, who: Contender, conditions: Conditions, seconds: float) -> dict[str, Array]:
        """A trace by name, each (ticks, columns)."""
        rows: list[Array] = []
        run_trial(self._config, self._world, who.walker(self._config), Trial(conditions, seconds), rows)
        table = np.array(rows).reshape(-1, 64)
        return {name: table[:, columns] for name, columns in TRACE_COLUMNS.items()} | {
            "time": np.arange(len(table))[:, None] / self.rate_hz
        }

    def close(self) -> None:
        """Release the simulator."""
        self._world.close()


def figure_4(recorder: Recorder, contenders: Sequence[Contender], reference: Reference) -> Any:
    """Height, orientation, forward velocity and angular velocity on flat ground, against the reference."""
    figure, axes = plt.subplots(4, 1, figsize=(8, 9), sharex=True, layout="constrained")
    time = np.arange(len(reference.features)) / reference.rate_hz
    axes[0].plot(time, reference.features[:, 2], "k--", label="reference")
    axes[2].plot(time, reference.features[:, 3], "k--")
    axes[3].plot(time, reference.features[:, 16], "k--")
    for who in contenders:
        trace = recorder.record(who, Conditions(Scenario(noise=SENSORS), (0.8, 0.0, 0.0)), 5.0)
        axes[0].plot(trace["time"], trace["position"][:, 2], label=who.name)
        axes[1].plot(trace["time"], np.degrees(trace["rpy"][:, :2]), label=[f"{who.name} roll", f"{who.name} pitch"])
        axes[2].plot(trace["time"], trace["velocity"][:, 0])
        axes[3].plot(trace["time"], trace["angular_velocity"][:, 1])
    for axis, label in zip(axes, ("height, m", "roll, pitch, °", "vx, m/s", "pitch rate, rad/s"), strict=True):
        axis.set_ylabel(label)
    axes[0].legend(fontsize=7)
    axes[1].legend(fontsize=7)
    axes[3].set_xlabel("s")
    return figure


def figure_5(recorder: Recorder, who: Contender) -> Any:
    """Phase portrait of the front-left joints, and the wanted forces' magnitude through the gait."""
    trace = recorder.record(who, Conditions(Scenario(noise=SENSORS), (0.5, 0.0, 0.0)), 6.0)
    start = len(trace["time"]) // 3
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for joint, name in enumerate(JOINTS):
        axes[0].plot(trace["joint_position"][start:, joint], trace["joint_velocity"][start:, joint], lw=0.6, label=name)
    axes[0].set(xlabel="rad", ylabel="rad/s", title=f"{who.name}: joints of FL")
    axes[0].legend(fontsize=7)
    forces = np.linalg.norm(trace["grf"].reshape(-1, 4, 3), axis=2)
    window = slice(-round(1.2 * recorder.rate_hz), None)
    axes[1].plot(trace["time"][window], forces[window], label=list(LEGS))
    axes[1].set(xlabel="s", ylabel="N", title="wanted ground reaction forces")
    axes[1].legend(fontsize=7)
    return figure


def figure_6(recorder: Recorder, who: Contender) -> Any:
    """Roll and pitch after sideways pushes of 0.1 s."""
    figure, axes = plt.subplots(2, 1, figsize=(8, 4.6), sharex=True, layout="constrained")
    for impulse in PUSHES:
        push = Push(2.0, 0.1, (0.0, impulse / 0.1, 0.0))
        trace = recorder.record(who, Conditions(Scenario(noise=SENSORS, pushes=(push,)), (0.4, 0.0, 0.0)), 5.0)
        for axis, column in zip(axes, range(2), strict=True):
            axis.plot(trace["time"], np.degrees(trace["rpy"][:, column]), label=f"{impulse:g} N·s")
    for axis, label in zip(axes, ("roll, °", "pitch, °"), strict=True):
        axis.set_ylabel(label)
    axes[0].set_title(f"{who.name}: pushed sideways at 2 s")
    axes[0].legend(fontsize=7)
    axes[1].set_xlabel("s")
    return figure


def figure_7(recorder: Recorder, who: Contender) -> Any:
    """Torque, velocity and position of the front-left joints on ±5 cm."""
    ground = HeightField(0.05, 0.10, 3, extent=12.0)
    trace = recorder.record(who, Conditions(Scenario(noise=SENSORS, terrain=ground), (0.5, 0.0, 0.0)), 6.0)
    figure, axes = plt.subplots(3, 1, figsize=(8, 6), sharex=True, layout="constrained")
    names = ("joint_torque", "joint_velocity", "joint_position")
    for axis, name, label in zip(axes, names, ("N·m", "rad/s", "rad"), strict=True):
        axis.plot(trace["time"], trace[name][:, :3], lw=0.8, label=list(JOINTS))
        axis.set_ylabel(label)
    axes[0].set_title(f"{who.name}: joints of FL on ±5 cm")
    axes[0].legend(fontsize=7)
    axes[2].set_xlabel("s")
    return figure


def push_map(contest: Contest, contenders: Sequence[Contender]) -> Any:
    """Largest impulse survived from each side at two phases of the gait, in N·s."""
    figure, axis = plt.subplots(figsize=(4.6, 4.6), subplot_kw={"projection": "polar"}, layout="constrained")
    angles = [2 * pi * k / DIRECTIONS for k in range(DIRECTIONS)]
    for who in contenders:
        radii = [_largest(contest, who, angle) for angle in angles]
        axis.plot([*angles, angles[0]], [*radii, radii[0]], marker=".", label=who.name)
    axis.set_title("largest push survived, N·s (0.1 s, at 0.4 m/s)")
    axis.legend(fontsize=7)
    return figure


def _largest(contest: Contest, who: Contender, angle: float) -> float:
    low, high = 0, round(MAP_END / MAP_STEP)
    while high - low > 1:
        middle = (low + high) // 2
        force = middle * MAP_STEP / 0.1
        trials = [
            Trial(
                Conditions(
                    Scenario(
                        seed=1, noise=SENSORS, pushes=(Push(start, 0.1, (force * cos(angle), force * sin(angle), 0.0)),)
                    ),
                    (0.4, 0.0, 0.0),
                ),
                4.0,
            )
            for start in (2.0, 2.1)
        ]
        low, high = (low, middle) if any(one.fell for one in contest.play(who, trials)) else (middle, high)
    return low * MAP_STEP


def learning_curve(rows: Sequence[Row]) -> Any:
    """Return and survival over the iterations; each stage has its own reward and so its own panel."""
    stages = list(dict.fromkeys(row.stage for row in rows))
    figure, axes = plt.subplots(1, len(stages), figsize=(4.5 * len(stages), 3.4), layout="constrained", squeeze=False)
    for axis, stage in zip(axes[0], stages, strict=True):
        mine = [row for row in rows if row.stage == stage]
        numbers = [row.iteration for row in mine]
        axis.plot(numbers, [row.mean_return for row in mine], label="mean")
        axis.plot(numbers, [row.population_mean for row in mine], label="population")
        axis.plot(numbers, [row.population_best for row in mine], lw=0.6, label="best")
        axis.set(title=stage, xlabel="iteration", ylabel="return")
        other = axis.twinx()
        other.plot(numbers, [row.survival for row in mine], "k:", lw=0.8)
        other.set_ylim(0, 1.05)
        axis.legend(fontsize=7)
    return figure


def page(title: str, text: str, figures: dict[str, Any]) -> str:
    """One HTML file that needs no other; the figures are closed."""
    parts = [f"<pre>{html.escape(text)}</pre>"]
    for name, figure in figures.items():
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=110)
        plt.close(figure)
        data = base64.b64encode(buffer.getvalue()).decode()
        parts.append(f"<h2>{html.escape(name)}</h2><img alt='{html.escape(name)}' src='data:image/png;base64,{data}'>")
    style = "body{font-family:sans-serif;max-width:60rem;margin:2rem auto}img{max-width:100%}pre{overflow-x:auto}"
    head = f"<meta charset='utf-8'><title>{html.escape(title)}</title><style>{style}</style>"
    return f"<!doctype html><html><head>{head}</head><body><h1>{html.escape(title)}</h1>{''.join(parts)}</body></html>"
