"""An emulator tells when, after a fault, an arm was told to stop."""

from __future__ import annotations

import struct

import pytest

from backends.controller.emulator.braking import Braking
from tests.drive_rig import Rig
from tests.simple_message_client import serving

POINT, CONTROL = 11, 2001
STOP, STOP_MOTION = -4, 200111

FOLLOW, QUICK_STOP, HALT = 0x0F, 0x02, 0x10F


def seen(*told: tuple[int, int]) -> list[tuple[int, float]]:
    """With which SYNC it is seen, and since which, that one drive which is told this is being stopped."""
    braking = Braking()
    since = [braking.look(float(number), [each]) for number, each in enumerate(told)]
    return [(number, when) for number, when in enumerate(since) if when is not None]


def following(*targets: int) -> list[tuple[int, int]]:
    return [(FOLLOW, target) for target in targets]


def test_targets_that_come_to_rest_were_braked_since_they_came_slower() -> None:
    assert seen(*following(0, 10, 20, 30, 37, 41, 42, 42, 42, 42, 42)) == [(9, 4.0)]


def test_a_drive_that_stands_is_not_being_stopped() -> None:
    assert seen(*following(7, 7, 7, 7, 7, 7)) == []


def test_targets_held_for_a_cycle_are_not_braked() -> None:
    assert seen(*following(0, 10, 20, 20, 30, 40)) == []


def test_after_late_cycles_it_is_braked_since_it_goes_on_slower() -> None:
    assert seen(*following(0, 10, 20, 20, 25, 28, 29, 29, 29, 29)) == [(9, 5.0)]


@pytest.mark.parametrize("word", [QUICK_STOP, HALT, 0x00, 0x06])
def test_a_drive_that_is_to_follow_no_more_is_stopped_at_once(word: int) -> None:
    assert seen((0x06, 0), (FOLLOW, 0), (FOLLOW, 10), (word, 20)) == [(3, 3.0)]


def test_a_drive_that_has_rebooted_was_not_told_to_stop() -> None:
    rig = Rig(joints=2)
    rig.nmt(1)
    stops: list[float] = []
    rig.drives.on_stop = stops.append
    for node in (1, 2):
        rig.enable(node=node)
    for target in (10, 20, 30):
        rig.send(0x202, struct.pack("<Hbi", FOLLOW, 8, target))
        rig.cycle(FOLLOW, target)
    rig.drives.drives[1].reboot()
    for target in (40, 50, 60):
        rig.cycle(FOLLOW, target)
    assert stops == []


def test_drives_tell_of_it() -> None:
    rig = Rig()
    rig.nmt(1)
    stops: list[float] = []
    rig.drives.on_stop = stops.append
    rig.enable()
    for target in (10, 20, 25, 25, 25, 25):
        rig.cycle(FOLLOW, target)
    assert stops == [pytest.approx(rig.clock.now() - 0.04)]


@pytest.mark.parametrize(("dialect", "order"), [("rep", "<"), ("abb", "<"), ("fanuc", ">"), ("motoman", ">")])
def test_the_first_stop_after_a_fault_is_told(dialect: str, order: str) -> None:
    def stop() -> None:
        if dialect == "motoman":
            client.ask(CONTROL, client.command(STOP_MOTION))
        else:
            client.ask(POINT, client.point(STOP, ()))

    with serving(f"dialect: {dialect}", fault="estop:left@0.3", order=order) as rig:
        client = rig.client()
        stop()
        rig.wait(lambda: rig.lines)
        for _ in range(2):
            stop()
    assert [line.split(",")[0] for line in rig.lines] == ["fault: estop of left", "stop: left is told to"]


def test_a_stop_that_a_fanuc_does_not_read_has_come_all_the_same() -> None:
    with serving("dialect: fanuc", fault="estop:left@0", order=">") as rig:
        rig.wait(lambda: rig.lines)
        client = rig.client()
        client.ask(POINT, client.point(0, rig.cell.cell.active.home.tolist()))
        client.send(POINT, client.point(STOP, ()))
        rig.wait(lambda: len(rig.lines) == 2)
    assert rig.lines[1].startswith("stop: left is told to")
