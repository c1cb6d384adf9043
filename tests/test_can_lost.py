"""This program, or the bus, is lost while an arm on CAN moves: its drives stop, and never move again unasked."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator

import numpy as np
import pytest

from backends.controller.can import links
from backends.controller.can import session as session_module
from backends.controller.course import Course
from backends.controller.emulator.axis import State
from backends.controller.emulator.drives import DriveBuses
from backends.controller.joint_map import JointMap
from backends.controller.link import ArmLink, ArmReport
from backends.controller.options import CanLink
from dualcal_hal.clock import RealClock
from dualcal_hal.errors import CommandRefused, LinkLost
from dualcal_hal.robot import JointPath, Mode
from tests.drive_rig import IdealMotors

GOAL, SPEED = 6.0, 0.3  # rad, rad/s: twenty seconds
PATIENCE = 8.0  # s; a drive waits for 0.5 s
CLOCK = RealClock()

# A process of its own, which tells when the arm moves and then goes on until it is killed.
PROGRAM = f"""
import sys, threading
import numpy as np
from backends.controller.can import links
from backends.controller.course import Course
from backends.controller.joint_map import JointMap
from backends.controller.options import CanLink
from dualcal_hal.clock import RealClock
from dualcal_hal.robot import JointPath

clock = RealClock()
link = links(CanLink.model_validate_json(sys.argv[1]), {{"left": 2}}, clock)["left"]
link.open(clock.now() + 10.0)
link.enable(10.0)
report = link.report_after(clock.now(), clock.now() + 10.0)
path = JointPath((({GOAL}, -{GOAL}),), ({SPEED}, {SPEED}), (4.0, 4.0))
link.send(Course(np.array(report.positions), path, JointMap(None, 2)))
while abs(report.positions[0]) < 0.05:
    report = link.report_after(clock.now(), clock.now() + 10.0)
print("it moves", flush=True)
threading.Event().wait()
"""


def options(mode: str, channel: str) -> CanLink:
    drives = [{"node": node, "counts_per_rad": 1e5} for node in (1, 2)]
    arms = {"left": {"channel": channel, "drives": drives}}
    return CanLink.model_validate({"interface": "socketcand", "mode": mode, "sync_period_ms": 50, "arms": arms})


@pytest.fixture
def motors() -> IdealMotors:
    return IdealMotors(2)


@pytest.fixture
def buses(motors: IdealMotors) -> Iterator[DriveBuses]:
    served = DriveBuses(options("cyclic", "left"), {"left": motors}, CLOCK)
    yield served
    served.close()


@pytest.mark.parametrize("mode", ["cyclic", "profile"])
def test_drives_stop_by_themselves_when_this_program_is_killed(
    buses: DriveBuses, motors: IdealMotors, mode: str
) -> None:
    given = options(mode, buses.endpoints["arms"]["left"]["channel"]).model_dump_json(exclude_none=True)
    axes = [drive.axis for drive in buses.arms["left"].drives]
    with subprocess.Popen([sys.executable, "-c", PROGRAM, given], stdout=subprocess.PIPE, text=True) as program:
        try:
            assert program.stdout is not None
            assert program.stdout.readline() == "it moves\n"
            assert all(axis.state is State.ENABLED for axis in axes)
        finally:
            program.kill()
    deadline = CLOCK.now() + PATIENCE
    while any(axis.state is not State.FAULT for axis in axes):
        assert CLOCK.now() < deadline, [axis.state for axis in axes]
        CLOCK.wait(threading.Event(), CLOCK.now() + 0.02)
    stands = motors.q.copy()
    CLOCK.wait(threading.Event(), CLOCK.now() + 0.2)
    assert motors.q.tolist() == stands.tolist()
    assert 0.0 < stands[0] < GOAL
    assert -GOAL < stands[1] < 0.0


def report_once_it_is_back(link: ArmLink) -> ArmReport:
    deadline = CLOCK.now() + 2 * PATIENCE
    while True:
        try:
            return link.report_after(CLOCK.now(), deadline)
        except LinkLost:
            assert CLOCK.now() < deadline
            CLOCK.wait(threading.Event(), CLOCK.now() + 0.02)


@pytest.fixture(params=["cyclic", "profile"])
def link(request: pytest.FixtureRequest, buses: DriveBuses) -> Iterator[ArmLink]:
    given = options(request.param, buses.endpoints["arms"]["left"]["channel"])
    opened = links(given, {"left": 2}, CLOCK)["left"]
    try:
        opened.open(CLOCK.now() + PATIENCE)
        opened.enable(PATIENCE)
        yield opened
    finally:
        opened.close()


def course(start: ArmReport) -> Course:
    path = JointPath(((GOAL, -GOAL),), (SPEED, SPEED), (4.0, 4.0))
    return Course(np.array(start.positions), path, JointMap(None, 2))


def test_after_a_bus_was_lost_within_a_move_nothing_moves_is_enabled_or_reset_unasked(
    buses: DriveBuses, motors: IdealMotors, link: ArmLink
) -> None:
    axes = [drive.axis for drive in buses.arms["left"].drives]
    lost = threading.Event()
    link.on_failure(lambda error: lost.set() if isinstance(error, LinkLost) else None)
    transfer = link.send(course(link.report_after(CLOCK.now(), CLOCK.now() + PATIENCE)))
    while abs(link.report_after(CLOCK.now(), CLOCK.now() + PATIENCE).positions[0]) < 0.05:
        pass
    mend = buses.strike("lost-link", "left")
    assert lost.wait(PATIENCE)
    assert transfer.complete or isinstance(transfer.error, LinkLost)  # a set-point was told to its end
    deadline = CLOCK.now() + PATIENCE
    while any(axis.state is not State.FAULT for axis in axes):
        assert CLOCK.now() < deadline
        CLOCK.wait(threading.Event(), CLOCK.now() + 0.02)
    stands = motors.q.tolist()
    assert mend is not None
    mend()
    report = report_once_it_is_back(link)
    assert report.mode is Mode.FAULT
    assert "joint 1 (node 1)" in report.faults[0]
    with pytest.raises(CommandRefused, match="fault"):
        link.send(course(report))
    with pytest.raises(CommandRefused, match="in fault"):
        link.enable(PATIENCE)
    CLOCK.wait(threading.Event(), CLOCK.now() + 0.3)
    assert [axis.state for axis in axes] == [State.FAULT] * 2
    assert motors.q.tolist() == stands
    link.reset_fault(PATIENCE)
    assert [axis.state for axis in axes] == [State.SWITCH_ON_DISABLED] * 2
    link.enable(PATIENCE)
    assert motors.q.tolist() == pytest.approx(stands, abs=1e-3)


def test_a_bus_that_stays_away_is_tried_less_and_less_often(
    buses: DriveBuses, link: ArmLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[float] = []

    def connect(deadline: float) -> None:
        tried.append(CLOCK.now())
        raise LinkLost("left", "open the bus", "it is away")

    monkeypatch.setattr(session_module, "_BACK_OFF", (0.1, 0.4))
    monkeypatch.setattr(link, "_connect", connect)
    lost = threading.Event()
    link.on_failure(lambda error: lost.set() if isinstance(error, LinkLost) else None)
    buses.strike("lost-link", "left")
    assert lost.wait(PATIENCE)
    deadline = CLOCK.now() + PATIENCE
    while len(tried) < 6:
        assert CLOCK.now() < deadline
        CLOCK.wait(threading.Event(), CLOCK.now() + 0.02)
    waits = np.diff(tried)
    assert np.all(waits >= np.array([0.2, 0.4, 0.4, 0.4, 0.4])[: len(waits)] - 1e-3)
