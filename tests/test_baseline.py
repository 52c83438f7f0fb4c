"""What the legs of a standing robot feign: found from ticks, taken off where contact is felt, kept in a recording."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from daemons import Probe, Served, make_config
from scenes import Workbench
from twin_walk import QUICK

from drivers import calibration
from drivers.calibration import CalibrationError
from drivers.commissioning import GRAVITY, CommissionError
from runtime import config
from runtime.control.contact import feel_contacts
from runtime.control.posture import Posture
from runtime.recording import list_recordings, load
from runtime.replay import Player
from sim.build import lab_build
from sim.scenario import Noise, Scenario
from station.session import Station
from trotd.bodies import build_body
from trotd.commission.baseline import find_baseline, listen
from trotd.lockstep import TwinWalk
from trotd.twin import true_calibration
from trotd.wire import calibration_file, own_wires, with_baseline

STOCH3 = config.load(config.find_robot("stoch3"))


def test_a_standing_robot_tells_what_its_legs_feign() -> None:
    """Torque sensors that are wrong by newton metres: taken off, the forces carry the weight where it is."""
    pose = Posture(STOCH3.robot, STOCH3.control, STOCH3.posture).folded_joints
    walk = TwinWalk(QUICK, Scenario(noise=Noise(joint_torque_bias=1.0), joint_position=pose, seed=4))
    walk.stand()
    walk.run(1.0)
    ticks, truth = [], []

    def note() -> None:
        ticks.append(walk.cycle.tick.copy())
        truth.append(walk.world.truth.foot_forces[:, 2])

    walk.run(0.5, each=note)
    recorded = np.concatenate(ticks)
    found = np.array(find_baseline(walk.config, recorded))
    felt = np.median(recorded["contact_force"][:, :, 2], axis=0)
    weight = walk.config.robot.mass * GRAVITY
    assert (felt - found).sum() == pytest.approx(weight, abs=1.0)
    diagonal = np.array([0.5, -0.5, -0.5, 0.5])
    error = felt - np.mean(truth, axis=0)
    assert np.abs(error).max() > 2.0
    assert found == pytest.approx(error - (error @ diagonal) * diagonal, abs=0.35 * np.abs(error).max())


def test_contact_is_felt_without_what_a_leg_feigns() -> None:
    bench = Workbench(contact={"threshold": 50.0, "baseline": [30.0, 0.0, 0.0, -30.0], "force_time_constant": 0.0})

    def feel(vertical: float) -> list[int]:
        bench.t.contact_force[:, 2] = vertical
        feel_contacts(bench.p, bench.s, bench.t, bench.m)
        return list(bench.s.contacts)

    assert feel(25.0) == [0, 0, 0, 1]
    assert feel(60.0) == [0, 1, 1, 1]
    assert feel(85.0) == [1, 1, 1, 1]


def test_it_listens_only_to_a_robot_that_stands(tmp_path: Path) -> None:
    async def live() -> None:
        made = make_config()
        async with Served(made, tmp_path, Probe(made)) as served:
            with pytest.raises(CommissionError, match="is DAMP, not in STAND: trotd arm, trotd stand"):
                await served.client(lambda station: listen(station, 0.2))
            await served.stand()

            def heard(station: Station) -> Any:
                while station.next_status().mode != "STAND":
                    pass
                return listen(station, 0.5)

            ticks = await served.client(heard)
            assert len(ticks) > 10

    asyncio.run(live())


def calibrated(folder: Path, **changes: object) -> Path:
    """A true calibration of stoch3, sealed after ``changes``."""
    made = true_calibration(lab_build(), STOCH3, own_wires(STOCH3).motors)
    path = calibration_file("hardware", STOCH3, folder)
    calibration.save(msgspec.structs.replace(made, **changes), path)
    return path


def test_the_daemon_takes_it_from_the_calibration(tmp_path: Path) -> None:
    assert with_baseline("hardware", STOCH3, tmp_path) is STOCH3
    calibrated(tmp_path, contact_baseline=(1.0, -2.0, 3.0, 0.5))
    assert with_baseline("hardware", STOCH3, tmp_path).control.contact.baseline == (1.0, -2.0, 3.0, 0.5)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (None, r"No such file or directory; run trotd commission"),
        ({"robot": "spot"}, "is of robot 'spot', this is 'stoch3'"),
        ({"body": "0" * 16}, "stale"),
        ({"version": calibration.VERSION + 1}, "is newer: format 2"),
    ],
)
def test_no_body_is_built_without_a_calibration_that_is_valid_for_it(tmp_path: Path, changes, words) -> None:
    if changes is not None:
        calibrated(tmp_path, **changes)
    with pytest.raises(CalibrationError, match=words):
        build_body("hardware", STOCH3, config.find_robot("stoch3"), tmp_path)


def test_a_recording_is_replayed_with_the_baseline_it_was_made_with(tmp_path: Path) -> None:
    async def live() -> Path:
        made = make_config(control__contact__baseline=[1.0, 2.0, 3.0, 4.0])
        async with Served(made, tmp_path, Probe(made)) as served:
            await served.stand()
        return list_recordings(served.daemon.flight.folder)[-1]

    recording = load(asyncio.run(live()))
    assert Player(recording).config.control.contact.baseline == (1.0, 2.0, 3.0, 4.0)
    older = replace(recording, header=msgspec.structs.replace(recording.header, config={}, robot_toml="x = 1"))
    with pytest.raises(ValueError, match="unknown field"):
        Player(older)
