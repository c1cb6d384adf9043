"""What goes wrong at a controller while its arms move: they stop, an error says where, and nothing moves unasked."""

from __future__ import annotations

import gc
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from backends.controller.can.configuration import HEARTBEAT_LOST
from backends.controller.tcp.dialects import STOP_BEHIND
from dualcal_hal.errors import CommandRefused, DeviceError
from tests.guarded_cell import ARMS, BUS, MOTION, MOVES, UNHURRIED_MS, UNMOVED, Emulating, Guarded, guarded, wired_cell
from tests.running import gone_on_with, kill, running
from tests.simple_message_client import PATIENCE
from tools.benchmarks.faults import cases, tried
from tools.cli.exits import INTERRUPTED

AWAY = (0.8, 0.1)
PING = 1
ENABLE = 0x0F
POINTS_LAST = STOP_BEHIND
BRAKING = 0.6
"""Seconds in which an arm comes to rest, on a machine that does more than that."""
HOME = tuple(map(float, wired_cell("rep").cell.active.home))


def test_a_drive_that_tells_an_emergency_stops_its_arm_by_name_and_code() -> None:
    with guarded("can") as cell:
        motion = cell.start("left", *AWAY)
        cell.served.faults.strike("emergency", "left")
        with pytest.raises(DeviceError, match=r"left: .*joint 2 \(node 2\).*0x4210"):
            motion.wait(PATIENCE)
        where = cell.comes_to_rest()
        assert "left" in cell.served.faults.stops
        cell.stays(where)


def test_no_search_of_a_large_heap_holds_up_drives_that_are_led() -> None:
    large = [[] for _ in range(1_000_000)]
    searched: list[int] = []

    def note(phase: str, info: dict[str, int]) -> None:
        if phase == "start" and info["generation"] == 2:
            led = any(thread.name == "left CAN cycle" for thread in threading.enumerate())
            searched.extend([len(gc.get_objects(generation=2))] if led else [])

    with on_collection(note), guarded("can") as cell:
        cell.start("left", *AWAY).wait(PATIENCE)
    assert max(searched, default=0) < len(large)


def test_the_lost_link_of_an_arm_that_stands_stops_the_one_that_moves() -> None:
    with guarded("rep") as cell:
        motion = cell.start("left", *AWAY)
        mend = cell.served.faults.strike("lost-link", "right")
        with pytest.raises(DeviceError, match=r"^right: "):
            motion.wait(PATIENCE)
        where = cell.comes_to_rest()
        assert cell.served.faults.stops[0] == "left"
        mend()
        cell.reads("right")
        cell.stays(where)
        cell.start("right", 0.2).wait(PATIENCE)


LINKS = [
    "rep",
    *(pytest.param(link, marks=pytest.mark.slow) for link in ("abb", "fanuc", "motoman", "can")),
]


@pytest.mark.parametrize("link", LINKS)
def test_a_server_that_is_restarted_within_a_move_gets_no_motion_but_the_next_that_is_asked_for(link: str) -> None:
    with guarded(link) as cell:
        motion = cell.start("left", *AWAY)
        cell.kill()
        with pytest.raises(DeviceError, match=r"left: "):
            motion.wait(PATIENCE)
        cell.serve("robots.left.home_deg=[20, 0, 60, 0, 30, 0]")
        state = cell.reads("left")
        assert np.rad2deg(state.positions[0]) == pytest.approx(20, abs=0.1)
        stays_where_it_is(cell, link)
        cell.enable()
        cell.start("left", -0.2).wait(PATIENCE)
        assert np.rad2deg(cell.reads("left").positions[0]) == pytest.approx(20 - np.rad2deg(0.2), abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("link", ["rep", "abb", "fanuc", "motoman", "can"])
def test_nor_does_one_that_is_restarted_between_moves(link: str) -> None:
    with guarded(link) as cell:
        cell.start("left", *AWAY).wait(PATIENCE)
        cell.kill()
        cell.wait(lambda: not is_there(cell))
        with pytest.raises(DeviceError, match=r"left: "):
            cell.arms["left"].start(cell.guard.path("left", HOME, (HOME,)))
        cell.serve()  # its arms are at home
        assert cell.reads("left").positions == pytest.approx(HOME, abs=1e-3)
        stays_where_it_is(cell, link)
        cell.enable()
        with pytest.raises(CommandRefused, match=r"left: move: it stands .* from where its last motion has ended"):
            cell.start("left", 0.2)
        cell.stays(cell.served.places())


@pytest.mark.slow
@pytest.mark.parametrize("link", ["rep", "can"])
def test_nor_does_one_in_another_process_that_is_killed_and_started_anew(link: str) -> None:
    cell, emulator = Guarded(link), Emulating(link)
    try:
        cell.reach(emulator.ports)
        cell.open()
        path = cell.guard.path("left", HOME, ((HOME[0] + AWAY[0], *HOME[1:]),))
        motion = cell.arms["left"].start(path)
        cell.reads("left", lambda state: abs(state.positions[0] - HOME[0]) > MOVES)
        emulator.kill()
        with pytest.raises(DeviceError, match=r"(left|right): "):
            motion.wait(PATIENCE)
        emulator = Emulating(link, "robots.left.home_deg=[20, 0, 60, 0, 30, 0]")
        cell.reach(emulator.ports)
        state = cell.reads("left", lambda state: np.rad2deg(state.positions[0]) == pytest.approx(20, abs=0.1))
        cell.pause(1.0)
        assert cell.reads("left").positions == pytest.approx(state.positions, abs=UNMOVED)
        gets_nothing_that_moves(cell, link)
    finally:
        emulator.kill()
        cell.close()


# Whole runs


@pytest.mark.slow
@pytest.mark.parametrize("link", ["rep", "can"])
def test_the_first_ctrl_c_within_a_move_stops_both_arms_and_ends_cleanly(link: str, tmp_path: Path) -> None:
    with running(tmp_path, link) as run:
        begun = run.moves()
        os.kill(run.process.pid, signal.SIGINT)
        assert run.ends() == INTERRUPTED
        assert "interrupted by SIGINT" in run.said
        assert "stopped: left, right" in run.said
        assert sorted(run.stops) == ["left", "right"]
        assert max(run.rests.values()) < begun + 2.0
        assert "the session is kept" in run.said
        assert run.session.is_dir()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("link", "overrides", "speed", "within"),
    [
        ("can", (), 1.0, HEARTBEAT_LOST),  # drives that get no more targets stand at the last one
        ("can", ("backends.cell.link.can.mode=profile",), 0.05, HEARTBEAT_LOST),  # and others go on until they miss it
        ("rep", (), 0.05, 0.0),
        ("fanuc", (), 1.0, POINTS_LAST),
    ],
)
def test_arms_stop_by_themselves_when_this_program_is_killed(
    link: str, overrides: tuple[str, ...], speed: float, within: float, tmp_path: Path
) -> None:
    with running(tmp_path, link, *overrides, speed=speed) as run:
        run.moves()
        killed = kill(run.process.pid)
        assert run.ends() == -signal.SIGKILL
        assert run.stops == []
        assert max(run.rests.values()) < killed + within + BRAKING


@pytest.mark.slow
@pytest.mark.parametrize("link", ["abb", "can"])
def test_a_run_whose_controller_dies_within_a_move_ends_with_its_name_and_can_be_gone_on_with(
    link: str, tmp_path: Path
) -> None:
    with running(tmp_path, link) as run:
        run.moves()
        kill(run.emulator)
        assert run.ends() == 1
        assert re.search("dualcal: (left|right): .*the controller closed|the bus .* failed", run.said)
        assert "it may still move: use the emergency stop" in run.said
        if link == "abb":
            assert gone_on_with(run.session)["verdict"] == "ok"


@pytest.mark.slow
@pytest.mark.parametrize(("link", "fault"), [("fanuc", "half-open"), ("can", "missing-pdo")])
def test_a_fault_ends_a_run_by_its_name_and_it_can_be_gone_on_with(link: str, fault: str) -> None:
    unhurried = [f"backends.cell.link.can.sync_period_ms={UNHURRIED_MS}"] if link == "can" else []
    case = next(case for case in cases(link) if case.fault == fault)
    (trial,), _ = tried(link, case, unhurried, 1)
    assert trial.wrong == []


@contextmanager
def on_collection(note: Callable[[str, dict[str, int]], None]) -> Iterator[None]:
    """Have it told of each search of the heap, and what has been spared in it is not any more afterwards."""
    gc.callbacks.append(note)
    try:
        yield
    finally:
        gc.callbacks.remove(note)
        gc.unfreeze()


def is_there(cell: Guarded) -> bool:
    try:
        cell.arms["left"].read(1.0)
    except DeviceError:
        return False
    return True


def stays_where_it_is(cell: Guarded, link: str) -> None:
    """A server that has just been started sees its clients come back, and nothing that moves its arms."""
    for arm in ARMS:
        cell.reads(arm)
    cell.stays(cell.served.places(), 1.0)
    assert not any(arm.motions for arm in cell.served.world.arms.values())
    gets_nothing_that_moves(cell, link)


def gets_nothing_that_moves(cell: Guarded, link: str) -> None:
    """What its clients have sent since they came back."""
    for arm in ARMS:
        if link == "can":
            words = controlwords(cell.relays[arm, BUS].sent[-1])
            assert words
            assert not any(word & 0x0F == ENABLE for word in words)
        else:
            order = "little" if link in ("rep", "abb") else "big"
            assert set(messages(cell.relays[arm, MOTION].sent[-1], order)) <= ({PING} if link == "rep" else set())


def controlwords(sent: bytes) -> list[int]:
    """What drives were told by PDO."""
    frames = re.findall(rb"< send 2\d\d \d+ (\w+) (\w+)", sent)
    return [int(high + low.rjust(2, b"0"), 16) for low, high in frames]


def messages(data: bytes, order: Literal["big", "little"] = "little") -> list[int]:
    """The types of the messages that were sent."""
    types = []
    while data:
        length = int.from_bytes(data[:4], order)
        types.append(int.from_bytes(data[4:8], order))
        data = data[4 + length :]
    return types
