"""Imitation compared like with like: who is judged, against whom, and what is not trained twice."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from runtime import config
from training.checkpoint import RunError
from training.evaluators import InProcess
from training.plan import IMITATE
from training.reference import Reference, ReferenceMismatch
from training.robot_reference import walked_by
from training.study import Imitated, study

KNOWN = config.load(config.find_robot("stoch3"))
TOY = msgspec.structs.replace(IMITATE, iterations=1, directions=1, ticks=20)
SHAPES = [("linear", 1), ("mlp", 1)]


@pytest.fixture(autouse=True)
def few_short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("training.study.DRAWS", 2)
    monkeypatch.setattr("training.study.FULL_LENGTH", 100)


@pytest.fixture(scope="module")
def reference() -> Reference:
    return walked_by("rigid-body", KNOWN)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


def trained(reference: Reference, runs: Path, rows: list[int]) -> Iterator[Imitated]:
    return study(KNOWN, reference, runs, SHAPES, InProcess, lambda row: rows.append(row.iteration), TOY)


def test_everybody_is_judged_beside_the_teacher_and_nothing_is_trained_twice(reference: Reference, runs: Path) -> None:
    rows: list[int] = []
    results = list(trained(reference, runs, rows))
    teacher, linear, neurons = results
    assert (teacher.name, teacher.numbers, teacher.of_teacher) == ("mpc", 0, 1.0)
    assert (linear.name, linear.numbers) == ("linear", 504)
    assert (neurons.name, neurons.numbers) == ("mlp", 736)
    for one in (linear, neurons):
        assert one.of_teacher == one.share / teacher.share
        assert one.share < teacher.share, "one toy iteration from nothing walks no better than the MPC"
    assert rows == [1, 1]
    assert list(trained(reference, runs, rows)) == results
    assert rows == [1, 1], "what the folder has is not trained again"


def test_a_run_of_another_teacher_is_not_taken_for_this_one(reference: Reference, runs: Path) -> None:
    list(trained(reference, runs, []))
    other = Reference(
        reference.robot, reference.config, "robot", reference.rate_hz, reference.features, reference.commands
    )
    with pytest.raises(RunError, match="linear-1 is a run of another plan"):
        list(trained(other, runs, []))


def test_an_unknown_teacher_is_refused() -> None:
    with pytest.raises(ReferenceMismatch, match="no teacher 'dog': rigid-body or robot"):
        walked_by("dog", KNOWN)
