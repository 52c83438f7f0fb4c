"""The phase clock: tables of six gaits, standing, early and late contact."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import Workbench

from runtime.control.gait import GAITS, advance_gait, gait_table

SWINGING_GAITS = [name for name in GAITS if name != "stand"]
SIDE_OF = {  # which legs begin their swing together, in order of their turn
    "trot": [{0, 3}, {1, 2}],
    "walk": [{2}, {0}, {3}, {1}],
    "pace": [{0, 2}, {1, 3}],
    "bound": [{0, 1}, {2, 3}],
    "pronk": [{0, 1, 2, 3}],
}


def bench(name: str = "trot", **gait: object) -> Workbench:
    known = Workbench(gait={"name": name, **gait})
    known.s.clock, known.s.stance = 1.0 - 1e-9, 1
    known.s.contacts = 1
    return known


def run(known: Workbench, ticks: int, contacts: object = "ideal", standing: bool = False) -> dict[str, np.ndarray]:
    """Advance; an ideal foot feels the ground exactly while it does not swing."""
    rows: dict[str, list[np.ndarray]] = {"stance": [], "phase": [], "swinging": [], "searching": []}
    for _ in range(ticks):
        known.s.contacts = 1 - known.s.swinging if isinstance(contacts, str) else contacts
        advance_gait(known.p, known.s, known.t, standing)
        for name, row in rows.items():
            row.append(np.array(getattr(known.t if name in ("stance", "phase") else known.s, name)))
    return {name: np.array(row) for name, row in rows.items()}


@pytest.mark.parametrize("name", SWINGING_GAITS)
def test_duty_factor_and_swing_time(name: str) -> None:
    known = bench(name)
    _, swing, stance = gait_table(known.config.gait)
    cycle = round((swing + stance) / known.p.dt)
    found = run(known, 20 * cycle)["stance"]
    assert found.mean() == pytest.approx(stance / (swing + stance), abs=1.01 / cycle)
    for leg in range(4):
        lifts = np.flatnonzero(np.diff(found[:, leg].astype(int)) == -1)
        assert np.ptp(np.diff(lifts)) <= 1 and np.diff(lifts).mean() == pytest.approx(cycle, abs=0.1)


@pytest.mark.parametrize("name", SWINGING_GAITS)
def test_legs_take_turns_in_the_gaits_order(name: str) -> None:
    known = bench(name)
    cycle = round(float(known.p.cycle_time) / float(known.p.dt))
    lifts: dict[int, set[int]] = {}
    before = np.zeros(4)
    for tick in range(cycle):
        known.s.contacts = 1 - known.s.swinging
        advance_gait(known.p, known.s, known.t, False)
        for leg in np.flatnonzero(known.s.swinging > before):
            lifts.setdefault(tick, set()).add(int(leg))
        before = known.s.swinging.copy()
    order = [lifts[tick] for tick in sorted(lifts)]
    turns = SIDE_OF[name]
    assert order in [turns[i:] + turns[:i] for i in range(len(turns))]


def test_duty_factors_are_those_of_the_field() -> None:
    duty = {}
    for name in SWINGING_GAITS:
        _, swing, stance = gait_table(bench(name).config.gait)
        duty[name] = stance / (swing + stance)
    assert duty == pytest.approx({"trot": 0.5, "walk": 0.75, "pace": 0.5, "bound": 0.6, "pronk": 0.5})


def test_walk_never_lifts_two_legs_and_trot_never_less_than_two_stand() -> None:
    """But for the one tick in which a foot that has just come down is not felt yet."""
    for name, least in (("walk", 3), ("trot", 2)):
        few = run(bench(name), 800)["stance"].sum(axis=1) < least
        assert few.mean() < 0.03 and not (few[1:] & few[:-1]).any(), name


def test_stand_never_swings() -> None:
    assert run(bench("stand"), 300)["stance"].all()


@pytest.mark.parametrize("name", SWINGING_GAITS)
def test_phase_grows_from_zero_to_pi_in_a_swing_and_is_pi_otherwise(name: str) -> None:
    found = run(bench(name), 300)
    assert (found["phase"] >= 0).all() and (found["phase"] <= np.pi).all()
    assert (found["phase"][found["swinging"] == 0] == np.pi).all()
    both = (found["swinging"][1:] == 1) & (found["swinging"][:-1] == 1)
    assert (np.diff(found["phase"], axis=0)[both] > 0).all()
    first = (found["swinging"][1:] == 1) & (found["swinging"][:-1] == 0)
    assert (found["phase"][1:][first] < 0.15 * np.pi).all()


@pytest.mark.parametrize("name", SWINGING_GAITS)
@pytest.mark.parametrize("into", [0, 7, 23, 41, 77])
def test_no_swing_begins_while_standing_and_a_begun_one_ends(name: str, into: int) -> None:
    known = bench(name)
    run(known, into)
    before = known.s.swinging.copy()
    found = run(known, 400, standing=True)
    assert (np.diff(np.vstack([before, found["swinging"]]).astype(int), axis=0) <= 0).all()
    assert found["stance"][-1].all()
    moving = run(known, 60)
    assert not moving["stance"].all(), "walks again after standing"


def test_early_contact_after_mid_swing_makes_the_leg_stance() -> None:
    known = bench()
    found = run(known, 40, contacts=np.ones(4))
    swing = round(float(known.p.swing_time) / float(known.p.dt))
    lasted = found["swinging"][:swing, 0].sum()
    assert swing / 2 <= lasted <= swing / 2 + 2
    assert found["stance"][lasted + 1 : swing, 0].all()


def test_early_contact_is_ignored_where_switched_off() -> None:
    known = bench(early_contact=False)
    swing = round(float(known.p.swing_time) / float(known.p.dt))
    assert run(known, swing - 1, contacts=np.ones(4))["swinging"][:, 0].all()


def test_a_foot_that_finds_no_ground_searches_and_is_not_loaded_until_it_does() -> None:
    known = bench()
    swing = round(float(known.p.swing_time) / float(known.p.dt))
    run(known, swing + 5, contacts=np.zeros(4))
    assert known.s.searching[0] and not known.t.stance[0]
    known.s.contacts = (1, 0, 0, 1)
    advance_gait(known.p, known.s, known.t, False)
    assert not known.s.searching[0] and known.t.stance[0]


def test_a_searching_leg_swings_again_at_its_next_turn() -> None:
    known = bench()
    cycle = round(float(known.p.cycle_time) / float(known.p.dt))
    found = run(known, cycle + 5, contacts=np.zeros(4))
    assert found["searching"][cycle - 2, 0] and found["swinging"][-1, 0] and not found["searching"][-1, 0]


def test_a_stance_leg_whose_foot_lifted_searches_and_is_not_loaded() -> None:
    bench = Workbench()
    bench.s.stance[:] = 1
    bench.s.contacts[:] = (0, 1, 1, 1)
    bench.s.lifted[0] = 1
    advance_gait(bench.p, bench.s, bench.t, True)
    assert bench.t.stance.tolist() == [0, 1, 1, 1]
    bench.s.lifted[0], bench.s.contacts[0] = 0, 1
    advance_gait(bench.p, bench.s, bench.t, True)
    assert bench.t.stance.tolist() == [1, 1, 1, 1]
