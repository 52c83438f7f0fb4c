"""The tour's client against a real daemon on the simulated body, in real time; and its judgement."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest
from daemons import Served, make_config

from runtime.messages.mode import Mode
from runtime.recording import load
from station import tour
from station.session import Station
from station.tour import Leg, Tour, TourReport, plan_tour
from trotd.bodies import build_body

SLOWER = {
    "posture__soft_start": 0.3,
    "posture__fold_time": 0.4,
    "posture__rise_time": 0.8,
    "posture__settle_time": 0.1,
    "posture__blend_time": 0.2,
    "recorder__seconds": 30.0,
}


def drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, legs: list[Leg]) -> tuple[TourReport, Served]:
    made = make_config(**SLOWER)
    monkeypatch.setattr(tour, "plan_tour", lambda _config: legs)
    body = build_body("sim", made, tmp_path / "none.toml", tmp_path)

    def act(station: Station) -> TourReport:
        with Tour(station, made, lambda _status, _activity: None) as client:
            return client.drive()

    async def main() -> tuple[TourReport, Served]:
        served = Served(made, tmp_path, body.robot, body.channels)
        async with served:
            return await served.client(act), served

    return asyncio.run(main())


def test_it_walks_takes_a_push_and_sits_down(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    legs = [Leg("forward", (0.4, 0.0, 0.0), 3.5), Leg("push", (0.0, 0.0, 0.0), 3.5, 0.5)]
    report, served = drive(tmp_path, monkeypatch, legs)
    assert report.problems == []
    forward, push = report.legs
    assert not forward.falls and not push.falls
    assert forward.measured[0] == pytest.approx(0.4, abs=0.1)
    assert push.roll > 2.0 * forward.roll, "the push was felt"
    assert forward.estimator_rmse < 0.1
    ticks = load(served.daemon.flight.written[-1]).ticks
    assert [Mode(mode) for mode in ticks["mode"][np.flatnonzero(np.diff(ticks["mode"], prepend=255))]] == [
        Mode.DAMP,
        Mode.STAND_UP,
        Mode.STAND,
        Mode.WALK,
        Mode.STAND,
        Mode.SIT_DOWN,
        Mode.DAMP,
    ]
    assert ticks["height"][ticks["mode"] == Mode.WALK].min() > 0.45


def test_a_robot_that_falls_fails_the_tour(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    report, served = drive(tmp_path, monkeypatch, [Leg("shove", (0.0, 0.0, 0.0), 4.0, 6.0)])
    assert not report.passed
    assert report.legs[0].falls == 1
    assert any("tilted" in problem or "fell" in problem for problem in report.problems)
    assert served.daemon.cycle.state.mode is Mode.DAMP


def test_the_plan_is_the_whole_tour_scaled_to_the_robot() -> None:
    legs = plan_tour(make_config(tour__speed_scale=0.5))
    commanded = {leg.velocity for leg in legs}
    for velocity in ((0.2, 0, 0), (0.4, 0, 0), (-0.2, 0, 0), (0, 0.15, 0), (0, -0.15, 0), (0, 0, 0.8), (0, 0, -0.8)):
        assert velocity in commanded
    assert (0.25, 0.1, 0.5) in commanded
    assert sorted(leg.push for leg in legs if leg.push) == [-0.5, 0.5]
    assert sum(leg.seconds for leg in legs) < 60.0
