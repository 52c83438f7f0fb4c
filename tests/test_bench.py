"""The bench's own honesty: its corpus, its exact answers, its verdicts and what it prints."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime import config
from runtime.messages.mode import Mode
from runtime.messages.tick import TICK_DTYPE
from trotd.bench import codecs, command, link, qp, report, senses, tick, timer
from trotd.bench.corpus import KINDS, Corpus
from trotd.bench.daemon import Slice
from trotd.bench.exact import constraints, exact_forces, is_minimum
from trotd.bench.host import Window


def test_corpus_is_the_same_for_the_same_seed_and_has_every_kind_and_number_of_legs() -> None:
    first = list(Corpus(3).cases(400))
    again = list(Corpus(3).cases(400))
    other = list(Corpus(4).cases(400))
    assert [case.problem.gradient.tobytes() for case in first] == [case.problem.gradient.tobytes() for case in again]
    assert [case.problem.gradient.tobytes() for case in first] != [case.problem.gradient.tobytes() for case in other]
    assert set(Counter(case.kind for case in first)) == set(KINDS)
    assert {case.legs for case in first} == {0, 1, 2, 3, 4}


def test_corpus_has_problems_with_and_without_a_bound_that_binds() -> None:
    free = bound = 0
    for case in Corpus(3).cases(400):
        if case.legs > 0:
            slope = case.problem.hessian @ exact_forces(case.problem) + case.problem.gradient
            free, bound = free + (np.abs(slope).max() < 1e-8), bound + (np.abs(slope).max() > 1e-3)
    assert free > 40 and bound > 100


def test_exact_forces_are_no_worse_than_any_neighbour_in_the_feasible_set() -> None:
    rng = np.random.default_rng(0)
    for case in Corpus(5).cases(160):
        if case.legs <= 0:
            continue
        problem = case.problem
        best = exact_forces(problem)
        rows, limits = constraints(problem)
        assert (rows @ best - limits).max() <= 1e-9

        def cost(force: np.ndarray, q: Any = problem.hessian, c: Any = problem.gradient) -> float:
            return float(0.5 * force @ q @ force + c @ force)

        for size in (1e-3, 1.0, 100.0):
            other = (best + size * rng.normal(size=best.shape)).reshape(-1, 3)
            other[:, 2] = np.clip(other[:, 2], problem.min_force, problem.max_force)
            side = problem.friction * other[:, 2:]
            other[:, :2] = np.clip(other[:, :2], -side, side)
            assert cost(other.ravel()) >= cost(best) - 1e-9 * abs(cost(best))


def test_a_wrong_answer_proves_nothing() -> None:
    case = next(case for case in Corpus(5).cases(10) if case.legs == 2)
    best = exact_forces(case.problem)
    assert not is_minimum(case.problem, best + 1e-3, np.zeros(12))
    assert not is_minimum(case.problem, best, np.full(12, -1.0))


def test_force_section_on_a_small_corpus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(qp, "Corpus", lambda seed: _Few(seed))
    found = [finding for finding in qp.measure(quick=True) if isinstance(finding, report.Figure)]
    assert len(found) == 5
    assert all(figure.met for figure in found)


class _Few(Corpus):
    def cases(self, count: int) -> Any:
        return super().cases(160)


def figure(value: float, bound: float | None = None, sense: Any = "<=") -> report.Figure:
    return report.Figure("tick", "a step", value, "µs", bound, sense)


def test_a_bound_is_met_or_missed_in_its_sense() -> None:
    assert figure(1.0).met is None
    assert figure(1.0, 1.0).met is True and figure(1.1, 1.0).met is False
    assert figure(1.0, 1.0, ">=").met is True and figure(0.9, 1.0, ">=").met is False
    assert figure(float("nan"), 1.0).met is False


def test_a_missed_bound_fails_the_run_and_the_json_says_which(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    findings = [figure(1.0, 2.0), figure(3.0, 2.0), report.Missing("timer", "beside cyclictest", "not installed")]
    monkeypatch.setattr(command, "measure", lambda section, quick: iter(findings))
    assert not command.bench([command.Section.TICK], quick=True, json=True)
    rows = json.loads(capsys.readouterr().out)["figures"]
    assert [row.get("met") for row in rows] == [True, False, None]
    assert rows[2]["missing"] == "not installed"
    findings.pop(1)
    assert command.bench([command.Section.TICK], quick=True, json=False)
    assert "not installed" in capsys.readouterr().out


def test_without_the_tests_the_plain_form_is_missing_and_not_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tick, "PLAIN", Path("/nowhere/plain.py"))
    walked: Any = None
    (found,) = tick.against_plain(walked, 1)
    assert isinstance(found, report.Missing) and "plain.py" in found.why


def test_bars_are_not_drawn_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(report.shown(range(3), "counting", 3)) == [0, 1, 2]
    assert capsys.readouterr() == ("", "")


def test_a_command_counts_from_its_sending_to_the_first_tick_that_follows_it() -> None:
    ticks = np.zeros(6, TICK_DTYPE)
    ticks["stamp"] = np.arange(6) * 0.005
    ticks["asked_velocity"][:, 0] = (0.0, 0.1, 0.1, 0.3, 0.3, 0.3)
    sent = {0.1: 0.003, 0.2: 0.011, 0.3: 0.012}  # the second was overtaken before a tick took it
    assert list(link._applied(ticks, sent)) == pytest.approx([0.002, 0.003])


def test_an_e_stop_counts_to_the_first_damping_command_after_it() -> None:
    ticks = np.zeros(4, TICK_DTYPE)
    ticks["stamp"], ticks["compute"] = np.arange(4) * 0.005, 1e-4
    ticks["mode"] = (Mode.DAMP, Mode.WALK, Mode.WALK, Mode.DAMP)
    assert link._damped(ticks, 0.006) == pytest.approx(0.0151)


def test_the_senses_on_a_noisy_twin_hold_their_bounds() -> None:
    found = [finding for finding in senses.measure(quick=True) if isinstance(finding, report.Figure)]
    assert len(found) == 6
    assert [figure.name for figure in found if figure.met is False] == []


def test_codecs_do_the_same_work_on_both_sides_and_meet_nobody_asleep() -> None:
    loaded = config.load(config.find_robot("stoch3"))
    found = {f.name: f for f in (*codecs.against_moteus(loaded, 3), *codecs.against_plain_walk(3))}
    found |= {f.name: f for f in codecs.exchange(loaded, 20)}
    assert all(isinstance(f, report.Figure) and np.isfinite(f.value) for f in found.values())
    assert [f.bound for f in found.values() if f.bound is not None] == [0.1, 0.5, 150.0]
    assert found["left for wires and control at 200 Hz"].value < 5.0
    frame = codecs.measurement(7)
    assert len(frame) == 73
    damaged = b"noise" + frame[:20] + bytes([frame[20] ^ 1]) + frame[21:] + frame
    assert codecs.plain_walk(frame) == codecs.plain_walk(damaged)


def test_the_replies_that_are_decoded_are_the_makers_too() -> None:
    moteus = pytest.importorskip("moteus")
    said = moteus.parse_registers(codecs._reply(0.125, -0.5, 3.25)).response
    assert [said[register] for register in (0, 1, 2, 3)] == pytest.approx([10, 0.125, -0.5, 3.25])


def test_ticks_of_a_window_that_the_host_disturbed_do_not_count() -> None:
    stamp = np.arange(0.0, 3.0, 0.1)
    overruns = np.where(stamp < 1.05, 0, 4) + np.where(stamp > 2.45, 2, 0)  # four in the disturbed second, two after it
    ticks = np.zeros(len(stamp), TICK_DTYPE)
    whole = Slice(stamp.copy(), stamp.copy(), stamp, overruns, ticks)
    windows = [Window(-0.05, 0.95, 0.0), Window(0.95, 1.95, 0.02), Window(1.95, 2.95, 0.0)]
    calm = timer.undisturbed(whole, windows)
    assert calm.windows == 2
    assert calm.missed == 2
    np.testing.assert_array_equal(calm.lateness, np.r_[stamp[:10], stamp[20:30]])
