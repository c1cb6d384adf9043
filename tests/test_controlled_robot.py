"""One arm of a controller, whatever its wires: when a motion has arrived, what ends it, when a stop is confirmed."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from backends.controller import following
from backends.controller.joint_map import Coupling, JointMap, JointMapConfig
from backends.controller.robot import ControlledRobot
from dualcal_hal.clock import RealClock
from dualcal_hal.errors import CommandRefused, DeviceError, LinkLost, MotionFailed, MotionStopped, NotOpen
from dualcal_hal.limits import JointLimits
from dualcal_hal.robot import JointPath, Mode, Motion, MotionState
from tests.stub_link import StubLink

LIMITS = JointLimits(np.full(3, -2.0), np.full(3, 2.0), np.full(3, 2.0), np.full(3, 20.0))
AMPLE = 20.0  # s
MAP = JointMapConfig(sign=(1, -1, 1), coupling=(Coupling(joint=3, from_joint=2, factor=1),))


@pytest.fixture
def clock():
    return RealClock()


@pytest.fixture
def joint_map():
    return JointMap(MAP, 3)


@pytest.fixture
def link(clock, joint_map):
    stub = StubLink("left", joint_map.to_controller(np.zeros(3)), clock)
    yield stub
    stub.close()


@pytest.fixture
def robot(link, clock, joint_map):
    controlled = ControlledRobot("left", LIMITS, joint_map, clock)
    controlled.attach(link)
    yield controlled
    controlled.detach()


def path(*waypoints, share=1.0):
    return JointPath(waypoints, tuple(share * LIMITS.speed), tuple(LIMITS.acceleration))


LONG = path((1.5, 0.0, 0.0), share=0.05)
"""15 s: it is under way, whatever the machine has to do besides."""


def test_states_are_of_the_joints_of_the_kinematics(robot, link, joint_map):
    link.at = joint_map.to_controller(np.array([0.1, 0.2, 0.3]))
    link.report_after(robot.read(AMPLE).time, link.clock.now() + AMPLE)
    np.testing.assert_allclose(robot.read(AMPLE).positions, [0.1, 0.2, 0.3])


def test_a_state_is_newer_than_the_call(robot, clock):
    before = clock.now()
    assert robot.read(AMPLE).time > before


def test_a_motion_settles_where_it_was_sent_in_the_joints_of_the_kinematics(robot):
    final = robot.start(path((0.3, -0.2, 0.1))).wait(AMPLE)
    np.testing.assert_allclose(final.positions, [0.3, -0.2, 0.1], atol=1e-6)
    np.testing.assert_array_equal(final.velocities, 0.0)


def test_velocities_come_from_the_positions_where_the_controller_tells_none(robot, link):
    link.tells_velocity = False
    seen = []
    robot.subscribe(seen.append)
    robot.start(path((0.5, 0.0, 0.0))).wait(AMPLE)
    assert max(state.velocities[0] for state in seen) > 0.5


def test_a_controller_that_does_not_say_whether_it_moves_is_judged_by_its_positions(robot, link):
    link.tells_motion = False
    final = robot.start(path((0.3, 0.0, 0.0))).wait(AMPLE)
    np.testing.assert_allclose(final.positions, [0.3, 0.0, 0.0], atol=1e-3)


def test_a_motion_that_begins_late_has_not_arrived_before_it_has_begun(robot, link):
    link.begins_late = 0.4
    np.testing.assert_allclose(robot.start(path((0.3, 0.0, 0.0))).wait(AMPLE).positions, [0.3, 0.0, 0.0], atol=1e-3)


def test_a_way_back_to_where_it_begins_is_made_before_it_has_arrived(robot, link):
    link.begins_late = 0.3
    began = link.clock.now()
    final = robot.start(path((0.4, 0.0, 0.0), (0.0, 0.0, 0.0))).wait(AMPLE)
    assert final.time >= began + link.begins_late + link.courses[0].duration


def test_all_has_to_be_acknowledged_before_a_motion_has_arrived(robot, link):
    link.takes_all = False
    motion = robot.start(path((0.1, 0.0, 0.0)))
    arrived = threading.Event()
    robot.subscribe(lambda state: abs(state.positions[0] - 0.1) < 1e-6 and arrived.set())
    assert arrived.wait(AMPLE)
    robot.read(AMPLE)
    assert motion.state is MotionState.RUNNING
    link.transfer.completed()
    motion.wait(AMPLE)


def test_an_arm_that_never_moves_fails_its_motion_by_joint_and_distance(robot, link, monkeypatch):
    monkeypatch.setattr(following, "NEVER_ARRIVED", 0.2)
    link.moves = False
    with pytest.raises(MotionFailed, match=r"acknowledged.*joint 2.*5\.730 deg"):
        robot.start(path((0.0, 0.1, 0.05))).wait(AMPLE)


def test_a_refused_rest_of_a_course_stops_the_arm_and_ends_the_motion_by_its_error(robot, link):
    link.takes_all = False
    motion = robot.start(path((0.5, 0.0, 0.0)))
    link.transfer.failed(MotionFailed("left", "move", "point 7 was refused with code 3"))
    with pytest.raises(MotionFailed, match="point 7 was refused"):
        motion.wait(AMPLE)
    assert link.stops == ["point 7 was refused with code 3"]


def test_a_fault_ends_a_motion_with_its_code_once_the_arm_was_told_to_stop(robot, link):
    motion = robot.start(LONG)
    link.faults = ("joint 3 (node 3): code 0x8611 following error",)
    with pytest.raises(MotionFailed, match=r"left: move: joint 3 \(node 3\): code 0x8611 following error"):
        motion.wait(AMPLE)
    assert link.stops


@pytest.mark.parametrize("mode", [Mode.EMERGENCY_STOP, Mode.MANUAL, Mode.DISABLED, Mode.UNKNOWN])
def test_a_mode_in_which_nothing_moves_ends_a_motion(robot, link, mode):
    motion = robot.start(LONG)
    link.mode = mode
    with pytest.raises(MotionFailed, match=f"mode '{mode}'"):
        motion.wait(AMPLE)


def test_a_failing_link_stops_the_arm_ends_the_motion_by_its_own_error_and_is_told(robot, link):
    told = []
    robot.on_failure(told.append)
    motion = robot.start(LONG)
    lost = LinkLost("left", "read", "nothing came for 1.0 s")
    link.fail(lost)
    with pytest.raises(LinkLost, match=r"nothing came for 1\.0 s"):
        motion.wait(AMPLE)
    assert told == [lost]
    assert link.stops


def test_a_stop_that_cannot_be_sent_is_told_with_the_error(robot, link, monkeypatch):
    motion = robot.start(LONG)

    def unable(reason):
        raise LinkLost("left", "stop", "the connection is gone")

    monkeypatch.setattr(link, "stop", unable)
    link.fail(LinkLost("left", "read", "the connection is gone"))
    with pytest.raises(LinkLost) as caught:
        motion.wait(AMPLE)
    assert any("use the emergency stop" in note for note in caught.value.__notes__)


@pytest.mark.parametrize("mode", [Mode.DISABLED, Mode.MANUAL, Mode.EMERGENCY_STOP, Mode.FAULT, Mode.UNKNOWN])
def test_an_arm_that_is_not_ready_is_sent_nothing(robot, link, mode):
    link.mode = mode
    robot.read(AMPLE)
    with pytest.raises(CommandRefused, match=f"mode '{mode}'"):
        robot.start(path((0.1, 0.0, 0.0)))
    assert not link.courses


def test_a_fault_is_a_reason_not_to_move_whatever_the_mode(robot, link):
    link.faults = ("code 42",)
    robot.read(AMPLE)
    with pytest.raises(CommandRefused, match="code 42"):
        robot.start(path((0.1, 0.0, 0.0)))


def test_the_second_of_two_motions_is_refused(robot):
    motion = robot.start(LONG)
    with pytest.raises(CommandRefused, match="it is moving"):
        robot.start(path((0.0, 0.0, 0.0)))
    robot.stop("enough")
    with pytest.raises(MotionStopped):
        motion.wait(AMPLE)


def test_an_arm_is_free_as_soon_as_its_motion_has_ended(robot):
    motion, refused = robot.start(path((0.3, 0.0, 0.0))), []

    def disable():
        try:
            robot.disable(AMPLE)
        except CommandRefused as error:
            refused.append(error)

    motion.on_end(disable)
    motion.wait(AMPLE)
    assert not refused


def test_who_waits_for_a_motion_goes_on_after_those_who_are_told_of_its_end(clock):
    motion, told = Motion("left", clock), []
    motion.on_end(lambda: (clock.wait(threading.Event(), clock.now() + 0.1), told.append("ended")))
    ending = threading.Thread(target=motion.stop, args=("enough",))
    ending.start()
    with pytest.raises(MotionStopped):
        motion.wait(AMPLE)
    assert told == ["ended"]
    ending.join()


def test_a_stop_is_confirmed_by_a_newer_state(robot):
    motion = robot.start(LONG)
    assert robot.stop("enough").confirmed
    with pytest.raises(MotionStopped, match="enough"):
        motion.wait(AMPLE)


@pytest.fixture
def stopped_meanwhile(robot, link, monkeypatch):
    """Has another thread stop the arm as its link is asked for something by this one, which then goes on."""

    def arrange(name):
        asked, stopping = getattr(link, name), threading.Thread(target=robot.stop, args=("enough",))
        told, stop = threading.Event(), link.stop

        def tell(reason):
            stop(reason)
            told.set()

        def ask(*args):
            if stopping.ident is None:
                stopping.start()
                assert told.wait(AMPLE)
            return asked(*args)

        monkeypatch.setattr(link, "stop", tell)
        monkeypatch.setattr(link, name, ask)
        threads.append(stopping)

    threads = []
    yield arrange
    for thread in threads:
        thread.join()


def test_what_is_stopped_before_it_has_begun_is_not_sent(robot, link, stopped_meanwhile):
    stopped_meanwhile("report_after")
    with pytest.raises(MotionStopped, match="enough"):
        robot.start(path((1.0, 0.0, 0.0))).wait(AMPLE)
    assert not link.courses


def test_a_stop_that_comes_before_the_course_that_is_just_sent_stops_that(robot, link, stopped_meanwhile):
    stopped_meanwhile("send")
    with pytest.raises(MotionStopped, match="enough"):
        robot.start(path((1.0, 0.0, 0.0))).wait(AMPLE)
    assert link.courses
    assert link.stops[1:] == ["it was stopped as it began"]


def test_a_failure_as_a_course_is_sent_stops_that(robot, link, monkeypatch):
    send = link.send

    def failing(course):
        link.fail(LinkLost("left", "receive", "the bus is gone"))
        return send(course)

    monkeypatch.setattr(link, "send", failing)
    with pytest.raises(LinkLost, match="the bus is gone"):
        robot.start(path((1.0, 0.0, 0.0))).wait(AMPLE)
    assert link.stops == ["the bus is gone", "it was stopped as it began"]


def test_the_error_that_ends_a_motion_is_not_the_stop_that_it_brings_about(robot, link):
    link.takes_all = False  # so that the stop ends the transfer
    motion = robot.start(path((1.0, 0.0, 0.0)))
    link.fail(LinkLost("left", "receive", "the bus is gone"))
    with pytest.raises(LinkLost, match="the bus is gone"):
        motion.wait(AMPLE)


def test_a_stop_is_sent_also_where_nothing_moves(robot, link):
    assert robot.stop("to be sure").confirmed
    assert link.stops == ["to be sure"]


def test_a_stop_is_sent_once_a_lost_link_is_there_again(robot, link, monkeypatch):
    motion, stop, lost = robot.start(LONG), link.stop, [1, 1, 1]

    def again(reason):
        if lost:
            lost.pop()
            raise LinkLost("left", "stop", "it is connected anew soon")
        stop(reason)

    monkeypatch.setattr(link, "stop", again)
    assert robot.stop("enough").confirmed
    assert link.stops == ["enough"]
    with pytest.raises(MotionStopped, match="enough"):
        motion.wait(AMPLE)


def test_a_stop_that_could_not_be_sent_is_not_confirmed(robot, link, monkeypatch):
    def unable(reason):
        raise LinkLost("left", "stop", "the connection is gone")

    monkeypatch.setattr(link, "stop", unable)
    result = robot.stop("enough")
    assert (result.confirmed, result.detail) == (False, "the connection is gone")


def test_one_that_fails_when_told_of_a_failure_keeps_nobody_from_being_told(robot, link, caplog):
    told, lost = [], LinkLost("left", "read", "the connection is gone")
    robot.on_failure(lambda error: 1 / 0)
    robot.on_failure(told.append)
    link.fail(lost)
    assert told == [lost]
    assert "one that was told of a failure failed" in caplog.text


def test_an_arm_that_goes_on_has_not_confirmed_its_stop(robot, link):
    link.obeys_stop = False
    motion = robot.start(LONG)
    result = robot.stop("enough")
    assert not result.confirmed
    assert "still says that the arm moves" in result.detail
    with pytest.raises(MotionStopped, match="not confirmed"):
        motion.wait(AMPLE)


def test_a_controller_that_says_nothing_has_not_confirmed_a_stop(robot, link):
    robot.read(AMPLE)
    link.silent = True
    result = robot.stop("enough")
    assert not result.confirmed
    assert result.detail == "no state"


def test_a_subscriber_that_fails_is_told_and_gets_no_more(robot):
    told = []
    robot.on_failure(told.append)
    heard = []

    def failing(state):
        heard.append(state)
        raise RuntimeError("oh")

    robot.subscribe(failing)
    for _ in range(3):
        robot.read(AMPLE)
    assert len(heard) == 1
    assert isinstance(told[0], DeviceError)
    assert "the subscriber failed" in str(told[0])


def test_closing_stops_a_motion(robot, link):
    motion = robot.start(LONG)
    robot.detach()
    with pytest.raises(MotionStopped, match="closed"):
        motion.wait(AMPLE)
    assert link.stops
    with pytest.raises(NotOpen):
        robot.read(AMPLE)
