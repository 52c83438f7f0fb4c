"""The compiled core against the plain numpy form of the same pipeline: every field, every tick, to 1e-9."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import pytest
from plain import PlainController
from scenes import ROBOTS, control, controller, measurement, policy, robot, rotation, standing, variant

from drivers.robot import Measurement
from runtime.control.policy import GRF_NAMES, SHIFT_NAMES, Policy, Terms
from runtime.control.records import Clamp, SolverStatus, VelocityCommand

TICKS = 240
GAITS = ("trot", "walk", "pace", "bound", "pronk", "stand")
COMMANDS = ((0.0, 0.0, 0.0), (0.6, 0.0, 0.0), (0.0, -0.3, 0.0), (0.5, 0.2, 0.5), (-3.0, 0.0, -2.0), (0.0, 0.0, 0.8))


def ask(index: int, ticks: int) -> tuple[VelocityCommand, bool]:
    """The command of a tick: each in turn, and standing at the end of the run."""
    x, y, turn = COMMANDS[index * len(COMMANDS) // ticks]
    return VelocityCommand(0.0, np.array([x, y]), turn), index % 97 < 5 or index > 0.9 * ticks


FORCES = ("grf", "contact_force", "target_wrench", "command_torque")
"""In hundreds of N or N·m."""


def close(found: Any, wanted: Any, bound: float, what: str, tick: int) -> None:
    error = np.abs(found - wanted).max()
    assert error <= bound + 1e-9 * np.abs(wanted).max(), f"{what} at tick {tick}: {found} for {wanted}"


def assert_agree(name: str, chosen: Policy, measurements: Sequence[Measurement], **changes: Any) -> Clamp:
    """Run both; returns every clamp that acted."""
    compiled = controller(name, chosen, **changes)
    plain = PlainController(robot(name).robot, control(name, **changes), chosen)
    compiled.reset(measurements[0])
    plain.reset(measurements[0])
    clamps = Clamp(0)
    for index, measured in enumerate(measurements):
        command, still = ask(index, len(measurements))
        ours, theirs = compiled.step(measured, command, still), plain.step(measured, command, still)
        for field in compiled.record.dtype.names or ():
            close(compiled.record[field][0], plain.record[field], 1e-7 if field in FORCES else 1e-9, field, index)
        for part in ("position", "velocity", "kp", "kd", "torque"):
            close(getattr(ours, part), getattr(theirs, part), 1e-7, part, index)
        clamps |= Clamp(int(compiled.record["clamps"][0]))
    return clamps


@cache
def walked(name: str = "stoch3", gait: str = "trot") -> tuple[Measurement, ...]:
    """A closed-loop walk in the simulator through all commands, with noise and a push."""
    pytest.importorskip("pybullet")
    from sim.scenario import Noise, Push, Scenario
    from sim.world import World

    config = control(name, gait={"name": gait})
    noise = Noise(joint_position=1e-3, joint_velocity=0.1, joint_torque=0.3, orientation=2e-3, linear_acceleration=0.2)
    size = robot(name).robot.mass / 25.0
    world = World(robot(name).robot, config.rate_hz, config.gait.walking_height)
    measured = world.reset(Scenario(seed=5, noise=noise, pushes=(Push(0.6, 0.1, (0.0, 150.0 * size, 0.0)),)))
    pilot, measurements = controller(name, gait={"name": gait}), []
    pilot.reset(measured)
    for index in range(TICKS):
        measurements.append(measured)
        measured = world.step(pilot.step(measured, *ask(index, TICKS)))
    world.close()
    return tuple(measurements)


def random_measurements(name: str, seed: int, count: int = 72) -> list[Measurement]:
    """Nothing that a robot would do: every tick unrelated to the last."""
    rng, known = np.random.default_rng(seed), robot(name).robot
    lower, upper = np.array(known.joints.lower), np.array(known.joints.upper)
    found = []
    for _ in range(count):
        rpy = rng.normal(0, 0.3, 3) + np.array([0, 0, rng.uniform(-3, 3)])
        acceleration = rotation(rpy).T @ [0, 0, 9.81] + rng.normal(0, 2, 3)
        found.append(
            measurement(
                rng.uniform(lower, upper),
                rng.normal(0, 5, (4, 3)),
                rng.normal(0, 15, (4, 3)),
                rpy,
                rng.normal(0, 1, 3),
                acceleration,
            )
        )
    return found


@pytest.mark.parametrize("gait", GAITS)
def test_every_gait_over_a_walk(gait: str) -> None:
    assert_agree("stoch3", policy(), walked("stoch3", "trot" if gait == "stand" else gait), gait={"name": gait})


@pytest.mark.parametrize("name", ROBOTS)
def test_every_robot_over_a_walk(name: str) -> None:
    assert_agree(name, policy(name), walked(name))


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("gait", GAITS)
def test_random_inputs(name: str, gait: str) -> None:
    seed = zlib.crc32(f"{name}{gait}".encode())
    clamps = assert_agree(name, policy(name), random_measurements(name, seed), gait={"name": gait})
    assert clamps & Clamp.COMMAND and clamps & Clamp.OBSERVATION and clamps & Clamp.FRICTION


def random_policy(seed: int, **changes: Any) -> Policy:
    """All numbers at work: a full matrix, every scale and bound its own."""
    rng = np.random.default_rng(seed)
    return variant(
        policy(),
        matrix=tuple(map(tuple, rng.normal(0, 0.3, (18, 28)))),
        observation_scale=tuple(rng.uniform(0.1, 10, 28)),
        observation_offset=tuple(rng.uniform(-0.5, 1.5, 28)),
        action_scale=tuple(rng.uniform(0.05, 1, 12)) + tuple(rng.uniform(10, 100, 6)),
        action_bound=tuple(rng.uniform(0.05, 0.3, 12)) + tuple(rng.uniform(50, 400, 6)),
        **changes,
    )


ALL_OFF = Terms()
ALL_ON = Terms(
    velocity_integral=2.0,
    integral_bound=0.05,
    capture_point=0.2,
    velocity_error_bound=0.2,
    centripetal=0.7,
    slope_feet=0.9,
    slope_body=0.4,
    swing_lift=0.05,
)


@pytest.mark.parametrize("reading", ["relative", "plain"])
@pytest.mark.parametrize("terms", [ALL_OFF, ALL_ON], ids=["terms off", "terms on"])
def test_both_readings_with_all_terms_on_and_off(reading: str, terms: Terms) -> None:
    chosen = random_policy(1, reading=reading, terms=terms)
    assert assert_agree("stoch3", chosen, walked()) & Clamp.SHIFT
    assert_agree("stoch3", chosen, random_measurements("stoch3", 2))


@pytest.mark.parametrize("term", [name for name in Terms.__struct_fields__ if not name.startswith("integral_")])
def test_each_term_alone(term: str) -> None:
    assert_agree("stoch3", random_policy(3, terms=Terms(**{term: 0.3})), walked()[:120])


@pytest.mark.parametrize("hidden", [1, 7, 32])
def test_small_network(hidden: int) -> None:
    rng = np.random.default_rng(4)
    layers = rng.normal(0, 0.3, (hidden, 28)), rng.normal(0, 0.5, (18, hidden))
    chosen = random_policy(5, hidden=tuple(map(tuple, layers[0])), readout=tuple(map(tuple, layers[1])))
    assert_agree("stoch3", variant(chosen, matrix=()), walked()[:120])


def test_direct_forces() -> None:
    rng = np.random.default_rng(6)
    chosen = variant(
        policy(),
        output="grf",
        action_names=SHIFT_NAMES + GRF_NAMES,
        matrix=tuple(map(tuple, rng.normal(0, 0.3, (24, 28)))),
        action_scale=(0.1,) * 12 + (60.0,) * 12,
        action_bound=(0.1,) * 12 + (20.0,) * 12,
    )
    assert assert_agree("stoch3", chosen, walked()[:120]) & Clamp.WRENCH


def test_other_rates_and_settings() -> None:
    assert_agree(
        "stoch3",
        policy(),
        walked(),
        rate_hz=500.0,
        gait={"early_contact": False, "search_depth": 0.02, "swing_time": 0.16, "stance_time": 0.24},
        grf={"friction": 0.3, "force_weight": 1e-2, "max_force": 150.0},
        contact={"threshold": 20.0, "release": 0.8, "blanking": 0.2},
        estimator={"settling_time": 0.03, "slip_noise": 0.1, "height_time_constant": 0.0},
        bounds={"shift": 0.02, "force": [20.0, 20.0, 20.0], "moment": [5.0, 5.0, 5.0]},
    )


def test_standing_still_agrees_and_is_solved() -> None:
    still = [standing()] * 50
    assert_agree("stoch3", policy(), still)
    compiled = controller()
    compiled.reset(still[0])
    compiled.step(still[0], VelocityCommand(), True)
    assert compiled.record["solver_status"][0] == SolverStatus.SOLVED
