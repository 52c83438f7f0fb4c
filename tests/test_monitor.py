"""Monitor and health: shares of what happened, and a check that turns red for every fault that is put in."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from scenes import robot

from runtime.control.records import Clamp, SolverStatus
from runtime.messages.mode import Mode
from runtime.messages.status import Status
from runtime.messages.tick import TICK_DTYPE
from station.monitor import CLAMP_WORDS, Check, Level, draw_table, examine, summarise, wires_in_words

PEAK = np.array(robot().robot.joints.peak_torque)
N = 400


def healthy() -> np.ndarray:
    ticks = np.zeros(N, TICK_DTYPE)
    ticks["index"] = np.arange(N)
    ticks["stamp"] = 100.0 + np.arange(N) / 200
    ticks["period"], ticks["compute"], ticks["voltage"] = 0.005, 3e-4, 24.0
    ticks["joint_temperature"] = 30.0
    return ticks


def status(**changes: Any) -> Status:
    values = dict.fromkeys(Status.__struct_fields__, 0) | {
        "robot": "stoch3",
        "mode": "STAND",
        "fault": "",
        "reason": "",
        "health": "",
    }
    triples = dict.fromkeys(("velocity_command", "velocity", "rpy"), (0.0, 0.0, 0.0))
    return msgspec.convert(
        values
        | triples
        | {"armed": True, "policy": "", "rate_hz": 200.0, "clamps": {}, "solver": {}}
        | {"recordings_refused": {}, "refused": {}, "wires": {}, "evidence": None}
        | changes,
        Status,
    )


def levels(ticks: np.ndarray, lost: int = 0, **changes: Any) -> dict[str, Level]:
    return {check.name: check.level for check in examine(ticks, status(**changes), robot(), lost)}


def test_a_healthy_robot_has_nothing_to_report() -> None:
    assert set(levels(healthy()).values()) == {Level.OK}


FAULTS: dict[str, tuple[str, Any]] = {
    "motors": ("joint_age", 0.05),
    "imu": ("imu_stamp", -0.05),
    "temperature": ("joint_temperature", 81.0),
    "supply": ("voltage", -1.0),
    "compute": ("compute", 0.006),
    "solver": ("solver_status", SolverStatus.LEAST_SQUARES),
}


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_turns_its_own_check_and_no_other(name: str) -> None:
    field, value = FAULTS[name]
    ticks = healthy()
    ticks[field][-30 if name != "compute" else 0 :] = value
    found = levels(ticks)
    assert found.pop(name) is Level.BAD
    assert set(found.values()) == {Level.OK}


@pytest.mark.parametrize("field", ["joint_age", "joint_temperature", "compute"])
def test_what_is_not_a_number_is_bad(field: str) -> None:
    ticks = healthy()
    ticks[field][-1] = np.nan
    assert Level.BAD in levels(ticks).values()


def test_a_slow_robot_is_told_from_a_lossy_link() -> None:
    slow = healthy()
    slow["stamp"] = 100.0 + np.arange(N) / 150
    slow["overruns"] = np.arange(N) // 3
    found = levels(slow)
    assert found["rate"] is found["deadlines"] is Level.BAD and found["link"] is Level.OK
    lossy = healthy()[::3]
    found = levels(lossy, lost=N - len(lossy))
    assert found["rate"] is Level.OK and found["link"] is Level.BAD


def test_a_few_slow_ticks_are_a_warning_as_long_as_most_are_quick() -> None:
    ticks = healthy()
    ticks["compute"][-30:] = 0.006
    assert levels(ticks)["compute"] is Level.WARNING


def test_a_fault_that_stands_is_bad() -> None:
    assert levels(healthy(), fault="tilted too far")["mode"] is Level.BAD


def test_every_clamp_has_words_and_its_share_of_the_ticks() -> None:
    assert set(CLAMP_WORDS) == set(Clamp)
    ticks = healthy()
    ticks["mode"] = Mode.WALK
    ticks["clamps"][:100] = Clamp.FRICTION | Clamp.TORQUE
    ticks["clamps"][100:200] = Clamp.TORQUE
    ticks["joint_torque"][7, 2, 1] = -0.5 * PEAK[1]
    ticks["asked"][:, 14], ticks["action"][:, 14] = 300.0, 250.0
    summary = summarise(ticks, PEAK)
    assert summary.clamps == {CLAMP_WORDS[Clamp.FRICTION]: 0.25, CLAMP_WORDS[Clamp.TORQUE]: 0.5}
    assert (summary.torque_joint, summary.torque_share) == ("BL hip", 0.5)
    assert summary.wrench[2].asked == 300.0 and summary.wrench[2].applied == 250.0
    assert draw_table(summary).row_count > 10
    assert msgspec.json.decode(msgspec.json.encode(summary), type=type(summary)) == summary


def test_checks_travel_as_json() -> None:
    checks = examine(healthy(), status(), robot(), 0)
    assert msgspec.json.decode(msgspec.json.encode(checks), type=list[Check]) == checks


def test_what_goes_wrong_on_the_wires_is_a_warning_when_it_is_more_than_one_in_a_thousand() -> None:
    ticks = healthy()
    found = [
        {check.name: check.level for check in examine(ticks, status(ticks=100_000, wires=wires), robot(), 0)}["wires"]
        for wires in ({"replies late": 90}, {"replies late": 90, "bus-off": 20})
    ]
    assert found == [Level.OK, Level.WARNING]
    assert wires_in_words(status(wires={"replies late": 90, "bus-off": 2})) == "90 replies late, 2 bus-off"
