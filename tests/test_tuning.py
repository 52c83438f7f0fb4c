"""Live tuning: bounds and ramps, on a simulated walk, over the wire by role, over a restart, and through a replay."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable
from pathlib import Path

import numpy as np
import pytest
from daemons import Served, make_config
from hypothesis import given, settings
from hypothesis import strategies as st
from walks import Walk

from runtime import config, recording
from runtime.control.controller import Controller
from runtime.messages.mode import Mode, Request
from runtime.messages.motion import PoseMessage
from runtime.messages.tick import TICK_DTYPE, TUNED
from runtime.policies import find_policy, load
from runtime.replay import replay
from runtime.tuning import POSE, WALKED, Tuning, TuningError, tunables
from station.tuning import change, describe, known

STOCH3 = config.load(config.find_robot("stoch3"))
NAMES = sorted(tunables(STOCH3))
Script = Callable[[Served], Awaitable[None]]


def controller() -> Controller:
    return Controller(STOCH3.robot, STOCH3.control, load(find_policy("balance"), "stoch3"))


@pytest.fixture(scope="module")
def numbers() -> np.ndarray:
    return controller().tuning


def test_a_tick_bears_the_same_row_under_the_same_names() -> None:
    core = controller()
    core.tuning[:] = np.arange(len(core.tuning)) + 1.0
    tick = np.zeros(1, TICK_DTYPE)
    tick.view(np.float64)[TUNED] = core.tuning
    for name in (name for name in TICK_DTYPE.names or () if name.startswith("tuned_")):
        np.testing.assert_array_equal(tick[name], core.parameters[name.removeprefix("tuned_")])
    assert tick["policy_share"] == core.parameters["policy_share"]


@settings(max_examples=60)
@given(st.lists(st.tuples(st.sampled_from(NAMES), st.floats(-1, 2)), max_size=8), st.sampled_from(WALKED))
def test_whatever_is_asked_the_numbers_stay_in_their_bounds_and_arrive(
    numbers: np.ndarray, wishes: list[tuple[str, float]], gait: str
) -> None:
    row = numbers.copy()
    tuning = Tuning(STOCH3, row)
    tuning.step(Mode.STAND)
    tuning.change("gait", gait)
    wanted: dict[str, float] = {}
    for name, value in wishes:
        one = tuning.tunables[name]
        inside = one.low <= value <= one.high
        try:
            wanted[name] = float(tuning.change(name, value))
        except TuningError as error:
            words = str(error)
            assert name in words
            assert not inside or "reach" in words or "range is" in words
        else:
            assert inside
    derived = {"gait"} if gait == "trot" else {"gait", "swing_time", "stance_time"}  # by the gait's own duty
    before = row.copy()
    for _ in range(450):
        tuning.step(Mode.STAND)
        assert np.abs(row - before).max() < 2.0, "it jumped"
        before = row.copy()
        for entry in tuning.entries():
            if entry.name not in derived and entry.low is not None and entry.high is not None:
                assert entry.low - 1e-9 <= float(entry.value) <= entry.high + 1e-9, entry
    for entry in tuning.entries():
        assert entry.value == entry.wanted
        if entry.name in wanted and entry.name not in derived:
            assert entry.value == wanted[entry.name]
    assert row[0] == numbers[0], "the policy's share is not the tuning's"


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("swing_time", 3.0, "swing_time = 3: must be within 0.1 to 0.5 s"),
        ("swing_time", float("nan"), "must be a number, 0.1 to 0.5 s"),
        ("swing_time", "quick", "must be a number"),
        ("gait", "gallop", "must be one of trot, walk, pace, bound, pronk"),
        ("gait", "stand", "must be one of"),
        ("mass", 1.0, "'mass' cannot be set; there are gait"),
        ("roll", 0.1, "only while standing"),
        ("kp_knee", 1000.0, "within 37.5 to 225 N·m/rad"),
    ],
)
def test_a_refusal_says_the_bound(numbers: np.ndarray, name: str, value: float | str, words: str) -> None:
    row = numbers.copy()
    tuning = Tuning(STOCH3, row)
    with pytest.raises(TuningError) as refused:
        tuning.change(name, value)
    assert words in str(refused.value)
    tuning.step(Mode.DAMP)
    np.testing.assert_array_equal(row, numbers)


def test_a_pose_beyond_the_legs_reach_is_made_smaller_until_it_is_not(numbers: np.ndarray) -> None:
    tuning = Tuning(STOCH3, numbers.copy())
    with pytest.raises(TuningError, match="only while standing"):
        tuning.pose(PoseMessage(0.0, 0.0, 0.0, 0.0))
    tuning.step(Mode.STAND)
    tuning.pose(PoseMessage(1.0, 1.0, 1.0, 1.0))
    wanted = {entry.name: float(entry.wanted) for entry in tuning.entries() if entry.name in POSE}
    assert all(0.0 < wanted[name] < tuning.tunables[name].high for name in POSE)


@pytest.fixture(scope="module")
def tuned(tmp_path_factory: pytest.TempPathFactory) -> Walk:
    """A robot that took every pose, other gains and heights, and walked through four gaits."""
    walk = Walk(tmp_path_factory.mktemp("recordings"))
    tuning = Tuning(walk.config, walk.cycle.controller.tuning)
    walk.after = lambda: tuning.step(walk.cycle.state.mode)
    walk.stand()
    walk.run(0.3)
    for pose in (PoseMessage(0.5, 0.0, 0.5, -0.5), PoseMessage(-0.5, 0.4, 0.0, 0.0)):
        tuning.pose(pose)
        walk.run(1.6)
        tick = walk.cycle.tick[0]
        roll, pitch, yaw, height = tick["tuned_body_pose"]
        assert np.abs(tick["rpy"] - (roll, pitch, yaw)).max() < 0.05, (tick["rpy"], tick["tuned_body_pose"])
        assert abs(tick["height"] - walk.config.control.gait.walking_height - height) < 0.02
    tuning.change("kp_knee", 120.0)
    tuning.change("swing_height", 0.1)
    walk.ask(Request.WALK)
    for gait in ("pace", "walk", "trot"):
        tuning.change("gait", gait)
        walk.run(1.6, (0.3, 0.0, 0.0))
        assert walk.cycle.state.mode is Mode.WALK
    tuning.change("walking_height", 0.5)
    walk.run(1.0, (0.3, 0.0, 0.0))
    return walk


def test_a_walk_bears_every_change_and_follows_it(tuned: Walk) -> None:
    tick = tuned.cycle.tick[0]
    assert tuned.cycle.state.mode is Mode.WALK and not tuned.world.fallen()
    assert not tick["tuned_body_pose"].any(), "a pose is for standing alone"
    assert abs(tick["height"] - 0.5) < 0.03
    swinging = tick["stance"] == 0
    assert (tick["command_kp"][swinging, 2] == 120.0).all()
    ticks = recording.load(tuned.write()).ticks
    steps = np.abs(np.diff(ticks["tuned_walking_height"]))
    assert 0.0 < steps.max() < 0.002, "ramped"


def test_what_was_changed_replays_bit_for_bit(tuned: Walk) -> None:
    result = replay(recording.load(tuned.write()))
    assert result.difference is None and result.ticks > 1500


# Over the wire ---------------------------------------------------------------------------------------------------


def serve(folder: Path, script: Script, made: object = None) -> Served:
    async def play() -> Served:
        async with Served(made or make_config(), folder) as here:  # type: ignore[arg-type]
            await script(here)
            return here

    return asyncio.run(play())


def test_set_and_get_over_the_wire_and_what_is_saved_outlives_a_restart(tmp_path: Path) -> None:
    made = make_config()

    async def first(served: Served) -> None:
        for name, value, save in (("swing_height", "0.1", True), ("swing_time", "0.3", False), ("gait", "walk", True)):
            assert (await served.client(lambda s, n=name, v=value, k=save: change(s, n, v, k))).accepted
        refused = await served.client(lambda s: change(s, "swing_time", "9"))
        assert not refused.accepted and "0.1 to 0.5 s" in refused.reason
        assert served.daemon.link.entrance.refused["command/tuning"] == 1
        assert not (await served.client(lambda s: change(s, "roll", "0.1", True))).accepted
        await served.until(lambda: served.daemon.cycle.tick["tuned_swing_time"][0] == 0.3)
        lines = [describe(entry) for entry in await served.client(known)]
        assert any("swing_height" in line and "saved 0.1" in line for line in lines)
        assert any(event.kind == "tuning" for event in served.daemon.link.history)

    async def second(served: Served) -> None:
        tick = served.daemon.cycle.tick[0]
        await served.until(lambda: tick["index"] > 2)
        assert tick["tuned_swing_height"] == 0.1 and tick["tuned_gait_offset"].tolist() == [0.75, 0.25, 0.0, 0.5]
        assert tick["tuned_swing_time"] == 0.2, "it was not saved"
        assert (await served.client(lambda s: change(s, "swing_height", "own", True))).accepted

    async def third(served: Served) -> None:
        await served.until(lambda: served.daemon.cycle.tick["index"][0] > 2)
        assert served.daemon.cycle.tick["tuned_swing_height"][0] == 0.08
        assert any("saved tuning not used" in event.text for event in served.daemon.link.history)

    serve(tmp_path, first, made)
    serve(tmp_path, second, made)
    path = tmp_path / "tuning" / f"{made.robot.name}.json"
    assert json.loads(path.read_bytes()) == {"gait": "walk"}
    path.write_text('{"gait": "gallop", "mass": 3}')
    serve(tmp_path, third, made)


def test_a_pose_over_the_wire_is_for_a_standing_robot(tmp_path: Path) -> None:
    def tilt(station: object) -> None:
        for payload in (b'{"roll": 1, "pitch": 0, "yaw": 0, "height": 0}', b'{"roll": 2}', b"\xff"):
            station.session.put(station.keys.pose, payload)  # type: ignore[attr-defined]

    async def script(served: Served) -> None:
        refused = served.daemon.link.entrance.refused
        await served.client(tilt)
        await served.until(lambda: refused["command/pose"] == 3)
        await served.stand()
        await served.client(tilt)
        await served.until(lambda: served.daemon.cycle.tick["tuned_body_pose"][0, 0] > 0.25)
        assert refused["command/pose"] == 5

    serve(tmp_path, script)
