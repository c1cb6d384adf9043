"""The state machine as the master leads it: to where it is wanted, and nowhere by itself."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from backends.controller.can.drive import Goal, is_reached, next_controlword
from backends.controller.can.objects import Control, State
from tests.small_drive import SmallDrive

STATES = list(State)
BITS = {
    State.SWITCH_ON_DISABLED: 0x40,
    State.READY: 0x21,
    State.SWITCHED_ON: 0x23,
    State.OPERATION_ENABLED: 0x27,
    State.QUICK_STOP: 0x07,
    State.FAULT: 0x08,
}
OF_BITS = {bits: state for state, bits in BITS.items()}


def led(state: State, goal: Goal, cycles: int = 8) -> tuple[list[int], State]:
    """The controlwords that a drive in ``state`` is told, and where it comes to."""
    drive = SmallDrive(1)
    drive.state = BITS[state]
    words, last = [], 0x0F
    for _ in range(cycles):
        last = next_controlword(OF_BITS[drive.state], goal, last)
        words.append(int(last))
        drive.control(last)
    return words, OF_BITS[drive.state]


def test_a_drive_is_enabled_step_by_step():
    words, state = led(State.SWITCH_ON_DISABLED, Goal.ON, 4)
    assert words == [0x06, 0x07, 0x0F, 0x0F]
    assert state is State.OPERATION_ENABLED


def test_a_drive_is_switched_off_by_shutdown_and_then_without_voltage():
    words, state = led(State.OPERATION_ENABLED, Goal.OFF, 3)
    assert words == [0x06, 0x00, 0x00]
    assert state is State.SWITCH_ON_DISABLED


def test_a_fault_is_reset_by_one_rising_edge_and_the_drive_stays_off():
    words, state = led(State.FAULT, Goal.RESET, 4)
    assert words == [0x00, 0x80, 0x00, 0x00]
    assert state is State.SWITCH_ON_DISABLED


def test_a_fault_that_lasts_sees_one_edge_alone():
    words, last = [], 0x0F
    for _ in range(6):
        last = next_controlword(State.FAULT, Goal.RESET, last)
        words.append(int(last))
    assert words == [0x00, 0x80, 0x80, 0x80, 0x80, 0x80]


@pytest.mark.parametrize("goal", [Goal.OFF, Goal.ON, Goal.QUICK_STOP])
@given(last=st.integers(0, 0xFFFF))
def test_no_other_goal_resets_a_fault(goal, last):
    for state in (State.FAULT, State.FAULT_REACTION):
        assert next_controlword(state, goal, last) == Control.DISABLE_VOLTAGE


def test_a_quick_stop_stops_what_is_enabled_and_enables_nothing():
    assert led(State.OPERATION_ENABLED, Goal.QUICK_STOP)[1] is State.QUICK_STOP
    for state in (State.READY, State.SWITCHED_ON, State.SWITCH_ON_DISABLED):
        assert led(state, Goal.QUICK_STOP)[1] is State.SWITCH_ON_DISABLED


def test_the_operator_enables_out_of_a_quick_stop():
    assert led(State.QUICK_STOP, Goal.ON)[1] is State.OPERATION_ENABLED


@pytest.mark.parametrize("state", [state for state in BITS if state is not State.FAULT])
@pytest.mark.parametrize("goal", list(Goal))
def test_each_goal_is_reached_from_each_state(state, goal):
    assert is_reached(led(state, goal)[1], goal)


@given(state=st.sampled_from(STATES), goal=st.sampled_from([Goal.OFF, Goal.QUICK_STOP, Goal.RESET]))
def test_only_one_goal_ever_enables_operation(state, goal):
    assert next_controlword(state, goal, 0) != Control.ENABLE_OPERATION
