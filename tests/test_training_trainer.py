from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from drivers.robot import Array
from runtime import config as configuration
from runtime import policies
from runtime.config import Config
from runtime.control.policy import BALANCE_TERMS, Policy, ask, policy_record
from training import checkpoint as checkpoints
from training.checkpoint import Row, RunError, RunFolder
from training.plan import RunPlan, StagePlan
from training.provenance import config_hash, versions
from training.reference import Reference, make_reference
from training.rollout import Episode, Setup, Task
from training.trainer import Trainer
from training.variants import (
    ALL_DOWN,
    VARIANTS,
    folding_of,
    make_policy,
    reading_contacts,
    with_parameters,
)

FIRST = StagePlan(name="first", reward="table", iterations=4, directions=6, ticks=50, conditions="nominal")
SECOND = StagePlan(
    name="second",
    reward="task",
    iterations=3,
    directions=5,
    ticks=50,
    conditions="task",
    symmetry="both",
    fall_weight=1.0,
)


class Bowl:
    """Stands for the workers: fitness is the nearness to a target, so that nothing but the trainer is tested."""

    def __init__(self, setup: Setup) -> None:
        size = setup.policy.parameters.size
        self.target: Array = np.sin(np.arange(size))
        self.closed = False

    def evaluate(self, tasks: Sequence[Task]) -> list[Episode]:
        return [self.play(task) for task in tasks]

    def play(self, task: Task) -> Episode:
        distance = float(np.sum((task.parameters - self.target) ** 2))
        return Episode(-distance, 50, distance > 300, {"near": -distance})

    def close(self) -> None:
        self.closed = True


@pytest.fixture(scope="module")
def config() -> Config:
    return configuration.load(configuration.find_robot("stoch3"))


@pytest.fixture(scope="module")
def reference(config: Config) -> Reference:
    return make_reference(config, ticks=50)


def plan(config: Config, *stages: StagePlan) -> RunPlan:
    return RunPlan(name="tried", robot="stoch3", config=config_hash(config), seed=5, stages=stages or (FIRST, SECOND))


def begin(config: Config, reference: Reference, path: Path, made: RunPlan) -> Trainer:
    folder = RunFolder(path)
    folder.begin(made, versions())
    return Trainer(config, made, folder, Bowl, reference)


def quiet(_: Row) -> None:
    pass


def test_training_climbs_and_tells_of_it(config: Config, reference: Reference, tmp_path: Path) -> None:
    made = plan(config, msgspec.structs.replace(FIRST, iterations=15, directions=20))
    trainer = begin(config, reference, tmp_path, made)
    rows: list[Row] = []
    trainer.run(trainer.start(), rows.append)
    assert [row.iteration for row in rows] == list(range(1, 16))
    assert rows[-1].mean_return > rows[0].mean_return + 20
    assert rows[-1].population_best >= rows[-1].population_mean
    assert RunFolder(tmp_path).curve() == rows


def test_stages_follow_each_other_and_carry_the_mean(config: Config, reference: Reference, tmp_path: Path) -> None:
    trainer = begin(config, reference, tmp_path, plan(config))
    rows: list[Row] = []
    end = trainer.run(trainer.start(), rows.append)
    assert [row.stage for row in rows] == ["first"] * 4 + ["second"] * 3
    assert (end.stage, end.iteration, end.state.iteration) == (1, 7, 3)
    before = trainer.policy(RunFolder(tmp_path).load(4)).parameters
    template = trainer.template
    symmetric = folding_of(template, "both").unfold(folding_of(template, "both").fold(before))
    after = trainer.policy(RunFolder(tmp_path).load(5)).parameters
    assert 0 < np.linalg.norm(after - symmetric) < 0.06 * np.sqrt(504)


@pytest.mark.parametrize("stop_after", [0, 2, 4, 5])
def test_a_resumed_run_ends_in_the_same_bits(
    config: Config, reference: Reference, tmp_path: Path, stop_after: int
) -> None:
    whole = begin(config, reference, tmp_path / "whole", plan(config))
    expected = whole.run(whole.start(), quiet)
    stopped = begin(config, reference, tmp_path / "stopped", plan(config))
    checkpoint = stopped.start()

    class Enough(Exception):
        pass

    def stop(row: Row) -> None:
        if row.iteration == stop_after:
            raise Enough

    if stop_after:
        with pytest.raises(Enough):
            stopped.run(checkpoint, stop)
    folder = RunFolder(tmp_path / "stopped")
    resumed = Trainer(config, folder.plan(config_hash(config)), folder, Bowl, reference)
    end = resumed.run(folder.load(), quiet)
    for name in ("mean", "stdev", "gradient_mean", "gradient_square"):
        np.testing.assert_array_equal(getattr(end.state, name), getattr(expected.state, name))
    assert folder.policy_file(7).read_bytes() == RunFolder(tmp_path / "whole").policy_file(7).read_bytes()
    seconds = [replace(row, seconds=0.0) for row in folder.curve()]
    assert seconds == [replace(row, seconds=0.0) for row in RunFolder(tmp_path / "whole").curve()]


def test_every_checkpoint_is_a_policy_that_the_robot_accepts(
    config: Config, reference: Reference, tmp_path: Path
) -> None:
    trainer = begin(config, reference, tmp_path, plan(config))
    trainer.run(trainer.start(), quiet)
    for iteration in range(8):
        policy = policies.load(trainer.folder.policy_file(iteration), "stoch3")
        assert policy.provenance["iteration"] == iteration
        assert policy.provenance["run"]["seed"] == 5
        assert policy.rate_hz == config.control.rate_hz and policy.layout
        policies.check_manifest(policy, config.control.rate_hz, config.audition.max_norm, "trained")
        with pytest.raises(policies.PolicyError, match="rate_hz = 200: this robot ticks at 500"):
            policies.check_manifest(policy, 500.0, config.audition.max_norm, "trained")
    assert np.abs(policies.load(trainer.folder.policy_file(0), "stoch3").parameters).max() == 0


def test_lost_episodes_are_counted_and_do_not_stop_the_run(
    config: Config, reference: Reference, tmp_path: Path
) -> None:
    class Leaky(Bowl):
        def play(self, task: Task) -> Episode:
            return Episode(float("nan"), 0, True) if task.parameters[0] > 0.05 else super().play(task)

    folder = RunFolder(tmp_path)
    made = plan(config)
    folder.begin(made, versions())
    trainer = Trainer(config, made, folder, Leaky, reference)
    rows: list[Row] = []
    end = trainer.run(trainer.start(), rows.append)
    assert sum(row.lost for row in rows) > 0
    assert np.isfinite(end.state.mean).all()
    assert end.state.mean[0] < 0.2


def test_the_workers_are_let_go_when_the_run_is_interrupted(
    config: Config, reference: Reference, tmp_path: Path
) -> None:
    started: list[Bowl] = []

    class Interrupted(Bowl):
        def __init__(self, setup: Setup) -> None:
            super().__init__(setup)
            started.append(self)

        def evaluate(self, tasks: Sequence[Task]) -> list[Episode]:
            raise KeyboardInterrupt

    folder = RunFolder(tmp_path)
    made = plan(config)
    folder.begin(made, versions())
    trainer = Trainer(config, made, folder, Interrupted, reference)
    with pytest.raises(KeyboardInterrupt):
        trainer.run(trainer.start(), quiet)
    assert started[0].closed
    assert folder.load().iteration == 0


def test_a_folder_with_a_run_is_not_overwritten(config: Config, tmp_path: Path) -> None:
    RunFolder(tmp_path).begin(plan(config), versions())
    with pytest.raises(RunError, match="--resume"):
        RunFolder(tmp_path).begin(plan(config), versions())


def test_a_run_of_another_config_is_refused(config: Config, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.begin(msgspec.structs.replace(plan(config), config="0123456789abcdef"), versions())
    with pytest.raises(RunError, match="0123456789abcdef"):
        folder.plan(config_hash(config))


def test_a_folder_without_a_run_or_with_a_broken_plan_is_refused(config: Config, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="no run here"):
        RunFolder(tmp_path).plan("x")
    (tmp_path / "run.json").write_text(json.dumps({"format": 1}))
    with pytest.raises(RunError, match="name"):
        RunFolder(tmp_path).plan("x")
    with pytest.raises(RunError, match="no checkpoint"):
        RunFolder(tmp_path).load()


def test_a_torn_checkpoint_falls_back_to_the_one_before(config: Config, reference: Reference, tmp_path: Path) -> None:
    trainer = begin(config, reference, tmp_path, plan(config, FIRST))
    trainer.run(trainer.start(), quiet)
    newest = tmp_path / "checkpoints" / "0004.npz"
    newest.write_bytes(newest.read_bytes()[:200])
    assert RunFolder(tmp_path).load().iteration == 3
    with pytest.raises(RunError, match="no checkpoint 4"):
        RunFolder(tmp_path).load(4)


def test_a_full_disk_leaves_the_older_checkpoints_usable(
    config: Config, reference: Reference, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = begin(config, reference, tmp_path, plan(config, FIRST))
    real = checkpoints._write

    def full(path: Path, fill: object) -> None:
        if path.name.startswith("0003"):
            raise OSError(28, "No space left on device")
        real(path, fill)  # type: ignore[arg-type]

    monkeypatch.setattr(checkpoints, "_write", full)
    with pytest.raises(OSError, match="No space"):
        trainer.run(trainer.start(), quiet)
    assert RunFolder(tmp_path).load().iteration == 2
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.parametrize("name", VARIANTS)
def test_every_variant_is_a_policy_whose_numbers_can_be_set(name: str, config: Config, tmp_path: Path) -> None:
    policy = make_policy(config.robot, config.control.gait.walking_height, VARIANTS[name], terms=True)
    assert not policy.matrix or policy.parameters.size == len(policy.action_names) * 28
    numbers = np.random.default_rng(0).standard_normal(policy.parameters.size)
    again = with_parameters(policy, numbers)
    np.testing.assert_array_equal(again.parameters, numbers)
    from runtime.control.policy import encode_policy

    assert policies.decode(encode_policy(again), "stoch3", "memory").reading == VARIANTS[name].reading


def test_the_papers_letter_has_no_fixed_terms(config: Config) -> None:
    policy = make_policy(config.robot, config.control.gait.walking_height, VARIANTS["linear"], terms=False)
    assert set(msgspec.structs.astuple(policy.terms)) >= {0.0}
    assert policy.terms.capture_point == policy.terms.velocity_integral == policy.terms.centripetal == 0.0
    assert policy.parameters.size == 504


def test_a_run_without_a_term_makes_policies_without_it(tmp_path: Path, config: Config, reference: Reference) -> None:
    made = msgspec.structs.replace(plan(config), without=("capture_point",))
    trainer = begin(config, reference, tmp_path / "run", made)
    assert trainer.policy(trainer.start()).terms == msgspec.structs.replace(BALANCE_TERMS, capture_point=0.0)


@pytest.mark.parametrize("name", ["linear", "mlp"])
def test_contacts_read_from_four_feet_down_leave_the_trot_and_rest_when_it_stands(config: Config, name: str) -> None:
    rng = np.random.default_rng(3)
    made = make_policy(config.robot, config.control.gait.walking_height, VARIANTS[name], terms=True)
    before = with_parameters(made, rng.standard_normal(made.parameters.size))
    after = reading_contacts(before, True)
    assert after.observation_offset == ALL_DOWN and reading_contacts(after, True) is after
    seen = rng.standard_normal(28)
    for feet in ([1, 0, 0, 1], [0, 1, 1, 0]):
        seen[10:14] = seen[24:28] = feet
        np.testing.assert_allclose(answer(before, seen), answer(after, seen))
    still = np.array([0.0] * 10 + [1.0] * 4 + [0.0] * 10 + [1.0] * 4)
    np.testing.assert_array_equal(answer(after, still), 0.0)
    assert np.abs(answer(before, still)).max() > 0
    back = reading_contacts(after, False)
    np.testing.assert_allclose(back.parameters, before.parameters)


@pytest.mark.parametrize("name", ["linear", "mlp"])
def test_contacts_read_by_another_scale_answer_the_same(config: Config, name: str) -> None:
    rng = np.random.default_rng(4)
    made = make_policy(config.robot, config.control.gait.walking_height, VARIANTS[name], terms=True)
    before = with_parameters(made, rng.standard_normal(made.parameters.size))
    after = reading_contacts(before, False, 0.4)
    assert after.observation_scale[10:14] == (0.4,) * 4
    assert after.observation_scale[:10] == before.observation_scale[:10]
    seen = rng.standard_normal(28)
    np.testing.assert_allclose(answer(before, seen), answer(after, seen))


def test_a_stage_that_swings_higher_says_so_in_its_policies(
    config: Config, reference: Reference, tmp_path: Path
) -> None:
    higher = msgspec.structs.replace(SECOND, swing_lift=0.05)
    trainer = begin(config, reference, tmp_path, plan(config, FIRST, higher))
    trainer.run(trainer.start(), quiet)
    lifts = [policies.load(trainer.folder.policy_file(number), "stoch3").terms.swing_lift for number in (4, 5, 7)]
    assert lifts == [0.0, 0.05, 0.05]


def answer(policy: Policy, seen: Array) -> Array:
    record, out = policy_record(policy), np.zeros(24)
    observation = (seen - record[0]["observation_offset"]) * record[0]["observation_scale"]
    ask(record[0], observation, len(policy.action_names), out)
    return out


def test_a_stage_that_rests_goes_on_with_the_same_trot(tmp_path: Path, config: Config, reference: Reference) -> None:
    made = plan(
        config,
        FIRST,
        msgspec.structs.replace(SECOND, rest=True, symmetry="none", learning_rate=1e-12, learning_rate_end=1e-12),
    )
    trainer = begin(config, reference, tmp_path / "run", made)
    end = trainer.run(trainer.start(), lambda _: None)
    before = policies.load(trainer.folder.policy_file(FIRST.iterations), "stoch3")
    after = trainer.policy(end)
    assert before.observation_offset == () and after.observation_offset == ALL_DOWN
    seen = np.random.default_rng(3).standard_normal(28)
    for feet in ([1, 0, 0, 1], [0, 1, 1, 0]):
        seen[10:14] = seen[24:28] = feet
        np.testing.assert_allclose(answer(before, seen), answer(after, seen), atol=1e-8)
