"""Candidates on a simulated robot: a good one takes over without a jump, a hostile one is given up before it falls."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from walks import Walk

from runtime import policies, recording
from runtime.audition import Audition, Outcome, Stage
from runtime.control.policy import Policy, encode_policy
from runtime.messages.mode import Mode, Request
from runtime.policies import PolicyError, check_manifest, find_policy, load
from runtime.replay import replay
from runtime.shelf import PolicyFile, Shelf

ACTIVE = load(find_policy("trot"), "stoch3")
"""Stoch3's own, which every outing sets out with."""
VELOCITY = (0.5, 0.0, 0.0)
random = np.random.default_rng(1)
HOSTILE: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "flipped": lambda matrix: -matrix,
    "zero": np.zeros_like,
    "random": lambda matrix: random.normal(0.0, 0.3, matrix.shape),
}


def candidate(name: str, change: Callable[[np.ndarray], np.ndarray], **changes: object) -> PolicyFile:
    matrix = change(np.array(ACTIVE.matrix))
    policy = msgspec.structs.replace(ACTIVE, name=name, matrix=tuple(map(tuple, matrix.tolist())), **changes)
    return PolicyFile(policy, encode_policy(policy))


class MemoryShelf(Shelf):
    """Keeps nothing on a disk."""

    def keep(self, file: PolicyFile, then: Callable[[str], None]) -> None:
        self.kept = file
        then("")


class Trial:
    """A robot that stands or walks, and its audition in the slack of every tick."""

    def __init__(self, folder: Path, walking: bool, **changes: float) -> None:
        self.walk = walk = Walk(folder)
        walk.stand()
        walk.run(0.3)
        self.velocity = VELOCITY if walking else None
        if walking:
            self.set_off()
        self.shelf = MemoryShelf(walk.cycle, folder, "stoch3", self._note)
        config = msgspec.structs.replace(walk.config.audition, shadow=0.5, trial=1.5, **changes)
        self.audition = Audition(walk.cycle, self.shelf, config)
        self.audition.warm_up()
        self.verdicts: list[Outcome] = []
        self.tilt = 0.0
        walk.after = self._after

    def set_off(self) -> None:
        self.velocity = VELOCITY
        self.walk.ask(Request.WALK)
        self.walk.run(1.0, self.velocity)

    def _after(self) -> None:
        if self.audition.stage is not None:
            self.audition.step()
        self.tilt = max(self.tilt, float(np.abs(self.walk.cycle.tick["rpy"][0, :2]).max()))

    def _note(self, generation: int, data: bytes) -> None:
        self.walk.policies[generation] = data.decode()

    def offer(self, file: PolicyFile) -> None:
        self.audition.offer(file, False, self.verdicts.append)

    def run(self, seconds: float) -> None:
        self.walk.run(seconds, self.velocity)

    def stands_firm(self) -> bool:
        mode = Mode.STAND if self.velocity is None else Mode.WALK
        return self.walk.cycle.state.mode is mode and self.tilt < 0.25 and not self.walk.world.fallen()


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_candidate_in_the_walk_is_given_up_before_the_robot_falls(tmp_path: Path, name: str) -> None:
    trial = Trial(tmp_path, True, min_agreement=-1.0, clamp_rise=1.0)  # the shadow lets everything pass
    trial.offer(candidate(name, HOSTILE[name]))
    trial.run(4.0)
    (verdict,) = trial.verdicts
    assert not verdict.accepted and "foreseen tilt" in verdict.words, verdict
    assert trial.walk.cycle.policy is ACTIVE or trial.walk.cycle.policy == ACTIVE
    assert trial.walk.cycle.generation == 3 and trial.stands_firm(), trial.tilt
    assert trial.audition.stage is None and not hasattr(trial.shelf, "kept")


@pytest.mark.parametrize("walking", [True, False])
def test_the_policy_for_uneven_ground_takes_over_from_the_default(tmp_path: Path, walking: bool) -> None:
    rough = load(find_policy("trot-rough"), "stoch3")
    trial = Trial(tmp_path, walking)
    trial.offer(PolicyFile(rough, encode_policy(rough)))
    trial.run(4.0)
    assert trial.verdicts[0].accepted, trial.verdicts[0].words
    trial.set_off()
    trial.run(4.0)
    assert trial.walk.cycle.policy == rough and trial.stands_firm(), trial.tilt


def test_what_asks_for_the_opposite_does_not_pass_the_shadow(tmp_path: Path) -> None:
    trial = Trial(tmp_path, True)
    trial.offer(candidate("flipped", HOSTILE["flipped"]))
    trial.run(0.6)
    (verdict,) = trial.verdicts
    assert not verdict.accepted and "agreement -1.00" in verdict.words
    assert trial.walk.cycle.generation == 1, "it was never active"


def test_a_candidate_that_only_stands_is_given_up_in_its_first_walk(tmp_path: Path) -> None:
    trial = Trial(tmp_path, False)
    trial.offer(candidate("zero", HOSTILE["zero"]))
    trial.run(3.0)
    assert trial.verdicts[0].accepted and "proved while standing" in trial.verdicts[0].words
    trial.set_off()
    trial.run(3.0)
    assert trial.walk.cycle.policy == ACTIVE and not hasattr(trial.shelf, "kept")
    assert not trial.walk.world.fallen() and trial.tilt < 0.4, trial.tilt


def test_a_flipped_one_is_given_up_while_standing(tmp_path: Path) -> None:
    trial = Trial(tmp_path, False)
    trial.offer(candidate("flipped", HOSTILE["flipped"]))
    trial.run(3.0)
    assert not trial.verdicts[0].accepted and trial.stands_firm(), trial.tilt


def test_a_good_one_takes_over_without_a_jump_and_all_of_it_replays(tmp_path: Path) -> None:
    trial = Trial(tmp_path, True)
    good = candidate("better", lambda matrix: 1.1 * matrix, shift_time_constant=0.04, terms=ACTIVE.terms)
    trial.offer(good)
    shares: list[float] = []
    step = trial.walk.after

    def look() -> None:
        step()
        shares.append(float(trial.walk.cycle.tick["policy_share"][0]))

    trial.walk.after = look
    trial.run(3.0)
    assert trial.verdicts[0].words == "proved, kept" and trial.shelf.kept is good
    moving = [share for share in shares if share < 1.0]
    assert len(moving) == pytest.approx(0.5 * 200, abs=2) and np.diff(moving).min() > 0
    bad = candidate("random", HOSTILE["random"])
    trial.audition.offer(bad, True, trial.verdicts.append)
    trial.run(2.0)
    assert trial.walk.cycle.policy == good.policy and trial.stands_firm()
    written = recording.load(trial.walk.write())
    assert set(np.unique(written.ticks["policy"])) == {1, 2, 3, 4}
    steps = np.abs(np.diff(written.ticks["action"][:, 12:15], axis=0)).max(axis=1)
    hands = np.flatnonzero(np.diff(written.ticks["policy"]))
    assert len(hands) == 3
    for hand in hands:
        assert steps[hand] <= steps[hand - 200 : hand].max(), "newtons from one tick to the next, of the second before"
    result = replay(written)
    assert result.difference is None and result.ticks > 1000


def test_a_replay_may_begin_in_the_middle_of_a_blend(tmp_path: Path) -> None:
    trial = Trial(tmp_path, True)
    trial.offer(candidate("better", lambda matrix: 1.1 * matrix))
    while trial.walk.cycle.controller.share == 1.0:
        trial.run(0.005)
    trial.run(0.1)
    trial.walk.recorder._keyframes.clear()
    trial.walk.recorder.keep_keyframe(trial.walk.cycle.remember())
    trial.run(1.0)
    result = replay(recording.load(trial.walk.write()))
    assert result.difference is None and result.ticks >= 190


def test_a_policy_of_another_kind_is_for_a_standing_robot_alone(tmp_path: Path) -> None:
    plain = candidate("plain", np.zeros_like, reading="plain")
    trial = Trial(tmp_path, False, height_rise=1.0)
    trial.offer(plain)
    trial.run(3.0)
    assert trial.verdicts[0].accepted, trial.verdicts[0].words
    written = recording.load(trial.walk.write())
    torque = written.ticks["command_torque"]
    assert np.abs(np.diff(torque[-600:], axis=0)).max() < 3.0
    assert replay(written).difference is None
    trial.walk.ask(Request.WALK)
    trial.run(0.2)
    with pytest.raises(PolicyError, match="only while standing"):
        trial.offer(candidate("relative", lambda matrix: matrix))


def test_a_robot_that_damps_during_the_trial_has_its_policy_back(tmp_path: Path) -> None:
    trial = Trial(tmp_path, True)
    trial.offer(candidate("better", lambda matrix: 1.1 * matrix))
    while trial.audition.stage is not Stage.TRIAL:
        trial.run(0.005)
    trial.run(0.1)
    trial.walk.cycle.guard.bounds["joint_velocity"] = 0.0
    trial.run(0.02)
    assert trial.walk.cycle.state.mode is Mode.DAMP
    assert not trial.verdicts[0].accepted and "the robot damped: a joint is too fast" in trial.verdicts[0].words
    assert trial.walk.cycle.policy == ACTIVE


def test_sitting_down_in_the_shadow_ends_the_audition(tmp_path: Path) -> None:
    trial = Trial(tmp_path, False)
    trial.offer(candidate("better", lambda matrix: 1.1 * matrix))
    trial.run(0.1)
    trial.walk.ask(Request.SIT)
    trial.run(0.02)
    assert not trial.verdicts[0].accepted and trial.audition.stage is None


@pytest.mark.parametrize("name", ["balance", "trot", "trot-rough"])
def test_shipped_policies_fulfil_the_manifest_and_huge_ones_do_not(name: str) -> None:
    policy = policies.load(policies.find_policy(name), "stoch3")
    check_manifest(policy, 200.0, 10.0, "x")
    huge: Policy = candidate("huge", lambda matrix: 1e3 * matrix).policy
    with pytest.raises(PolicyError, match=r"x: \w+ reaches .* times its bound, audition.max_norm 10"):
        check_manifest(huge, 200.0, 10.0, "x")
