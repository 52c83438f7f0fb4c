"""Replays: the same bits from any keyframe on, and the first tick and stage named where something was changed."""

from __future__ import annotations

import asyncio
from pathlib import Path

import msgspec
import numpy as np
import pytest
from daemons import Served, make_config, quick_tables
from walks import Walk, walk_around

from runtime.config import ROBOTS
from runtime.control.policy import Policy, encode_policy
from runtime.control.records import CONTROL_DTYPE
from runtime.messages.mode import Mode, Request
from runtime.recording import Recording, load
from runtime.replay import STAGES, ReplayError, compare_policy, replay


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return load(walk_around(tmp_path_factory.mktemp("recordings")).write())


def changed(recording: Recording, **headers: object) -> Recording:
    return Recording(recording.path, msgspec.structs.replace(recording.header, **headers), recording.ticks.copy())


def test_a_whole_outing_comes_out_bit_for_bit(walked: Recording) -> None:
    result = replay(walked)
    assert result.difference is None
    assert result.ticks == len(walked.ticks) - 1
    assert set(result.modes) == {mode.name for mode in Mode}


def test_every_computed_field_belongs_to_one_stage() -> None:
    named = [name for names in STAGES.values() for name in names]
    assert len(set(named)) == len(named)
    assert set(CONTROL_DTYPE.names or ()) <= set(named)


@pytest.mark.parametrize("mode", [Mode.STAND_UP, Mode.WALK, Mode.SIT_DOWN])
def test_a_ring_that_begins_in_the_middle_of_a_movement_replays_from_its_first_keyframe(
    mode: Mode, tmp_path: Path
) -> None:
    walk = Walk(tmp_path, seconds=2.0)
    walk.run(1.2)
    walk.ask(Request.ARM, Request.STAND)
    if mode is not Mode.STAND_UP:
        walk.until(lambda: walk.cycle.state.mode is Mode.STAND)
        walk.run(0.2)
        walk.ask(Request.WALK if mode is Mode.WALK else Request.SIT)
    walk.run(2.4, (0.4, 0.1, 0.3))
    recording = load(walk.write())
    assert recording.ticks["index"][0] > 1 and recording.ticks["mode"][0] == mode
    result = replay(recording)
    assert result.difference is None
    assert result.ticks >= 200 and result.skipped <= 200


@pytest.mark.parametrize(
    ("field", "stage"),
    [("command_torque", "command"), ("twist", "estimate"), ("asked", "policy"), ("grf", "force"), ("armed", "mode")],
)
def test_a_changed_bit_is_found_in_its_tick_and_stage(walked: Recording, field: str, stage: str) -> None:
    tampered = changed(walked)
    place = int(np.flatnonzero(walked.ticks["mode"] == Mode.WALK)[100])
    bits = tampered.ticks[field][place : place + 1].view(np.uint8)
    bits.flat[0] ^= 1
    difference = replay(tampered).difference
    assert difference is not None
    assert (difference.tick, difference.stage) == (int(walked.ticks["index"][place]), stage)
    assert difference.field.startswith(field)


def test_a_changed_measurement_shows_in_the_estimate(walked: Recording) -> None:
    tampered = changed(walked)
    place = int(np.flatnonzero(walked.ticks["mode"] == Mode.WALK)[100])
    tampered.ticks["joint_velocity"][place, 2, 1] += 1e-9
    difference = replay(tampered).difference
    assert difference is not None and difference.tick == int(walked.ticks["index"][place])
    assert difference.stage == "estimate"


def test_a_policy_that_came_in_the_middle_is_used_from_its_tick_on(tmp_path: Path) -> None:
    walk = Walk(tmp_path)
    walk.stand()
    walk.ask(Request.WALK)
    walk.run(0.5, (0.3, 0.0, 0.0))
    walk.policies[1] = encode_policy(walk.policy).decode()
    walk.policy = msgspec.structs.replace(walk.policy, name="weaker", shift_time_constant=0.1)
    walk.cycle.swap_policy(walk.policy)
    walk.run(0.5, (0.3, 0.0, 0.0))
    recording = load(walk.write())
    assert replay(recording).difference is None
    with pytest.raises(ReplayError, match="policy number 1"):
        replay(changed(recording, policies={}))
    wrong = replay(changed(recording, policies={1: recording.header.policy})).difference
    assert wrong is not None and wrong.stage == "policy"


def test_another_policy_is_compared_and_the_same_one_does_not_differ(walked: Recording) -> None:
    policy = msgspec.json.decode(walked.header.policy.encode(), type=Policy)
    same = compare_policy(walked, policy)
    assert same.shift == same.force == same.torque == 0.0 and same.ticks >= 800
    assert same.clamped_before == same.clamped_now
    halved = tuple(tuple(0.5 * value for value in row) for row in policy.matrix)
    assert compare_policy(walked, msgspec.structs.replace(policy, matrix=halved)).force > 1.0


def test_lost_commands_replay_through_expiry_to_standing(tmp_path: Path) -> None:
    walk = Walk(tmp_path)
    walk.stand()
    walk.ask(Request.WALK)
    walk.run(0.5, (0.4, 0.0, 0.0))
    walk.run(2.5)
    assert walk.cycle.state.mode is Mode.STAND
    assert replay(load(walk.write())).difference is None


def test_what_a_daemon_recorded_replays(tmp_path: Path) -> None:
    """The null body, real clocks, requests between ticks, and the file that the daemon itself writes."""

    async def play() -> Path:
        made = make_config()
        async with Served(made, tmp_path) as served:
            await served.walk()
            await served.ticks(80)
            assert served.daemon.take_request(Request.STAND).accepted
            await served.ticks(60)
            return served.daemon.flight.write("test")

    path = asyncio.run(play())
    recording = load(path)
    quick = (ROBOTS / "stoch3.toml").read_text().replace('name = "stoch3"', f'name = "{recording.header.robot}"')
    result = replay(changed(recording, robot_toml=f"{quick}\n{quick_tables()}"))
    assert result.difference is None and result.ticks > 100 and "WALK" in result.modes


def test_a_recording_without_a_keyframe_is_refused(walked: Recording) -> None:
    with pytest.raises(ReplayError, match="no keyframe"):
        replay(changed(walked, keyframes=[]))
    with pytest.raises(ReplayError, match="keyframe of another version"):
        replay(changed(walked, keyframes=[b"123"]))
