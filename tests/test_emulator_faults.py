"""What goes wrong in an emulated controller: by name, at its moment, and so that its client can tell."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from backends.controller.emulator.faults import FAULTS, Fault, FaultSchedule, Moment, parse_fault
from dualcal_hal.clock import RealClock, VirtualClock
from dualcal_hal.errors import UsageError
from tests.simple_message_client import PATIENCE, serving

ARMS = ("left", "right")
PING, POINT = 1, 11
AWAY = np.array([0.1, -0.05, 0.05, 0.1, 0.05, -0.15])
WHOLE = {148 * joints + 44 * status for joints in range(30) for status in range(95)}
"""Sizes in bytes of whole states, also of many that a client reads at once."""


# On the command line


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("estop@12.5", Fault("estop", None, Moment("after", 12.5), None)),
        ("estop:left@motion:3", Fault("estop", "left", Moment("motion", 3), None)),
        ("drop:right@point:7", Fault("drop", "right", Moment("point", 7), None)),
        ("stale@0~2.5", Fault("stale", None, Moment("after", 0.0), 2.5)),
        ("lost-link:left@1", Fault("lost-link", "left", Moment("after", 1.0), 3.0)),
    ],
)
def test_a_fault_has_a_name_a_moment_and_maybe_an_arm_and_an_end(text: str, fault: Fault) -> None:
    assert parse_fault(text, ARMS) == fault


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("explode@1", "there is no fault 'explode'"),
        ("estop", "say when"),
        ("estop:middle@1", "there is no arm 'middle'"),
        ("estop@soon", "'soon' is no time"),
        ("estop@-1", "'-1' is no time"),
        ("estop@inf", "'inf' is no time"),
        ("estop@motion:0", "'motion:0' is no moment"),
        ("estop@motion:x", "'motion:x' is no moment"),
        ("estop@1~", "'' is no time"),
    ],
)
def test_what_is_no_fault_is_said(text: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        parse_fault(text, ARMS)


# At its moment


class Struck:
    """Who is hit by a fault, and notes it."""

    def __init__(self, text: str) -> None:
        self.clock = VirtualClock()
        self.lines: list[str] = []
        self.notes: list[str] = []
        self.schedule = FaultSchedule([parse_fault(text, ARMS)], self.clock, self.lines.append)
        for arm in ARMS:
            self.schedule.attach("stale", arm, lambda arm=arm: self._begin(arm))  # type: ignore[misc]
        self.schedule.start()

    def _begin(self, arm: str) -> object:
        self.notes.append(f"{arm} {self.clock.now():g}")
        return lambda: self.notes.append(f"end of {arm} {self.clock.now():g}")

    def pass_time(self, until: float) -> None:
        self.clock.wait(threading.Event(), until)

    def move(self, arm: str) -> None:
        self.schedule.moved(type("Arm", (), {"name": arm})())  # type: ignore[arg-type]


def test_it_comes_after_seconds_to_both_arms_or_the_one_named() -> None:
    struck = Struck("stale@2")
    struck.pass_time(1.9)
    assert struck.notes == []
    struck.pass_time(9.0)
    assert struck.notes == ["left 2", "right 2"]
    one = Struck("stale:right@2")
    one.pass_time(9.0)
    assert one.notes == ["right 2"]


def test_it_ends_where_it_is_to() -> None:
    struck = Struck("stale:left@2~3")
    struck.pass_time(9.0)
    assert struck.notes == ["left 2", "end of left 5"]
    assert [line.split(",")[0] for line in struck.lines] == ["fault: stale of left", "fault: stale of left has ended"]


def test_it_comes_within_a_motion_of_any_arm_or_of_the_one_named() -> None:
    for text, notes in (("stale@motion:2", ["right 0.1"]), ("stale:left@motion:2", ["left 0.1"])):
        struck = Struck(text)
        for arm in ("left", "right", "left", "left"):
            struck.move(arm)
        struck.pass_time(1.0)
        assert struck.notes == notes


def test_it_comes_as_a_point_comes() -> None:
    struck = Struck("stale:left@point:2")
    for arm in ("left", "right"):
        struck.schedule.pointed(arm)
    assert struck.notes == []
    for _ in range(3):
        struck.schedule.pointed("left")
    assert struck.notes == ["left 0"]


def test_it_does_not_come_once_all_is_over() -> None:
    struck = Struck("stale@2")
    struck.schedule.close()
    struck.pass_time(9.0)
    assert struck.notes == []


def test_a_fault_that_this_controller_cannot_have_is_refused() -> None:
    schedule = FaultSchedule([parse_fault("sdo-abort@1", ARMS)], RealClock(), lambda line: None)
    schedule.attach("stale", "left", lambda: None)
    with pytest.raises(UsageError, match=r"sdo-abort.*it has: stale"):
        schedule.start()


# On the wires


def test_drop_leaves_out_a_reply() -> None:
    with serving(fault="drop:left@point:1") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        client.motion.settimeout(0.2)
        client.send(POINT, client.point(0, home, duration=0.1))
        with pytest.raises(TimeoutError):
            client.motion.recv(1)
        client.motion.settimeout(PATIENCE)
        assert client.ask(PING, bytes(40))[0] == PING


def test_delay_makes_a_reply_late() -> None:
    with serving(fault="delay:left@point:1") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        begin = rig.world.clock.now()
        client.ask(POINT, client.point(0, home, duration=0.1))
        assert rig.world.clock.now() - begin > 0.9


@pytest.mark.parametrize(("fault", "whole"), [("split", False), ("merge", True)])
def test_messages_come_in_other_pieces(fault: str, whole: bool) -> None:
    with serving(fault=f"{fault}:left@0") as rig:
        rig.wait(lambda: rig.lines)
        client = rig.client()
        pieces = [len(client.state.recv(4096)) for _ in range(4 if whole else 40)]
        assert (min(pieces) > 150) if whole else (set(pieces) - WHOLE)


def test_corrupt_overwrites_a_states_bytes() -> None:
    with serving(fault="corrupt:left@point:1") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        client.next_status()
        client.ask(POINT, client.point(0, home, duration=0.1))
        lengths = [client.next_length() for _ in range(20)]
        assert max(map(abs, lengths)) > 10**6


def test_half_open_connections_are_silent_and_new_ones_are_not() -> None:
    with serving(fault="half-open:left@point:1") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        assert client.state.recv(1)  # by now it is accepted: what waits to be so when the fault strikes counts as new
        client.send(POINT, client.point(0, home, duration=0.1))
        rig.wait(lambda: rig.lines)
        client.motion.settimeout(0.2)
        client.send(PING, bytes(40))  # nobody says that it does not arrive
        with pytest.raises(TimeoutError):
            client.motion.recv(1)
        client.state.settimeout(0.2)
        with pytest.raises(TimeoutError):
            client.receive_until_the_end()
        assert rig.client().ask(PING, bytes(40))[0] == PING


def test_stale_states_do_not_come_and_then_come_again() -> None:
    with serving(fault="stale:left@point:1~2") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        client.ask(POINT, client.point(0, home, duration=0.1))
        client.state.settimeout(0.2)
        with pytest.raises(TimeoutError):
            client.receive_until_the_end()
        client.state.settimeout(PATIENCE)
        assert client.state.recv(4096)
        assert client.ask(PING, bytes(40))[0] == PING


@pytest.mark.parametrize(
    ("fault", "seen"),
    [
        ("estop", lambda status: status[:2] == (0, 1) and status[6] == 0),
        ("mode", lambda status: status[5] == 1 and status[6] == 0),
        ("drive-fault", lambda status: status[3] == 1 and status[2] != 0 and status[6] == 0),
    ],
)
def test_a_controller_stops_its_arm_and_says_why(fault: str, seen: object) -> None:
    with serving(fault=f"{fault}:left@motion:1") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        assert client.ask(POINT, client.point(0, home + 5 * AWAY, duration=3.0))[2] == 1
        client.status_with(seen)  # type: ignore[arg-type]
        stands = rig.settled()
        assert np.max(np.abs(stands - home - 5 * AWAY)) > 0.1
        assert client.ask(POINT, client.point(0, home, duration=1.0))[2] == 2
        assert rig.client("right").next_status()[6] == 1  # the other controller's is another


def test_an_emergency_stop_can_be_released() -> None:
    with serving(fault="estop:left@point:1~0.2") as rig:
        client = rig.client()
        client.next_status()  # from here on it is sent all of them
        client.ask(POINT, client.point(0, rig.cell.cell.active.home, duration=0.1))
        client.status_with(lambda status: status[1] == 1)
        assert client.status_with(lambda status: status[1] == 0)[6] == 1


def test_a_lost_link_is_back_after_a_while() -> None:
    with serving(fault="lost-link:left@point:1~2") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        client.send(POINT, client.point(0, home + AWAY, duration=0.5))
        with pytest.raises(ConnectionError):
            client.receive_until_the_end()
        with pytest.raises(ConnectionRefusedError):
            rig.connect("left", "motion_port")
        assert rig.client("right").next_status()
        rig.wait(lambda: len(rig.lines) == 2)
        assert _reachable(rig.connect)
        assert rig.client().next_status()[6] == 1


def _reachable(connect: object) -> bool:
    clock, never = RealClock(), threading.Event()
    for _ in range(200):
        try:
            connect("left", "motion_port")  # type: ignore[operator]
            return True
        except ConnectionRefusedError:
            clock.wait(never, clock.now() + 0.02)
    return False


def test_parts_that_touch_are_an_error_of_both_controllers() -> None:
    with serving("dialect: rep", "simulation.stepper=bullet") as rig:
        left, right = rig.client(), rig.client("right")
        down = rig.cell.cell.active.home + np.array([0, -1.85, 0, 0, 0, 0])
        assert left.ask(POINT, left.point(0, down, duration=1.5))[2] == 1
        for client in (left, right):
            status = client.status_with(lambda status: status[3] == 1)
            assert status[2] != 0
        assert right.ask(POINT, right.point(0, rig.cell.cell.passive.home, duration=1.0))[2] == 2


def test_every_fault_is_told_what_it_does() -> None:
    for name in FAULTS:
        assert parse_fault(f"{name}@1", ARMS).name == name
