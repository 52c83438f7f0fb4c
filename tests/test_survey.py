"""Who is on the buses, asked without energising anything, whatever protocol they speak."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest
from bench_robot import Bench

from drivers.errors import DriverError
from drivers.survey import MitQuestion, MoteusQuestion, build_question, survey
from sim.mit_emulator import MitEmulator
from sim.moteus_emulator import MoteusEmulator

MIT_IDS = ((1, 2, 3), (4, 5, 6), (7, 8, 9), (10, 11, 12))


def find(bench: Bench, ids=None):
    return asyncio.run(survey(bench.bus, range(1, 5), build_question(bench.motors.config), ids))


def test_everybody_is_found_as_it_is_and_nobody_is_energised():
    bench = Bench()
    bench.servos[0].fail(38)
    bench.servos[1].position = 0.25
    bench.servos[2].silent = True
    found = {(motor.bus, motor.id): motor for motor in find(bench)}
    assert len(found) == 11
    assert "over-temperature" in found[1, 11].state
    assert found[1, 12].position == pytest.approx(np.pi / 2, abs=1e-4)
    assert (found[1, 12].voltage, found[1, 12].firmware, found[1, 12].replies) == (24.0, "0.1.6", 1)
    assert {servo.mode for servo in bench.servos} <= {0, 1}


@pytest.mark.parametrize(("model", "fault", "words"), [("DM4340", 9, "under-voltage"), ("AK80-9", 5, "encoder fault")])
def test_mit_motors_are_found_too_and_stay_disabled(model, fault, words):
    bench = Bench(protocol="mit", model=model, id=MIT_IDS)
    bench.servos[0].fault = fault
    bench.servos[1].sense(1.25, 0.0, 0.0, 41.0)
    bench.servos[2].silent = True
    bench.servos[3].enabled = True
    found = {(motor.bus, motor.id): motor for motor in find(bench)}
    assert len(found) == 11
    assert words in found[1, 1].state
    assert (found[1, 2].state, found[1, 2].temperature, found[1, 2].firmware) == ("disabled", 41.0, "")
    assert found[1, 2].position == pytest.approx(1.25, abs=1e-3)
    assert np.isnan(found[1, 2].voltage)
    assert not any(servo.enabled for servo in bench.servos)


def test_all_ids_of_the_protocol_are_tried_where_none_are_named():
    assert MitQuestion("DM4340").ids == range(1, 16)
    assert MitQuestion("AK80-9").ids == MoteusQuestion().ids == range(1, 127)
    bench = Bench()
    bench.bus.servos[3, 126] = MoteusEmulator(126)
    assert (4, 126) in {(motor.bus, motor.id) for motor in find(bench)}
    assert find(bench, [11]) == [motor for motor in find(bench) if motor.id == 11]


def test_two_motors_with_one_id_answer_twice():
    bench = Bench()
    bench.bus.servos[0, 99] = MoteusEmulator(11)
    assert {(m.bus, m.id): m.replies for m in find(bench)}[1, 11] == 2
    mit = Bench(protocol="mit", model="AK80-9", id=MIT_IDS)
    mit.bus.servos[0, 99] = MitEmulator(2, "AK80-9")
    assert {(m.bus, m.id): m.replies for m in find(mit)}[1, 2] == 2


def test_what_is_no_answer_is_nobody():
    bench = Bench()
    bench.bus.fault = lambda reply: [(reply[0], reply[1], b"\x2f\x01")]
    assert find(bench) == []
    bench.bus.fault = lambda reply: [(reply[0], reply[1] | 0x7F, reply[2])]
    assert find(bench) == []


def test_a_bus_that_is_missing_is_an_error_and_not_an_empty_table():
    bench = Bench()

    async def refuse(receive):
        raise DriverError("bus 1 (socketcan can0): no such device")

    bench.bus.open = refuse  # type: ignore[method-assign]
    with pytest.raises(DriverError, match="no such device"):
        find(bench)
