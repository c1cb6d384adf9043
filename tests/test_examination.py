"""What a check says of devices that are not as they should be; nothing of them is moved or switched on."""

from __future__ import annotations

import numpy as np
import pytest

from dualcal_hal.camera import Camera, Frame
from dualcal_hal.cellfile import load_cell
from dualcal_hal.clock import VirtualClock
from dualcal_hal.errors import DeviceTimeout, LinkLost
from dualcal_hal.findings import Finding
from dualcal_hal.robot import Mode, Robot, RobotState
from procedures.commissioning.examination import examine_camera, examine_robot
from tests.cells import TINY

CELL = load_cell(TINY).cell
CONFIG = CELL.active


class Told(Robot):
    """An arm that reports what it is told to; any command to it fails the test."""

    def __init__(self):
        self.name, self.clock = "left", VirtualClock(100.0)
        self.degrees, self.mode, self.faults = [0, 0, 60, 0, 30, 0], Mode.READY, ()
        self.velocity, self.age, self.said, self.error = 0.0, 0.001, [], None
        self.times, self.failure = np.arange(0.0, 2.0, 0.004), None

    @property
    def joints(self):
        return len(self.degrees)

    def state(self, time, sequence=1):
        rest = (self.velocity,) * self.joints
        return RobotState(tuple(np.radians(self.degrees)), rest, self.mode, self.faults, time, sequence)

    def read(self, timeout):
        if self.error is not None:
            raise self.error
        return self.state(self.clock.now() - self.age)

    def subscribe(self, function):
        for number, t in enumerate(self.times):
            when = 100.0 + float(t)
            self.clock.call_at(when, lambda t=when, n=number: function(self.state(t, n)))
        return lambda: None

    def on_failure(self, function):
        if self.failure is not None:
            self.clock.call_at(100.5, lambda: function(self.failure))
        return lambda: None

    def findings(self):
        return self.said

    def start(self, path):
        raise AssertionError("moved")

    stop = enable = disable = reset_fault = start


@pytest.fixture
def robot():
    return Told()


def found(robot):
    return {each.subject: each for each in examine_robot(robot, CONFIG, robot.clock)}


def test_an_arm_in_order_is_good_in_every_line(robot):
    lines = found(robot)
    assert {each.verdict for each in lines.values()} == {"good"}
    assert lines["state rate"].said == "250.0 Hz, jitter 0.0 ms, longest gap 4 ms"
    assert lines["emergency stop"].said == "not pressed"
    assert lines["joints"].said.startswith("0.0 0.0 60.0 0.0 30.0 0.0 deg")


@pytest.mark.parametrize(
    ("mode", "verdict", "words"),
    [
        (Mode.DISABLED, "note", "drives are off"),
        (Mode.MANUAL, "problem", "manual"),
        (Mode.EMERGENCY_STOP, "problem", "emergency stop"),
        (Mode.FAULT, "problem", "fault"),
        (Mode.UNKNOWN, "problem", "does not say"),
    ],
)
def test_each_mode_but_ready_is_told_with_what_to_do(robot, mode, verdict, words):
    robot.mode = mode
    line = found(robot)["mode"]
    assert line.verdict == verdict
    assert words in line.said
    assert line.advice


def test_an_emergency_stop_has_a_line_of_its_own(robot):
    robot.mode = Mode.EMERGENCY_STOP
    assert (found(robot)["emergency stop"].said, found(robot)["emergency stop"].verdict) == ("pressed", "problem")
    robot.mode = Mode.UNKNOWN
    assert found(robot)["emergency stop"].said == "not known"


def test_faults_are_told_as_the_device_has_them(robot):
    robot.faults = ("joint 2: following error (8611h)",)
    assert found(robot)["faults"] == Finding(
        "faults", "joint 2: following error (8611h)", "problem", "clear them; then: dualcal reset"
    )


def test_joints_beyond_their_limits_are_a_problem_and_near_them_a_note(robot):
    robot.degrees = [0, 0, 60, 0, 121.5, 0]
    line = found(robot)["joints"]
    assert line.verdict == "problem"
    assert "beyond its limits: joint 5 by 1.5 deg" in line.said
    robot.degrees = [0, 0, 60, 0, 119, 0]
    line = found(robot)["joints"]
    assert line.verdict == "note"
    assert "joint 5, 1.0 deg inside" in line.said


def test_an_arm_of_other_joints_is_a_problem(robot):
    robot.degrees = [0, 0, 60, 0, 30, 0, 0]
    assert "7 angles where the cell file has 6 joints" in found(robot)["joints"].said


def test_an_arm_that_moves_is_noted(robot):
    robot.velocity = 0.1
    assert found(robot)["motion"].verdict == "note"


def test_jitter_is_told_and_a_gap_that_would_stop_a_motion_is_a_problem(robot):
    robot.times = np.concatenate([np.arange(0, 1, 0.01), np.arange(1.15, 1.9, 0.01)])
    line = found(robot)["state rate"]
    assert line.verdict == "problem"
    assert "longest gap 160 ms" in line.said
    assert "after 100 ms" in line.advice


def test_a_controller_that_reports_at_10_hz_may_take_three_periods(robot):
    robot.times = np.array([0.0, 0.1, 0.2, 0.3, 0.55, 0.65, 0.75, 0.85, 0.95])
    assert found(robot)["state rate"].verdict == "good"


def test_an_arm_that_reports_nothing_by_itself_is_a_problem(robot):
    robot.times = np.array([])
    assert found(robot)["state rate"] == Finding(
        "state rate", "0 in 2 s", "problem", "check the link and its state port"
    )


def test_failures_that_are_told_meanwhile_are_problems(robot):
    robot.failure = DeviceTimeout("left", "read", "its state is 0.12 s old")
    assert found(robot)["failure"].said == "its state is 0.12 s old"


@pytest.mark.parametrize(("age", "words"), [(-0.5, "500 ms ahead"), (3.0, "3000 ms old")])
def test_states_of_another_clock_are_a_problem(robot, age, words):
    robot.age = age
    line = found(robot)["clock"]
    assert line.verdict == "problem"
    assert words in line.said


def test_what_the_device_says_of_itself_is_told_and_not_twice(robot):
    robot.said = [Finding("byte order", "big endian, f32"), Finding("state rate", "told by the link")]
    lines = list(examine_robot(robot, CONFIG, robot.clock))
    assert lines[1] == robot.said[0]
    assert [each.said for each in lines if each.subject == "state rate"] == ["told by the link"]
    robot.times = np.array([])
    assert "0 in 2 s" in [each.said for each in examine_robot(robot, CONFIG, robot.clock)][-1]


def test_of_an_arm_that_does_not_answer_its_own_findings_are_still_told(robot):
    robot.error, robot.said = LinkLost("left", "read", "closed by the peer", "check the cable"), [Finding("port", "x")]
    assert list(examine_robot(robot, CONFIG, robot.clock)) == [
        Finding("reachable", "closed by the peer", "problem", "check the cable"),
        Finding("port", "x"),
    ]


# Cameras


class Shown(Camera):
    """A camera that shows one image."""

    def __init__(self, image):
        self.name, self.image, self.clock = "camera", image, VirtualClock(50.0)
        self.shift, self.asked, self.lost_after, self.said = 0.0, 0, None, []

    def grab(self, not_before, timeout):
        self.asked += 1
        if self.lost_after is not None and self.asked > self.lost_after:
            raise DeviceTimeout("camera", "grab", "no frame came", "check its cable")
        done = self.clock.now() + 0.05
        while self.clock.now() < done - 1e-9:
            self.clock.call_at(done, lambda: None)
            self.clock._next_call(done)
        return Frame(self.image, not_before + 0.01 + self.shift, self.asked)

    def findings(self):
        return self.said


def board(width=512, height=384, white=220, black=20, ground=110):
    image = np.full((height, width), ground, np.uint8)
    image[90:290, 150:350] = white
    for i in range(4):
        for j in range(4):
            if (i + j) % 2 == 0:
                image[110 + 40 * i : 150 + 40 * i, 170 + 40 * j : 210 + 40 * j] = black
    return image


def seen(camera):
    return {each.subject: each for each in examine_camera(camera, CELL, camera.clock)}


def test_a_camera_in_order_that_sees_the_target_is_good_in_every_line():
    lines = seen(Shown(board()))
    assert {each.verdict for each in lines.values()} == {"good"}
    assert "9 of 9 corners" in lines["target"].said
    assert lines["frame size"].said == "512 x 384 px, as the intrinsics'"
    assert "20.0 frames a second on demand" in lines["frames"].said


def test_frames_of_another_size_than_the_intrinsics_are_a_problem_and_no_target_is_looked_for():
    lines = seen(Shown(board(width=640, height=480)))
    assert lines["frame size"].verdict == "problem"
    assert "640 x 480 px, and the intrinsics are of 512 x 384" in lines["frame size"].said
    assert "target" not in lines


@pytest.mark.parametrize(("grey", "words"), [(5, "lengthen the exposure"), (255, "shorten the exposure")])
def test_an_image_too_dark_or_too_bright_says_what_to_do(grey, words):
    line = seen(Shown(np.full((384, 512), grey, np.uint8)))["light"]
    assert line.verdict == "problem"
    assert words in line.advice


def test_a_target_out_of_view_is_a_note():
    line = seen(Shown(np.random.default_rng(1).integers(80, 120, (384, 512)).astype(np.uint8)))["target"]
    assert line.verdict == "note"
    assert line.said.startswith("not seen: ")


@pytest.mark.parametrize("shift", [-2.0, 2.0])
def test_frames_of_another_clock_are_a_problem(shift):
    camera = Shown(board())
    camera.shift = shift
    assert seen(camera)["clock"].verdict == "problem"


def test_a_camera_that_gives_no_frame_says_why_and_what_else_it_knows():
    camera = Shown(board())
    camera.lost_after, camera.said = 0, [Finding("key", "known")]
    assert list(examine_camera(camera, CELL, camera.clock)) == [
        Finding("reachable", "no frame came", "problem", "check its cable"),
        Finding("key", "known"),
    ]


def test_a_camera_that_falls_silent_is_a_problem_and_its_last_frame_is_looked_at():
    camera = Shown(board())
    camera.lost_after = 3
    lines = seen(camera)
    assert lines["frames"] == Finding("frames", "after 3 frames: no frame came", "problem", "check its cable")
    assert "9 of 9" in lines["target"].said
