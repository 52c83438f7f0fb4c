"""The driver's rules: what sticks and buttons ask for, and when nothing may move."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from runtime.messages.mode import Mode, Request
from runtime.messages.motion import PoseMessage
from station.driving import LEVEL, STILL, Driving
from station.pad import Sticks

SHARE = st.floats(-1, 1)
STICKS = st.builds(Sticks, forward=SHARE, left=SHARE, turn=SHARE, held=st.booleans())
MODES = st.sampled_from([*Mode, None])


@given(st.lists(st.tuples(st.one_of(st.none(), STICKS), MODES), max_size=60))
def test_nothing_moves_before_the_sticks_were_centred_nor_without_the_dead_man(
    script: list[tuple[Sticks | None, Mode | None]],
) -> None:
    driving = Driving(1.0, 1.0, 1.0)
    centred_since_loss = False
    for sticks, mode in script:
        velocity = driving.velocity(sticks, mode)
        if mode is not Mode.WALK or sticks is None or (not sticks.held and not sticks.centred):
            centred_since_loss = False
        elif sticks.centred:
            centred_since_loss = True
        if mode is not Mode.WALK:
            assert velocity is None
        elif sticks is None or not sticks.held or not centred_since_loss:
            assert velocity == STILL
        else:
            assert velocity == (sticks.forward, sticks.left, sticks.turn)


@given(st.lists(st.tuples(st.one_of(st.none(), STICKS), MODES, st.booleans()), max_size=60))
def test_the_body_leans_only_in_stand_after_the_button_once_centred_with_the_dead_man(
    script: list[tuple[Sticks | None, Mode | None, bool]],
) -> None:
    driving = Driving(1.0, 1.0, 1.0)
    for sticks, mode, pressed in script:
        if pressed:
            said = driving.toggle_pose(mode)
            assert (said is None) == driving.posing and (not driving.posing or mode is Mode.STAND)
        before = driving.centred
        pose, velocity = driving.pose(sticks, mode), driving.velocity(sticks, mode)
        assert pose is None or velocity is None, "the sticks mean one thing"
        if mode is not Mode.STAND:
            assert pose is None
        if pose is not None and pose != LEVEL and sticks is not None and sticks.held:
            assert before or sticks.level or driving.centred


def test_the_sticks_lean_the_body_the_way_they_are_pushed_and_let_go_it_stays() -> None:
    driving = Driving(1.0, 1.0, 1.0)
    driving.toggle_pose(Mode.STAND)
    pushed = Sticks(forward=0.5, left=0.4, turn=0.3, rise=-0.2, held=True)
    assert driving.pose(pushed, Mode.STAND) == LEVEL, "the sticks were never centred"
    driving.pose(Sticks(held=True), Mode.STAND)
    assert driving.pose(pushed, Mode.STAND) == PoseMessage(roll=-0.3, pitch=0.5, yaw=0.4, height=-0.2)
    assert driving.pose(Sticks(held=False), Mode.STAND) == PoseMessage(-0.3, 0.5, 0.4, -0.2)
    assert driving.toggle_pose(Mode.STAND) == LEVEL
    assert driving.pose(pushed, Mode.STAND) is None


def test_the_gait_button_goes_through_the_mapping_s_gaits() -> None:
    driving = Driving(1.0, 1.0, 1.0, ("trot", "pace"))
    assert [driving.next_gait() for _ in range(3)] == ["pace", "trot", "pace"]


def test_standing_up_arms_only_with_the_dead_man_held() -> None:
    assert Driving.requests("stand", Sticks(held=False), armed=False) == [Request.STAND]
    assert Driving.requests("stand", None, armed=False) == [Request.STAND]
    assert Driving.requests("stand", Sticks(held=True), armed=False) == [Request.ARM, Request.STAND]
    assert Driving.requests("idle", None, armed=True) == [Request.DAMP]
