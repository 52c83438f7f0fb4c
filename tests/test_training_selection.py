"""Which of a run's policies is kept, with a contest that knows the best numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from drivers.robot import Array
from runtime import config as configuration
from runtime import policies
from runtime.control.policy import encode_policy
from sim.terrain import HeightField, Plane, Slope
from training import pgpe, selection
from training.checkpoint import Checkpoint, Row, RunFolder
from training.contest import Contender, Outcome, Trial
from training.plan import IMITATE, ROUGHEN, SETTLE, StagePlan
from training.randomize import TASK
from training.table import QUICK, make_tests
from training.validation import validation_set
from training.variants import VARIANTS, make_policy, with_parameters

CONFIG = configuration.load(configuration.find_robot("stoch3"))
BEST: Array = 0.1 * np.sin(np.arange(504.0))
TEMPLATE = make_policy(CONFIG.robot, CONFIG.control.gait.walking_height, VARIANTS["linear"], True, "tried")


class NearnessContest:
    """Stands for the simulator: a policy is as good as its numbers are near the best ones."""

    def __init__(self, *_: object) -> None:
        pass

    def __enter__(self) -> NearnessContest:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def play(self, who: Contender, trials: Sequence[Trial]) -> list[Outcome]:
        assert who.path is not None
        far = float(np.linalg.norm(policies.load(Path(who.path), "stoch3").parameters - BEST))
        return [Outcome(False, 2.6, (0.0, 0.0, 0.0), 0.5, 9.0, 4.0, task_return=-far, compute=1e-4) for _ in trials]


class WatchedTable(NearnessContest):
    """Takes down the seeds of what it is asked to play."""

    walking_height = 0.3

    def __init__(self) -> None:
        self.seeds: set[int] = set()

    def play(self, who: Contender, trials: Sequence[Trial]) -> list[Outcome]:
        self.seeds |= {trial.conditions.scenario.seed for trial in trials}
        return [Outcome(False, 2.6, (0.0, 0.0, 0.0), 0.5, 9.0, 4.0, task_return=0.0, compute=1e-4) for _ in trials]


def run_of(path: Path, means: Sequence[Array]) -> RunFolder:
    """A folder with one checkpoint for each mean, all of one stage."""
    folder = RunFolder(path)
    (path / "checkpoints").mkdir(parents=True)
    for number, mean in enumerate(means):
        state = pgpe.start(mean, 0.1)
        row = Row("refine", number, 0.0, 0.0, 0.0, 1.0, 0, 1, 0.1, 1.0, {})
        folder.save(Checkpoint(0, number, state), encode_policy(with_parameters(TEMPLATE, mean)), row)
    return folder


@pytest.fixture(autouse=True)
def _nearness(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(selection, "Contest", NearnessContest)


def selected(folder: RunFolder, stage: StagePlan = SETTLE) -> tuple[Array, dict[str, object]]:
    policy = selection.select(CONFIG, folder, stage, 1, lambda _: None)
    return policy.parameters, policy.provenance


def test_means_that_wander_around_the_best_numbers_are_averaged(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    folder = run_of(tmp_path, [BEST + 0.05 * rng.standard_normal(504) for _ in range(12)])
    parameters, provenance = selected(folder)
    assert provenance["averaged"] == 6
    tail = [policies.load(folder.policy_file(number), "stoch3").parameters for number in range(6, 12)]
    assert parameters == pytest.approx(np.mean(tail, axis=0), abs=1e-12)
    verdicts = provenance["validation"]
    assert isinstance(verdicts, list)
    assert [verdict["averaged"] for verdict in verdicts] == [1, 1, 1, 1, 1, 1, 6]


def test_one_checkpoint_that_is_better_than_the_mean_is_kept(tmp_path: Path) -> None:
    folder = run_of(tmp_path, [(1 + (11 - number)) * BEST for number in range(12)])
    parameters, provenance = selected(folder)
    assert "averaged" not in provenance
    assert parameters == pytest.approx(BEST)


def test_a_run_of_one_checkpoint_keeps_it(tmp_path: Path) -> None:
    parameters, _ = selected(run_of(tmp_path, [BEST]))
    assert parameters == pytest.approx(BEST)


@pytest.mark.parametrize(
    ("stage", "grounds"), [(IMITATE, {Plane}), (SETTLE, {Plane}), (ROUGHEN, {Plane, Slope, HeightField})]
)
def test_the_ground_that_was_trained_on_judges(
    stage: StagePlan, grounds: set[type], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    played: list[Trial] = []

    class WatchedContest(NearnessContest):
        def play(self, who: Contender, trials: Sequence[Trial]) -> list[Outcome]:
            played.extend(trials)
            return super().play(who, trials)

    monkeypatch.setattr(selection, "Contest", WatchedContest)
    selected(run_of(tmp_path, [BEST]), stage)
    assert {type(trial.conditions.scenario.terrain) for trial in played} == grounds


def test_what_judges_is_asked_for_as_hard_as_the_table_asks() -> None:
    """Pushes in every phase and both ways above 55 N·s along and 45 across, and torques clipped at 18 N·m."""
    hard = [trial.conditions.scenario for trial in validation_set(TASK).hard]
    impulses = [0.1 * np.array(push.force) for scenario in hard for push in scenario.pushes]
    forward = [impulse[0] for impulse in impulses if abs(impulse[1]) < 1e-9]
    sideways = [impulse[1] for impulse in impulses if abs(impulse[0]) < 1e-9]
    for pushes, asked in ((forward, 55.0), (sideways, 45.0)):
        assert len(pushes) == 16 and np.abs(pushes).min() > asked
        assert sum(np.sign(pushes)) == 0
    starts = {round(push.start % 0.4, 6) for scenario in hard for push in scenario.pushes}
    assert len(starts) == 8
    assert {scenario.motor_strength * CONFIG.robot.joints.peak_torque[0] for scenario in hard} == {40.0, 18.0}


def test_no_walk_that_judges_is_one_of_the_table() -> None:
    """A policy chosen by the walks that then praise it would be praised too much."""
    judged = validation_set(TASK)
    seeds = {trial.conditions.scenario.seed for trial in judged.measured + judged.hard + judged.drawn}
    table = WatchedTable()
    for test in make_tests(QUICK).values():
        test(table, Contender("anyone", "zero"))  # type: ignore[arg-type]
    assert len(table.seeds) > QUICK.draws
    assert not seeds & table.seeds
