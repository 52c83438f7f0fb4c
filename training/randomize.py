"""A generator in, an episode's conditions out (paper Section IV.C, and past it)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, pi, sin

import numpy as np

from drivers.robot import Array
from sim.scenario import Noise, Push, Scenario
from sim.terrain import HeightField, Plane, Slope, Terrain

Range = tuple[float, float]

SENSORS = Noise(
    joint_position=0.001, joint_velocity=0.1, joint_torque=0.5, orientation=0.003, angular_velocity=0.02,
    linear_acceleration=0.2, joint_position_bias=0.005, joint_torque_bias=0.5, orientation_bias=0.005,
    angular_velocity_bias=0.005, linear_acceleration_bias=0.05,
)  # fmt: skip
"""What the sensors of such a robot do: encoders and current sensing of servo drives, an MTi-class inertial unit."""


@dataclass(frozen=True, slots=True)
class Conditions:
    """One episode's world, and what is asked of the robot in it."""

    scenario: Scenario
    command: tuple[float, float, float] | None = None
    """vx, vy m/s and yaw rate rad/s of the whole episode; None follows the reference's."""
    standing: bool = False
    """All four feet stay down, as in the mode of that name."""


@dataclass(frozen=True, slots=True)
class Randomization:
    """Bounds of uniform draws. The defaults draw nothing: the nominal episode."""

    tilt: float = 0.0
    """Roll, pitch and yaw at the start lie in ± this, rad; the paper's is π/6 and one-sided."""
    friction: Range = (1.0, 1.0)
    noise: bool = False
    """Sensors err as ``SENSORS`` says."""
    bump: float = 0.0
    """Largest height field's amplitude, m."""
    bump_spacing: Range = (0.1, 0.25)
    """Of its lattice, m."""
    slope: float = 0.0
    """Steepest slope, rad, any direction."""
    level_share: float = 0.0
    """Share of the episodes on level ground all the same."""
    push_probability: float = 0.0
    push_impulse: Range = (0.0, 0.0)
    """N·s, any horizontal direction, in 0.1 s."""
    push_time: Range = (0.5, 1.5)
    """s from the start."""
    payload: Range = (0.0, 0.0)
    """kg."""
    motor_strength: Range = (1.0, 1.0)
    weak_share: float = 1.0
    """Share of the episodes whose motors' strength is drawn; the others' is whole."""
    weak_push: float = 1.0
    """A push of those with weak motors is this share of what was drawn."""
    extra_delay: Range = (0.0, 0.0)
    """s."""
    velocity_x: Range | None = None
    """m/s; None for no command of its own: the reference's is followed."""
    velocity_y: float = 0.0
    """± m/s."""
    yaw_rate: float = 0.0
    """± rad/s."""
    zeroed_axes: float = 0.0
    """Probability with which each axis of the command is zero."""
    standing_share: float = 0.0
    """Share of the episodes in which it stands; a push of those is ``STANDING_PUSH`` of what was drawn."""


STANDING_PUSH = 0.4
"""Four feet that may not step hold so much of a push that a walk takes."""
NOMINAL = Randomization()
PAPER = Randomization(tilt=pi / 6, friction=(0.8, 1.2))
"""Section IV.C, with the mirrored signs."""
NOISY = Randomization(friction=(0.8, 1.2), noise=True)
"""What a first imitation can climb from nothing."""
IMITATION = Randomization(tilt=0.2, friction=(0.8, 1.2), noise=True)
TASK = Randomization(
    tilt=0.2, friction=(0.6, 1.2), noise=True, push_probability=0.8, push_impulse=(10.0, 45.0), push_time=(0.6, 1.6),
    velocity_x=(-0.6, 1.6), velocity_y=0.4, yaw_rate=1.0, zeroed_axes=0.25,
)  # fmt: skip
"""The second stage, from the method's page."""
WIDE = replace(TASK, push_impulse=(10.0, 50.0), standing_share=0.12, weak_share=0.25, motor_strength=(0.42, 1.0))
"""The task, standing, and motors that give less than they should."""
WEAK = replace(
    TASK,
    friction=(0.5, 1.2),
    push_impulse=(10.0, 57.0),
    standing_share=0.06,
    weak_share=0.2,
    motor_strength=(0.42, 0.6),
)
"""The task, standing, and motors at half their strength: what a hard torque clip leaves."""
HARD = replace(WEAK, friction=(0.3, 1.2), push_impulse=(20.0, 65.0), weak_share=0.4, weak_push=0.2)
"""More of that, pushes that few withstand, and ground as smooth as the table's smoothest.
Weak motors hold no such push, whatever the policy: without most of it they teach how to walk by half the torque."""
ROUGH = Randomization(
    tilt=0.2, friction=(0.6, 1.2), noise=True, push_probability=0.4, push_impulse=(10.0, 35.0), push_time=(0.6, 2.5),
    bump=0.1, bump_spacing=(0.1, 0.2), slope=0.2, level_share=0.15,
    velocity_x=(-0.3, 1.0), velocity_y=0.3, yaw_rate=0.8, zeroed_axes=0.25, standing_share=0.1,
)  # fmt: skip
"""Fine-tuning on height fields, beyond the paper's ±5 cm: up to ±10 cm within 10 to 20."""
SETS = {
    "nominal": NOMINAL,
    "paper": PAPER,
    "noisy": NOISY,
    "imitation": IMITATION,
    "task": TASK,
    "wide": WIDE,
    "weak": WEAK,
    "hard": HARD,
    "rough": ROUGH,
}


def draw(bounds: Randomization, rng: np.random.Generator) -> Conditions:
    """One episode's conditions. The same generator state gives the same ones, on any machine."""
    scenario = Scenario(
        seed=int(rng.integers(2**31)),
        rpy=(_signed(rng, bounds.tilt), _signed(rng, bounds.tilt), _signed(rng, bounds.tilt)),
        friction=_within(rng, bounds.friction),
        terrain=_draw_terrain(bounds, rng),
        pushes=_draw_pushes(bounds, rng),
        payload=_within(rng, bounds.payload),
        motor_strength=_within(rng, bounds.motor_strength),
        extra_delay=_within(rng, bounds.extra_delay),
        noise=SENSORS if bounds.noise else Noise(),
    )
    command = _draw_command(bounds, rng)
    if bounds.weak_share < 1.0 and rng.random() >= bounds.weak_share:
        scenario = replace(scenario, motor_strength=1.0)
    elif bounds.weak_push < 1.0:
        scenario = _softened(scenario, bounds.weak_push)
    if bounds.standing_share > 0.0 and rng.random() < bounds.standing_share:
        return Conditions(_softened(scenario, STANDING_PUSH), (0.0, 0.0, 0.0), standing=True)
    return Conditions(scenario, command)


def _softened(scenario: Scenario, share: float) -> Scenario:
    """The same with pushes of ``share`` of their force."""
    return replace(scenario, pushes=tuple(_scaled(push, share) for push in scenario.pushes))


def _scaled(push: Push, share: float) -> Push:
    x, y, z = (share * axis for axis in push.force)
    return replace(push, force=(x, y, z))


def _draw_terrain(bounds: Randomization, rng: np.random.Generator) -> Terrain:
    kind, size = rng.random(2)
    direction, seed = rng.uniform(-pi, pi), int(rng.integers(2**31))
    spacing = _within(rng, bounds.bump_spacing)
    if (bounds.bump == 0.0 and bounds.slope == 0.0) or kind < bounds.level_share:
        return Plane()
    share_of_slopes = 0.25 if bounds.bump and bounds.slope else float(bounds.slope > 0.0)
    if kind < bounds.level_share + (1.0 - bounds.level_share) * share_of_slopes:
        return Slope(bounds.slope * float(size), direction)
    return HeightField(bounds.bump * float(size), round(spacing, 2), seed, extent=8.0)


def _draw_pushes(bounds: Randomization, rng: np.random.Generator) -> tuple[Push, ...]:
    happens, direction = rng.random(), rng.uniform(-pi, pi)
    impulse, start = _within(rng, bounds.push_impulse), _within(rng, bounds.push_time)
    if happens >= bounds.push_probability:
        return ()
    force = impulse / 0.1
    return (Push(start, 0.1, (force * cos(direction), force * sin(direction), 0.0)),)


def _draw_command(bounds: Randomization, rng: np.random.Generator) -> tuple[float, float, float] | None:
    if bounds.velocity_x is None:
        return None
    wanted: Array = np.array(
        [_within(rng, bounds.velocity_x), _signed(rng, bounds.velocity_y), _signed(rng, bounds.yaw_rate)]
    )
    wanted[rng.random(3) < bounds.zeroed_axes] = 0.0
    return float(wanted[0]), float(wanted[1]), float(wanted[2])


def _within(rng: np.random.Generator, bounds: Range) -> float:
    return float(rng.uniform(*bounds))


def _signed(rng: np.random.Generator, bound: float) -> float:
    return float(rng.uniform(-bound, bound))
