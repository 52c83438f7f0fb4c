"""The simulated body answers the Robot protocol as the hardware does."""

from __future__ import annotations

import asyncio
import gc
import itertools

import numpy as np
import pybullet
import pytest

from drivers.errors import NotConnected
from drivers.robot import Robot, damp_command
from runtime.config import ROBOTS, load
from sim.robot import SimRobot
from sim.scenario import Scenario
from sim.world import World

CONFIG = load(ROBOTS / "stoch3.toml")
DAMP = damp_command(4.0)


def build() -> World:
    return World(CONFIG.robot, 200.0, CONFIG.control.gait.walking_height)


def test_it_is_a_robot_with_simulated_time_when_free_running() -> None:
    async def life() -> list[float]:
        robot = SimRobot(build, Scenario(rpy=(0.1, 0.0, 0.0)))
        body: Robot = robot
        await body.connect()
        try:
            return [(await body.exchange(DAMP)).stamp for _ in range(4)]
        finally:
            await body.close()

    np.testing.assert_allclose(asyncio.run(life()), [0.0, 0.005, 0.010, 0.015])


def test_its_stamps_are_the_clocks_when_paced() -> None:
    async def life() -> list[tuple[float, float]]:
        ticks = itertools.count(100.0, 0.5)
        robot = SimRobot(build, clock=lambda: next(ticks))
        await robot.connect()
        measurements = [await robot.exchange(DAMP) for _ in range(3)]
        await robot.close()
        return [(measurement.stamp, measurement.imu.stamp) for measurement in measurements]

    assert asyncio.run(life()) == [(100.0, 100.0), (100.5, 100.5), (101.0, 101.0)]


def test_it_cannot_be_used_before_connect_or_after_close() -> None:
    async def life() -> None:
        robot = SimRobot(build)
        with pytest.raises(NotConnected):
            await robot.exchange(DAMP)
        await robot.close()
        await robot.connect()
        await robot.exchange(DAMP)
        await robot.close()
        await robot.close()
        with pytest.raises(NotConnected):
            await robot.exchange(DAMP)
        with pytest.raises(NotConnected):
            robot.push((0.0, 1.0, 0.0), 0.1)

    asyncio.run(life())


def test_connecting_again_starts_over_and_leaks_nothing() -> None:
    async def life() -> None:
        gc.collect()  # worlds that other tests left behind close when they are collected
        before = sum(pybullet.isConnected(client) for client in range(1000))
        robot = SimRobot(build)
        await robot.connect()
        for _ in range(50):
            last = await robot.exchange(DAMP)
        await robot.connect()
        again = await robot.exchange(DAMP)
        assert again.stamp == 0.0
        assert (again.joints.position != last.joints.position).any()
        assert sum(pybullet.isConnected(client) for client in range(1000)) == before + 1
        await robot.close()
        assert sum(pybullet.isConnected(client) for client in range(1000)) == before

    asyncio.run(life())


def test_a_push_through_the_door_moves_the_body() -> None:
    async def life() -> float:
        robot = SimRobot(build, Scenario(height=20.0))
        await robot.connect()
        robot.push((0.0, 100.0, 0.0), 0.1)
        for _ in range(20):
            await robot.exchange(DAMP)
        speed = float(robot.world.truth.linear_velocity[1])
        await robot.close()
        return speed

    assert asyncio.run(life()) > 0.2
