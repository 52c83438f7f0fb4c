"""The episode D that the policy imitates: the teacher's states and forces, tick by tick (paper Section IV.A).

Two ways to record it, both imitable: the rigid body itself on ideal footholds (``make_reference``), or the teacher
walking the simulated robot (``training.mpc_controller``). Saved with the robot's name and its config's hash, so that
nobody imitates another robot's walk.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.robot import Array
from runtime.config import Config
from runtime.control.records import Records
from runtime.control.state import build_parameters, stand_angles
from training.contact_plan import foothold, plan_contacts, plan_path
from training.mpc import HORIZON, Horizon, MpcConfig, solve_mpc
from training.provenance import config_hash, versions
from training.reward import FEATURES, fill_features
from training.rigid_body import GRAVITY, STATES, P, R, RigidBody, V, W, advance, rigid_body, rotation_from_rpy

TICKS = 1000
ACCELERATION = 1.0
"""m/s²."""
SPEED = 0.8
"""m/s."""
SOLVE_EVERY = 0.01
"""s between two solutions of the teacher; a change of stance asks for one at once."""
CLOCK_LAG = 1e-9
"""Cycles by which the controller's clock starts before the cycle's begin."""
VERSION = 1
Commands = Callable[[float], Array]
"""Time, s → vx, vy, yaw rate (3,)."""


class ReferenceMismatch(ValueError):
    """A reference that does not fit this robot, this config or this episode."""


@dataclass(frozen=True, slots=True)
class Reference:
    """One episode as Table I sees it."""

    robot: str
    config: str
    """Hash of the config that it was made for (``training.provenance``)."""
    source: str
    """``rigid-body`` or ``robot``."""
    rate_hz: float
    features: Array
    """Tick by tick, world frame (``training.reward.fill_features``); forces as shares of the weight. Shape (n, 30)."""
    commands: Array
    """vx, vy, yaw rate of every tick. Shape (n, 3)."""

    @property
    def duration(self) -> float:
        """s."""
        return len(self.features) / self.rate_hz

    def index_at(self, time: float) -> int:
        """The tick that is on at ``time``, s; the last one holds for ever after."""
        return min(max(int(time * self.rate_hz + 1e-6), 0), len(self.features) - 1)

    def resampled(self, rate_hz: float, ticks: int) -> tuple[Array, Array]:
        """Features (ticks, 30) and commands (ticks, 3) as a controller of another rate meets them.

        Raises:
            ReferenceMismatch: the reference is shorter than ``ticks`` at ``rate_hz``.
        """
        if ticks / rate_hz > self.duration + 1e-9:
            raise ReferenceMismatch(
                f"reference lasts {self.duration:g} s, the episode {ticks / rate_hz:g} s: "
                f"ask for at most {int(self.duration * rate_hz)} ticks or make a longer reference"
            )
        index = [self.index_at(tick / rate_hz) for tick in range(ticks)]
        return np.ascontiguousarray(self.features[index]), np.ascontiguousarray(self.commands[index])


def ramp(time: float) -> Array:
    """The paper's command: forward, 1 m/s² until 0.8 m/s."""
    return np.array([min(ACCELERATION * time, SPEED), 0.0, 0.0])


def make_reference(
    config: Config, mpc: MpcConfig | None = None, commands: Commands = ramp, ticks: int = TICKS
) -> Reference:
    """Let the teacher walk the rigid body over ideal footholds for ``ticks`` ticks of the robot's own rate."""
    walk = RigidBodyWalk(config, mpc or MpcConfig(), commands)
    features = np.empty((ticks, FEATURES))
    asked = np.empty((ticks, 3))
    for tick in range(ticks):
        asked[tick] = commands(tick * walk.dt)
        walk.step(tick, features[tick])
    return Reference(config.robot.name, config_hash(config), "rigid-body", config.control.rate_hz, features, asked)


class RigidBodyWalk:
    """The teacher, one rigid body and a clock."""

    def __init__(self, config: Config, mpc: MpcConfig, commands: Commands) -> None:
        description, control = config.robot, config.control
        height = control.gait.walking_height
        self.body: RigidBody = rigid_body(description, stand_angles(description, height))
        self.dt = 1.0 / control.rate_hz
        self._mpc, self._commands = mpc, commands
        self._parameters: Records = build_parameters(description, control)
        self._every = max(1, round(SOLVE_EVERY / self.dt))
        self._wanted = np.array([0.0, 0.0, height])
        self._yaw = 0.0
        self.state = np.zeros(STATES)
        self.state[P:V] = self._wanted + self.body.com
        self._stance = np.ones(4, dtype=np.bool_)
        self._feet = np.zeros((4, 3))
        self._feet[:, :2] = self._parameters[0]["nominal_footholds"]
        self._forces = np.zeros((4, 3))

    def step(self, tick: int, features: Array) -> None:
        """Write the tick's state and forces into ``features`` (30,), then move on by one tick."""
        command = self._commands(tick * self.dt)
        changed = self._move_legs((tick + 1) * self.dt, command)
        if changed or tick % self._every == 0:
            self._forces = solve_mpc(self._look_ahead(tick), self.body, self._mpc)[0]
        self._describe(features)
        advance(self.state, self._forces, self._feet, self.body.mass, self.body.inertia, self.dt)
        middle = self._yaw + 0.5 * self.dt * command[2]
        c, s = math.cos(middle), math.sin(middle)
        self._wanted[0] += self.dt * (c * command[0] - s * command[1])
        self._wanted[1] += self.dt * (s * command[0] + c * command[1])
        self._yaw += self.dt * command[2]

    def _move_legs(self, time: float, command: Array) -> bool:
        """Lift and plant feet by the gait's clock, as the controller's own does; whether any leg changed."""
        p = self._parameters[0]
        stance = (time / p["cycle_time"] - CLOCK_LAG + p["gait_offset"]) % 1.0 >= p["swing_fraction"]
        for leg in np.flatnonzero(stance & ~self._stance):
            foothold(self.state, self.state[R + 2], command, self._touchdown(command)[leg], 0.0, self._feet[leg])
        changed = bool((stance != self._stance).any())
        self._stance = stance
        return changed

    def _touchdown(self, command: Array) -> Array:
        """Eq. 1 without shifts, from the centre of mass: half a stance ahead of the nominal foothold. Shape (4, 2)."""
        p = self._parameters[0]
        nominal = p["nominal_footholds"] - self.body.com[:2]
        velocity = command[:2] + command[2] * np.stack([-nominal[:, 1], nominal[:, 0]], axis=1)
        return np.asarray(nominal + 0.5 * p["stance_time"] * velocity)

    def _look_ahead(self, tick: int) -> Horizon:
        dt, now = self._mpc.dt, tick * self.dt
        commands = np.array([self._commands(now + (k + 0.5) * dt) for k in range(HORIZON)])
        path, expected, feet = np.empty((HORIZON, STATES)), np.empty((HORIZON, 3)), np.empty((HORIZON, 4, 3))
        stance = np.empty((HORIZON, 4), dtype=np.bool_)
        plan_path(self._wanted, self._yaw, commands, self.body.com, dt, path, self.state, expected)
        p = self._parameters[0]
        clock = ((tick + 1) * self.dt / p["cycle_time"] - CLOCK_LAG) % 1.0
        plan_contacts(
            p, clock, self._stance, self._feet, self._touchdown(commands[0]), self.state, self.state[R + 2],
            commands[0], dt, feet, stance,
        )  # fmt: skip
        return Horizon(self.state.copy(), path, expected, feet, stance)

    def _describe(self, features: Array) -> None:
        """Of the body origin, as the simulator tells of the robot, not of the centre of mass."""
        rotation = np.empty((3, 3))
        rotation_from_rpy(self.state[R:W], rotation)
        arm = rotation @ -self.body.com
        omega = self.state[W:]
        fill_features(
            self.state[P:V] + arm, self.state[V:R] + np.cross(omega, arm), rotation, omega, self._forces,
            self.body.mass * GRAVITY, features,
        )  # fmt: skip


def save_reference(reference: Reference, path: Path) -> None:
    """Write the file whole or not at all.

    Raises:
        OSError: the disk is full or the folder is not writable; an older file stays as it was.
    """
    head = {
        "version": VERSION, "robot": reference.robot, "config": reference.config, "source": reference.source,
        "rate_hz": reference.rate_hz, "versions": versions(),
    }  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez_compressed(
                file, head=np.array(json.dumps(head)), features=reference.features, commands=reference.commands
            )
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def load_reference(path: Path, config: Config) -> Reference:
    """Read a reference and hold it against the robot that is to imitate it.

    Raises:
        ReferenceMismatch: not a reference, or of another version, robot or config.
        OSError: not readable.
    """
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            head: dict[str, Any] = json.loads(str(file["head"]))
            features, commands = file["features"], file["commands"]
    except (ValueError, KeyError, zipfile.BadZipFile, EOFError) as error:
        raise ReferenceMismatch(f"{path}: not a reference episode ({error})") from error
    wanted = {"version": VERSION, "robot": config.robot.name, "config": config_hash(config)}
    for key, value in wanted.items():
        if head.get(key) != value:
            raise ReferenceMismatch(f"{path}: {key} = {head.get(key)!r}, this run needs {value!r}: make it anew")
    if features.shape != (len(commands), FEATURES) or not (np.isfinite(features).all() and np.isfinite(commands).all()):
        raise ReferenceMismatch(f"{path}: features of shape {features.shape} or not finite")
    return Reference(head["robot"], head["config"], head["source"], float(head["rate_hz"]), features, commands)
