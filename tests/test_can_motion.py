"""What drives are told from cycle to cycle: never a step too large, and a rest where cycles are late."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from backends.controller.can.axis import Axis
from backends.controller.can.motion import CourseLead, SetPointLead, proportioned
from backends.controller.can.objects import AT_ONCE, HALT, NEW_SET_POINT, Feedback, Scale
from backends.controller.course import Course
from backends.controller.joint_map import Coupling, JointMap, JointMapConfig
from dualcal_hal.robot import JointPath

PERIOD = 0.01
SPEED = (0.5, 1.0)


def course(*waypoints, start=(0.0, 0.0), speed=SPEED, joint_map=None):
    path = JointPath(waypoints, speed, (2.0, 4.0))
    return Course(np.array(start), path, JointMap(joint_map, 2))


def follow(lead, late=(), cycles=2000):
    """The targets (m, n) until it is over."""
    targets = []
    late = iter(late)
    for _ in range(cycles):
        targets.append(lead.next(next(late, 0)))
        if lead.is_over:
            return np.array(targets)
    raise AssertionError("it never ends")


angles = st.floats(-1.5, 1.5)


@settings(max_examples=50)
@given(
    waypoints=st.lists(st.tuples(angles, angles), min_size=1, max_size=3),
    held=st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01)),
    late=st.lists(st.sampled_from([0, 0, 1, 2, 3, 7]), max_size=300),
    factor=st.floats(-1.0, 1.0),
)
def test_no_step_is_larger_than_the_speed_allows_in_a_period_whatever_is_late(waypoints, held, late, factor):
    coupled = JointMapConfig(coupling=(Coupling(joint=2, from_joint=1, factor=factor),))
    way = course(*waypoints, joint_map=coupled)
    lead = CourseLead(way, np.array(held), PERIOD)
    targets = follow(lead, late)
    steps = np.abs(np.diff(np.vstack([held, targets]), axis=0))
    assert np.all(steps <= way.speed * PERIOD * (1 + 1e-6))
    assert lead.largest_step <= 1 + 1e-6


def test_a_course_is_told_to_its_end_in_its_own_time():
    way = course((0.5, -0.5))
    lead = CourseLead(way, np.zeros(2), PERIOD)
    targets = follow(lead)
    assert lead.is_told
    assert np.allclose(targets[-1], (0.5, -0.5))
    assert len(targets) == pytest.approx(way.duration / PERIOD, abs=2)


def test_one_late_cycle_holds_the_last_target_and_the_course_goes_on_from_there():
    lead = CourseLead(course((0.5, 0.0)), np.zeros(2), PERIOD)
    before = [lead.next(0) for _ in range(20)][-1]
    assert np.array_equal(lead.next(1), before)
    after = lead.next(0)
    assert 0.0 < after[0] - before[0] <= SPEED[0] * PERIOD


def test_two_late_cycles_slow_the_course_down_and_it_recovers():
    lead = CourseLead(course((1.0, 0.0)), np.zeros(2), PERIOD)
    cruise = np.diff([lead.next(0)[0] for _ in range(60)])[-1]
    before = lead.next(1)[0]
    slow = lead.next(2)[0] - before
    assert slow == pytest.approx(0.5 * cruise, rel=0.01)
    steps = np.diff([lead.next(0)[0] for _ in range(20)])
    assert steps[-1] == pytest.approx(cruise, rel=0.01)


def test_three_late_cycles_stop_on_the_path_and_it_is_no_success():
    lead = CourseLead(course((1.0, 0.5)), np.zeros(2), PERIOD)
    for _ in range(60):
        lead.next(0)
    targets = follow(lead, (1, 2, 3))
    assert not lead.is_told
    assert 0.0 < targets[-1][0] < 1.0
    assert np.allclose(targets[:, 1], 0.5 * targets[:, 0])  # straight on
    assert np.abs(targets[-1] - targets[-2]).max() < 0.2 * SPEED[0] * PERIOD  # to rest, not abruptly


def test_a_brake_in_a_late_cycle_goes_on_braking():
    lead = CourseLead(course((1.0, 0.0)), np.zeros(2), PERIOD)
    for _ in range(60):
        lead.next(0)
    lead.brake()
    assert len(follow(lead, (1, 2, 3, 4, 5))) < 60
    assert not lead.is_told


def test_a_brake_before_the_begin_ends_it_where_the_drives_are_held():
    lead = CourseLead(course((1.0, 0.0)), np.full(2, 0.01), PERIOD)
    lead.brake()
    assert lead.is_over
    assert np.array_equal(lead.next(0), (0.01, 0.01))


def test_drives_held_beside_the_begin_are_led_there_first():
    lead = CourseLead(course((0.0, 0.5)), np.array((0.01, 0.0)), PERIOD)
    targets = follow(lead)
    led = targets[:4]
    assert np.allclose(led[-1], 0.0)
    assert np.all(np.diff(led[:, 0]) < 0)


def test_proportioned_joints_that_have_no_way_to_go_do_not_move():
    for way in ((0.0, 0.0), (1e-308, 0.0)):
        velocities, accelerations = proportioned(np.array(way), np.ones(2), np.ones(2))
        assert not velocities.any()
        assert not accelerations.any()


@settings(max_examples=50)
@given(st.tuples(angles, angles), st.tuples(st.floats(0.1, 2.0), st.floats(0.1, 2.0)))
def test_proportioned_joints_arrive_together_and_keep_their_bounds(way, bounds):
    way, speed, acceleration = np.array(way), np.array(bounds), np.array((2.0, 4.0))
    velocities, accelerations = proportioned(way, speed, acceleration)
    assert np.all(velocities <= speed * (1 + 1e-9))
    assert np.all(accelerations <= acceleration * (1 + 1e-9))
    moving = np.abs(way) > 1e-9
    durations = np.abs(way[moving]) / velocities[moving] + velocities[moving] / accelerations[moving]
    assert np.allclose(durations, durations[:1])


class Drives:
    """Two axes whose statuswords and positions a test sets."""

    def __init__(self):
        self.axes = [Axis(joint, joint, Scale(1000.0)) for joint in (1, 2)]

    def say(self, *statuswords, positions=(0, 0)):
        for axis, word, position in zip(self.axes, statuswords, positions, strict=True):
            axis.feedback = Feedback(word, 1, position)

    def bits(self, lead, late=0):
        lead.command(self.axes, late)
        return {axis.bits for axis in self.axes}


TAKEN, REACHED = 0x1027, 0x0427


def test_a_set_point_is_handed_over_with_its_handshake():
    drives, lead = Drives(), SetPointLead(halted=False, arrival=2)
    lead.go([100, -50], is_last=True)
    drives.say(0x27, 0x27)
    assert drives.bits(lead) == {NEW_SET_POINT | AT_ONCE}
    assert [axis.target for axis in drives.axes] == [100, -50]
    drives.say(TAKEN, 0x27)
    assert drives.bits(lead) == {NEW_SET_POINT | AT_ONCE}, "one drive has not taken it"
    drives.say(TAKEN, TAKEN)
    assert drives.bits(lead) == {0}
    assert not lead.is_told
    drives.say(0x27, 0x27)
    drives.bits(lead)
    assert lead.is_told
    drives.say(REACHED, REACHED, positions=(100, -20))
    drives.bits(lead)
    assert not lead.wake.is_set(), "it says that it has arrived, and has not"
    drives.say(REACHED, REACHED, positions=(100, -49))
    drives.bits(lead)
    assert lead.wake.is_set()
    assert lead.is_over


def test_a_brake_is_the_halt_bit_and_no_set_point():
    drives, lead = Drives(), SetPointLead(halted=False, arrival=2)
    lead.go([100, -50], is_last=True)
    drives.say(0x27, 0x27)
    drives.bits(lead)
    lead.brake()
    assert drives.bits(lead) == {HALT}
    assert lead.is_over
    assert lead.wake.is_set()
    assert not lead.is_told


def test_a_set_point_that_comes_after_a_brake_is_not_handed_over_nor_waited_for():
    drives, lead = Drives(), SetPointLead(halted=False, arrival=2)
    drives.say(0x27, 0x27)
    lead.brake()
    lead.go([100, -50], is_last=True)
    assert drives.bits(lead) == {HALT}
    assert [axis.target for axis in drives.axes] == [0, 0]
    assert lead.wake.is_set()


def test_the_halt_bit_stays_until_the_next_set_point_is_taken():
    drives, lead = Drives(), SetPointLead(halted=True, arrival=2)
    drives.say(0x27, 0x27)
    assert drives.bits(lead) == {HALT}
    lead.go([1, 1], is_last=False)
    assert drives.bits(lead) == {HALT | NEW_SET_POINT | AT_ONCE}
    drives.say(TAKEN, TAKEN)
    assert drives.bits(lead) == {0}


def test_three_late_cycles_halt_drives_that_make_their_own_way():
    drives, lead = Drives(), SetPointLead(halted=False, arrival=2)
    lead.go([100, -50], is_last=True)
    drives.say(0x27, 0x27)
    assert drives.bits(lead, late=2) == {NEW_SET_POINT | AT_ONCE}
    assert drives.bits(lead, late=3) == {HALT}
