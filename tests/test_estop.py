"""The operator's stop: in every mode, at every tick of every way between two, the next command damps."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest
from daemons import Probe, is_damp, make_config, make_policy, wake

from drivers.robot import damp_command
from runtime.cycle import Cycle
from runtime.messages.mode import Mode, Request
from runtime.reasons import Reason

WAYS: dict[str, list[Request | Mode | int]] = {
    "up, walk and down": [
        *(Request.ARM, 3, Request.STAND, Mode.STAND, 8, Request.WALK, 40, Request.STAND, 8, 60),
        *(Request.SIT, Mode.DAMP, 3),
    ],
    "down while it stands up": [Request.ARM, Request.STAND, 20, Request.SIT, Mode.DAMP],
    "up while it sits down": [Request.ARM, Request.STAND, Mode.STAND, 5, Request.SIT, 10, Request.STAND, Mode.STAND, 5],
    "down while it folds": [Request.ARM, Request.STAND, 5, Request.SIT, 2, Request.STAND, 3, Request.SIT, Mode.DAMP],
}
"""What is asked, the mode that is then waited for, or ticks that go by."""
ARMABLE = 120
"""Ticks that the arming list wants to have seen."""


class Robot:
    """A cycle on the null body, and a second one that can be put where the first is."""

    def __init__(self) -> None:
        config = make_config()
        policy = make_policy(config.robot.name)
        self.body, self.cycle, self.twin = Probe(config), *(Cycle(config, policy) for _ in range(2))
        asyncio.run(self.body.connect())
        self.command = damp_command(1.0)
        self.index, self.stopped = 0, 0
        self.seen: set[tuple[Mode, Mode]] = set()
        self.exchange()
        for cycle in (self.cycle, self.twin):
            cycle.warm_up(self.measurement)

    def exchange(self) -> None:
        waiting = self.body.exchange(self.command)
        try:
            waiting.send(None)
        except StopIteration as done:
            self.measurement = done.value

    def tick(self) -> None:
        before = self.cycle.state.mode
        self.index += 1
        self.exchange()
        self.command = self.cycle.step(wake(self.index), self.measurement)
        self.seen.add((before, self.cycle.state.mode))

    def stop(self) -> None:
        """What a stop between this tick and the next would do, on the twin."""
        twin = self.twin
        twin.recall(self.cycle.remember(), self.cycle.tick)
        before = twin.state.mode
        answer, _ = twin.request(Request.DAMP, self.measurement)
        assert answer.accepted and answer.state.mode is Mode.DAMP and not answer.state.armed
        for tick in (1, 2):
            command = twin.step(wake(self.index + tick), self.measurement)
            assert is_damp(command), f"{before.name} at tick {self.index}: still moving {tick} ticks after the stop"
        assert twin.state.fault is Reason.OK
        self.stopped += 1


def go(robot: Robot, way: list[Request | Mode | int], each: Callable[[], None]) -> None:
    for _ in range(ARMABLE):
        robot.tick()
    for act in way:
        if isinstance(act, Request):
            answer, words = robot.cycle.request(act, robot.measurement)
            assert answer.accepted, words
            each()  # a stop right behind another wish
            continue
        for _ in range(2000 if isinstance(act, Mode) else act):
            if isinstance(act, Mode) and robot.cycle.state.mode is act:
                break
            robot.tick()
            each()
        else:
            assert not isinstance(act, Mode), f"never reached {act}: {robot.cycle.state}"


@pytest.mark.parametrize("way", WAYS, ids=str)
def test_a_stop_at_any_tick_damps_with_the_next_command(way: str) -> None:
    robot = Robot()
    go(robot, WAYS[way], robot.stop)
    assert robot.stopped > 30


def test_the_ways_pass_through_every_mode_and_every_change_of_the_table() -> None:
    asked: set[tuple[Mode, Request]] = set()
    modes: set[Mode] = set()
    for way in WAYS.values():
        robot = Robot()
        go(robot, way, lambda: None)
        modes |= {after for _, after in robot.seen}
    assert modes == set(Mode)
    for way in WAYS.values():
        robot = Robot()
        request = robot.cycle.request

        def noted(wish: Request, measurement: object, request: object = request, robot: Robot = robot) -> object:
            asked.add((robot.cycle.state.mode, wish))
            return request(wish, measurement)  # type: ignore[operator]

        robot.cycle.request = noted  # type: ignore[assignment, method-assign]
        go(robot, way, lambda: None)
    assert asked >= {
        (Mode.DAMP, Request.STAND),
        (Mode.STAND_UP, Request.SIT),
        (Mode.STAND, Request.WALK),
        (Mode.STAND, Request.SIT),
        (Mode.WALK, Request.STAND),
        (Mode.SIT_DOWN, Request.STAND),
    }
