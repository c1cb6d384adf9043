"""While an arm of a real cell moves both are watched, and what goes wrong with one stops both."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from backends.controller.joint_map import JointMap
from backends.controller.robot import ControlledRobot, OwnSpeed
from dualcal_hal.clock import RealClock
from dualcal_hal.errors import CommandRefused, DeviceError, DeviceTimeout, LinkLost, MotionFailed, MotionStopped
from dualcal_hal.geometry import CellGeometry
from dualcal_hal.guard import CellGuard, GuardedRobot
from dualcal_hal.limits import JointLimits
from dualcal_hal.pace import FULL_PACE, REDUCED_SPEED, Pace
from dualcal_hal.robot import Mode, MotionState
from dualcal_hal.watch import LOOK_EVERY, off_path
from tests.cells import paper_cell
from tests.stub_link import StubLink

CONFIG = paper_cell().cell
GEOMETRY = CellGeometry.of(CONFIG)
HOME = tuple(map(float, CONFIG.active.home))
ASIDE = (1.0, *HOME[1:])
AMPLE = 30.0
SLOW = Pace(largest=REDUCED_SPEED)
"""So that what happens within a motion does, whatever the machine has to do besides."""
STRETCHED = (0.0, -0.8, 1.57, 0.0, 0.0, 0.0)


class Rig:
    """Both arms of the paper's cell behind stub links and a guard that watches."""

    def __init__(self, pace=SLOW, own_speed=None):
        clock = RealClock()
        self.links, self.arms, self._robots = {}, {}, []
        for name, config in CONFIG.robots.items():
            limits, joint_map = JointLimits.of(config), JointMap(None, 6)
            self.links[name] = StubLink(name, config.home, clock)
            robot = ControlledRobot(name, limits, joint_map, clock, own_speed)
            robot.attach(self.links[name])
            self._robots.append(robot)
            self.arms[name] = GuardedRobot(robot, limits, clock)
        self.guard = CellGuard(
            self.arms["left"],
            self.arms["right"],
            GEOMETRY,
            CONFIG.nominal.placement,
            CONFIG.procedure.clearance,
            pace,
            watched=True,
        )

    def start(self, name, *waypoints):
        arm = self.arms[name]
        return arm.start(self.guard.path(name, arm.read(1.0).positions, waypoints))

    def close(self):
        for robot in self._robots:
            robot.detach()
        for link in self.links.values():
            link.close()


@pytest.fixture(autouse=True)
def _feedback_may_be_older(monkeypatch):
    """Stub links report from threads of a machine that may have much else to do."""
    monkeypatch.setattr("dualcal_hal.watch.OWN_WORD_FIRST", 0.4)


@pytest.fixture
def rig():
    made = []

    def make(**options):
        made.append(Rig(**options))
        return made[-1]

    yield make
    for each in made:
        each.close()


def test_a_motion_with_nothing_wrong_settles(rig):
    cell = rig(pace=SLOW)
    motion = cell.start("left", ASIDE)
    np.testing.assert_allclose(motion.wait(AMPLE).positions, ASIDE, atol=1e-6)
    assert motion.state is MotionState.SETTLED
    assert not cell.links["left"].stops + cell.links["right"].stops


def _silence(link):
    link.silent = True


def _fault(link):
    link.faults = ("joint 4 (node 4): code 0x7305 encoder",)


def _emergency(link):
    link.mode = Mode.EMERGENCY_STOP


def _lose(link):
    link.fail(LinkLost("right", "read", "the connection was closed"))


@pytest.mark.parametrize(
    ("happens", "kind", "words"),
    [
        (_silence, DeviceTimeout, r"right: watch: no state for"),
        (_fault, MotionFailed, r"right: watch: .*joint 4 \(node 4\): code 0x7305 encoder"),
        (_emergency, MotionFailed, "right: watch: mode 'emergency stop'"),
        (_lose, LinkLost, "right: read: the connection was closed"),
    ],
)
def test_what_goes_wrong_with_the_arm_that_stands_stops_the_one_that_moves(rig, happens, kind, words):
    cell = rig()
    motion = cell.start("left", ASIDE)
    happens(cell.links["right"])
    with pytest.raises(kind, match=words):
        motion.wait(AMPLE)
    assert cell.links["left"].stops


@pytest.mark.parametrize("happens", [_silence, _fault, _emergency])
def test_what_goes_wrong_with_the_arm_that_moves_stops_both(rig, happens):
    cell = rig()
    motion = cell.start("left", ASIDE)
    happens(cell.links["left"])
    with pytest.raises((DeviceTimeout, MotionFailed)):
        motion.wait(AMPLE)
    assert cell.links["left"].stops


def test_what_an_arm_tells_while_it_is_stopped_is_told_with_what_it_was_stopped_for(rig):
    cell = rig()
    motion = cell.start("left", ASIDE)
    link, stop = cell.links["left"], cell.links["left"].stop

    def stopped(reason):
        link.stop = stop
        link.fail(DeviceError("left", "watch the drives", "joint 2 (node 2) emergency, code 0x8611"))
        stop(reason)

    link.stop = stopped
    _silence(link)
    with pytest.raises(DeviceTimeout, match="left: watch: no state for") as raised:
        motion.wait(AMPLE)
    assert "left: watch the drives: joint 2 (node 2) emergency, code 0x8611" in raised.value.__notes__


def test_an_arm_off_its_path_is_stopped(rig, monkeypatch):
    cell = rig()
    motion = cell.start("left", ASIDE)
    course = cell.links["left"].courses[0]
    planned, slip = course.sample, np.array([0, 0.1, 0, 0, 0, 0])
    monkeypatch.setattr(course, "sample", lambda t: (planned(t)[0] + min(1.0, 4 * t) * slip, planned(t)[1]))
    with pytest.raises(MotionFailed, match=r"left: move: joint 2 is .* deg off its path"):
        motion.wait(AMPLE)
    assert cell.links["left"].stops
    assert cell.links["right"].stops


def test_an_arm_that_is_faster_than_it_may_be_is_stopped_and_the_other_too(rig, monkeypatch):
    cell = rig(pace=SLOW)
    motion = cell.start("left", ASIDE)
    course = cell.links["left"].courses[0]
    planned = course.sample
    monkeypatch.setattr(course, "sample", lambda t: (planned(3 * t)[0], 3 * planned(3 * t)[1]))
    with pytest.raises(MotionFailed, match=r"left: move: it moves at \d+ mm/s, and 250 mm/s is the most it may"):
        motion.wait(AMPLE)
    assert cell.links["left"].stops
    assert cell.links["right"].stops


def test_an_observed_speed_above_what_is_confirmed_stops_an_arm_with_a_speed_of_its_own(rig, monkeypatch):
    cell = rig(pace=Pace(share=0.5), own_speed=OwnSpeed(0.1))
    motion = cell.start("left", ASIDE)
    course = cell.links["left"].courses[0]
    planned = course.sample
    monkeypatch.setattr(course, "sample", lambda t: (planned(6 * t)[0], 6 * planned(6 * t)[1]))
    with pytest.raises(MotionFailed, match=r"left: move: it moves at \d+ mm/s, and 125 mm/s is the most it may"):
        motion.wait(AMPLE)
    assert cell.links["left"].stops
    assert cell.links["right"].stops


def test_an_arm_does_not_begin_to_move_while_the_other_has_a_fault(rig):
    for happens in (_fault, _emergency):
        cell = rig()
        happens(cell.links["right"])
        with pytest.raises(CommandRefused, match="right: move the other arm: the arm is not ready: "):
            cell.start("left", ASIDE)
        assert not cell.links["left"].courses


def test_what_goes_wrong_with_one_while_the_other_begins_is_what_is_told(rig, monkeypatch):
    cell, stopped = rig(), threading.Event()
    link, stop = cell.links["left"], cell.links["left"].stop

    def send(course):
        """As a download that is stopped before all of it was taken."""
        _fault(cell.links["right"])
        assert stopped.wait(AMPLE)
        raise MotionStopped("left", "move", "stopped: something is wrong with the other arm")

    monkeypatch.setattr(link, "send", send)
    monkeypatch.setattr(link, "stop", lambda reason: (stop(reason), stopped.set()))
    with pytest.raises(MotionFailed, match=r"right: watch: .*joint 4 \(node 4\): code 0x7305 encoder"):
        cell.start("left", ASIDE)


def test_an_arm_that_is_stopped_along_with_the_other_hides_not_why(rig):
    cell = rig()
    motion = cell.start("left", ASIDE)
    cell.links["right"].fail(MotionStopped("right", "move", "stopped: error 4 of the controller"))
    threading.Event().wait(4 * LOOK_EVERY)
    cell.links["left"].fail(MotionFailed("left", "move", "error 4 of the controller"))
    with pytest.raises(MotionFailed, match="left: move: error 4 of the controller"):
        motion.wait(AMPLE)


def test_clearance_that_falls_because_the_other_arm_has_moved_stops_both(rig):
    cell = rig()
    motion = cell.start("left", ASIDE)
    # Somebody swings the other arm, stretched out, towards the one that moves.
    cell.links["right"].at = np.array(STRETCHED)
    with pytest.raises(MotionFailed, match="clearance may be down to"):
        motion.wait(AMPLE)
    assert cell.links["left"].stops


def test_the_arm_that_is_to_stand_must_not_move(rig):
    cell = rig()
    motion = cell.start("left", ASIDE)
    cell.links["right"].at = cell.links["right"].at + [0.1, 0, 0, 0, 0, 0]
    with pytest.raises(MotionFailed, match=r"right: watch: it was to stand while left moves.*joint 1 .* 5\.73 deg"):
        motion.wait(AMPLE)
    assert cell.links["left"].stops
    assert cell.links["right"].stops


def test_an_arm_that_cannot_be_looked_at_is_stopped(rig, monkeypatch):
    def fail(waypoints, q):
        raise ZeroDivisionError("of this program")

    cell = rig()
    monkeypatch.setattr("dualcal_hal.watch.off_path", fail)
    motion = cell.start("left", ASIDE)
    with pytest.raises(MotionFailed, match=r"left: move: this program could not look at it: ZeroDivisionError"):
        motion.wait(AMPLE)
    assert cell.links["left"].stops
    assert cell.links["right"].stops


def test_a_controller_with_a_speed_of_its_own_moves_under_a_limit_only_once_that_is_confirmed(rig):
    for own, words in ((OwnSpeed(None), "nobody has confirmed"), (OwnSpeed(0.3), "300 mm/s are confirmed")):
        cell = rig(pace=SLOW, own_speed=own)
        with pytest.raises(CommandRefused, match=f"250 mm/s are allowed, and .*{words}"):
            cell.start("left", ASIDE)
        assert not cell.links["left"].courses
    rig(pace=SLOW, own_speed=OwnSpeed(0.25)).start("left", ASIDE).wait(AMPLE)


def test_a_share_of_the_speed_is_a_limit_too(rig):
    with pytest.raises(CommandRefused, match="125 mm/s are allowed"):
        rig(pace=Pace(share=0.5), own_speed=OwnSpeed(0.25)).start("left", ASIDE)


def test_a_path_beyond_the_pace_is_refused_before_anything_is_sent(rig):
    cell = rig(pace=SLOW)
    arm = cell.arms["left"]
    path = FULL_PACE.path(HOME, (ASIDE,), arm.limits, GEOMETRY.active)
    with pytest.raises(CommandRefused, match=r"a part would move at .* 250 mm/s are allowed"):
        arm.start(path)
    assert not cell.links["left"].courses


def test_how_far_joints_are_off_a_path_is_measured_from_its_nearest_point():
    way = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    np.testing.assert_allclose(off_path(way, np.array([0.5, 0.1])), [0.0, 0.1], atol=1e-12)
    np.testing.assert_allclose(off_path(way, np.array([1.2, 0.7])), [0.2, 0.0], atol=1e-12)
    np.testing.assert_allclose(off_path(way, np.array([-0.3, 0.0])), [0.3, 0.0], atol=1e-12)
