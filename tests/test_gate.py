"""The explained gate: whatever the motors get otherwise than it was asked bears a named reason, and nothing else does.

Stage by stage, on walks that are pushed, heated, overdriven and driven by policies that ask for too much: what went in,
what came out, and the reasons in the record. The expected values come from numpy, not from the core.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scenes import rotation
from walks import Walk

from drivers.robot import JointCommand, Measurement
from runtime.control.kinematics import forward
from runtime.control.records import Clamp, SolverStatus, VelocityCommand
from runtime.messages.mode import Mode, Request

FIELDS = ("position", "velocity", "kp", "kd", "torque")
TORQUE = Clamp.TORQUE | Clamp.THERMAL | Clamp.CURRENT | Clamp.SOFT_START
VELOCITY = Clamp.EXPIRED | Clamp.SPEED | Clamp.STOPPING


class Gate:
    """A walk that is watched at every stage."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.walk = Walk(folder)
        self.random = np.random.default_rng(seed)
        self.celsius = 30.0
        self.seen = Clamp(0)
        self.sent: VelocityCommand | None = None
        self.followed: VelocityCommand | None = None
        self.raw: JointCommand | None = None
        cycle, real = self.walk.cycle, self.walk.world.step
        controller, posture = cycle.controller, cycle.sources.posture
        step, move = controller.step, posture.step

        def stepped(measurement: Measurement, command: VelocityCommand, standing: bool = False) -> JointCommand:
            self.shifts = controller.state["shifts"][0].ravel().copy()
            self.followed = command
            self.raw = step(measurement, command, standing)
            self.raw = JointCommand(*(getattr(self.raw, name).copy() for name in FIELDS))
            return JointCommand(*(getattr(self.raw, name).copy() for name in FIELDS))

        def moved() -> JointCommand:
            self.raw = move()
            return JointCommand(*(getattr(self.raw, name).copy() for name in FIELDS))

        def warm(command: JointCommand) -> Measurement:
            m = real(command)
            return replace(m, joints=replace(m.joints, temperature=np.full((4, 3), self.celsius)))

        controller.step, posture.step, self.walk.world.step = stepped, moved, warm  # type: ignore[method-assign]

    def run(self, seconds: float, velocity: tuple[float, float, float] | None = None) -> None:
        for _ in range(round(seconds * 200)):
            now = (self.walk.index + 1) / 200.0
            if velocity is not None:
                self.sent = VelocityCommand(now - 0.001, np.array(velocity[:2]), velocity[2])
            self.raw = self.followed = None
            self.walk.run(0.005, velocity)
            self.look()

    def look(self) -> None:
        tick = self.walk.cycle.tick[0]
        clamps = Clamp(int(tick["clamps"]))
        self.seen |= clamps
        mode = Mode(int(tick["mode"]))
        if mode is Mode.DAMP or self.raw is None:
            return
        self.look_at_the_motors(tick, clamps)
        if mode in (Mode.STAND, Mode.WALK):
            self.look_at_the_policy(tick, clamps)
            self.look_at_the_forces(tick, clamps)
            self.look_at_the_feet(tick, clamps)
        if mode is Mode.WALK:
            self.look_at_the_velocity(clamps)

    def look_at_the_motors(self, tick: Any, clamps: Clamp) -> None:
        assert self.raw is not None
        same = {name: np.array_equal(tick[f"command_{name}"], getattr(self.raw, name)) for name in FIELDS}
        assert all(same[name] for name in FIELDS[:4]) or clamps & Clamp.BLEND
        assert same["torque"] or clamps & (TORQUE | Clamp.BLEND)
        if all(same.values()):
            assert not clamps & (TORQUE | Clamp.BLEND), clamps
        foreseen = (
            self.raw.torque
            + self.raw.kp * (self.raw.position - tick["joint_position"])
            + self.raw.kd * (self.raw.velocity - tick["joint_velocity"])
        )
        if not clamps & Clamp.BLEND:
            beyond = np.abs(foreseen) > self.walk.cycle.guard.memory[0]["torque_bound"]
            assert bool(clamps & TORQUE) == bool(beyond.any())
            assert bool(clamps & Clamp.TORQUE) == bool((np.abs(foreseen)[beyond] > 40.0).any())

    def look_at_the_policy(self, tick: Any, clamps: Clamp) -> None:
        policy, bounds, dt = self.walk.cycle.policy, self.walk.config.control.bounds, 0.005
        smooth = self.shifts + (tick["asked"][:12] - self.shifts) * dt / (dt + policy.shift_time_constant)
        changed = np.abs(tick["action"][:12] - smooth) > 1e-12
        assert bool(clamps & Clamp.SHIFT) == bool(changed.any())
        changed = tick["action"][12:] != tick["asked"][12:]
        assert bool(clamps & Clamp.WRENCH) == bool(changed.any())
        assert np.abs(tick["action"][:12]).max() <= bounds.shift

    def look_at_the_forces(self, tick: Any, clamps: Clamp) -> None:
        stance = tick["stance"].astype(bool)
        assert bool(clamps & Clamp.FALLBACK) == (tick["solver_status"] == SolverStatus.LEAST_SQUARES)
        if not stance.any() or tick["solver_status"] != SolverStatus.SOLVED:
            return
        problem = self.walk.cycle.controller.problems[int(stance.sum())]
        free = np.linalg.solve(problem.hessian, -problem.gradient).reshape(-1, 3)
        change = np.abs(tick["grf"][stance] - free).max()
        assert change < 1e-3 or clamps & Clamp.FRICTION
        if clamps & Clamp.FRICTION:
            edge = problem.friction * free[:, 2] - np.abs(free[:, :2]).max(axis=1)
            inside = min(edge.min(), free[:, 2].min() - problem.min_force, problem.max_force - free[:, 2].max())
            assert change > 0.0 and inside < 1e-3

    def look_at_the_feet(self, tick: Any, clamps: Clamp) -> None:
        assert self.raw is not None
        to_heading = rotation((*tick["rpy"][:2], 0.0))
        reached = forward(self.walk.cycle.controller.geometry, self.raw.position) @ to_heading.T
        missed = np.abs(reached - tick["foot_targets"]).max()
        assert bool(clamps & (Clamp.REACH | Clamp.JOINT_LIMIT)) == bool(missed > 1e-6)

    def look_at_the_velocity(self, clamps: Clamp) -> None:
        if self.sent is None or self.followed is None:
            return
        same = np.array_equal(self.sent.linear, self.followed.linear) and self.sent.yaw_rate == self.followed.yaw_rate
        assert same or clamps & VELOCITY
        if same and self.walk.index / 200.0 - self.sent.stamp <= self.walk.config.command.expiry:
            assert not clamps & (Clamp.EXPIRED | Clamp.SPEED)
        asked = np.array([*self.followed.linear, self.followed.yaw_rate])
        bounds = self.walk.config.control.bounds
        assert bool(clamps & Clamp.COMMAND) == bool((np.abs(asked) > (*bounds.linear_velocity, bounds.yaw_rate)).any())

    def stand(self) -> None:
        self.run(1.2)
        self.walk.ask(Request.ARM, Request.STAND)
        while self.walk.cycle.state.mode is not Mode.STAND:
            self.run(0.1)

    def overdrive(self, factor: float) -> None:
        """A policy that asks for ``factor`` times as much."""
        policy = self.walk.policy
        self.walk.cycle.swap_policy(
            msgspec.structs.replace(policy, matrix=tuple(tuple(factor * v for v in row) for row in policy.matrix))
        )


@pytest.mark.parametrize("seed", range(3))
def test_every_change_is_named_and_every_name_is_a_change(tmp_path: Path, seed: int) -> None:
    gate = Gate(tmp_path, seed)
    random = gate.random
    gate.stand()
    gate.run(0.3)
    gate.walk.ask(Request.WALK)
    gate.run(0.4, (0.4, 0.0, 0.0))
    gate.run(0.3)
    gate.run(0.1, (2.5, 0.0, 0.0))
    gate.run(0.2, (0.2, 0.0, 0.0))
    gate.celsius = 76.0
    gate.run(0.3, (0.4, 0.0, 0.2))
    for _ in range(4):
        velocity = tuple(random.uniform((-0.4, -0.3, -0.8), (0.8, 0.3, 0.8)))
        gate.celsius = float(random.uniform(25.0, 76.0))
        push = random.uniform(-120.0, 120.0, 3) * (1.0, 1.0, 0.0)
        gate.walk.world.push(tuple(push.tolist()), 0.1)
        gate.run(0.7, velocity)  # type: ignore[arg-type]
    gate.overdrive(float(random.uniform(6.0, 12.0)))
    gate.run(0.4, (0.2, 0.0, 0.0))
    expected = Clamp.FRICTION | Clamp.BLEND | Clamp.EXPIRED | Clamp.COMMAND | Clamp.SPEED
    assert gate.seen & expected == expected
    assert gate.seen & TORQUE and gate.seen & (Clamp.WRENCH | Clamp.SHIFT)
    total = sum(gate.walk.cycle.clamps)
    assert total > 0 and gate.walk.cycle.clamps[list(Clamp).index(Clamp.FRICTION)] > 0, "and they are counted"
    gate.walk.world.close()
