"""CiA 402's state machine as the master sees it: what to tell a drive next so that it comes to be as wanted.

Pure logic; who waits, and for how long, is the caller's matter.
"""

from __future__ import annotations

from enum import Enum, auto

from backends.controller.can.objects import Control, State


class Goal(Enum):
    """What a drive is wanted to be."""

    OFF = auto()
    """Switch-on disabled. Never by way of a fault's reset."""
    ON = auto()
    """Operation enabled, one step after the other; a drive in fault is left there."""
    QUICK_STOP = auto()
    """Stand by the quick stop ramp, and stay so; a drive that has no power gets none."""
    RESET = auto()
    """Out of fault, to switch-on disabled."""


_TOWARDS_ON = {
    State.SWITCH_ON_DISABLED: Control.SHUTDOWN,
    State.READY: Control.SWITCH_ON,
    State.SWITCHED_ON: Control.ENABLE_OPERATION,
    State.OPERATION_ENABLED: Control.ENABLE_OPERATION,
    State.QUICK_STOP: Control.ENABLE_OPERATION,
}


def next_controlword(state: State, goal: Goal, last: int) -> int:
    """The controlword that leads from ``state`` a step towards ``goal``; ``last`` is the one sent before.

    A fault is reset by the rising edge of bit 7, so another word goes before it; the bit then stays until the drive
    has left the fault, so that there is one edge and not one in each cycle.
    """
    if goal is Goal.RESET and state is State.FAULT:
        return (
            Control.FAULT_RESET if last in (Control.DISABLE_VOLTAGE, Control.FAULT_RESET) else Control.DISABLE_VOLTAGE
        )
    if goal is Goal.ON:
        return _TOWARDS_ON.get(state, Control.DISABLE_VOLTAGE)
    if goal is Goal.QUICK_STOP:
        moving = state in (State.OPERATION_ENABLED, State.QUICK_STOP)
        return Control.QUICK_STOP if moving else Control.DISABLE_VOLTAGE
    # Shutdown lets the drive slow down and set its brake; without voltage at once, it would coast.
    return Control.SHUTDOWN if state is State.OPERATION_ENABLED else Control.DISABLE_VOLTAGE


def is_reached(state: State, goal: Goal) -> bool:
    """Whether a drive in ``state`` is as wanted."""
    if goal is Goal.ON:
        return state is State.OPERATION_ENABLED
    if goal is Goal.QUICK_STOP:
        return state is not State.OPERATION_ENABLED
    return state is State.SWITCH_ON_DISABLED
