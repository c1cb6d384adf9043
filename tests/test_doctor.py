"""The doctor on the command line: what it prints, asks, records, and how it ends."""

from __future__ import annotations

import csv
import itertools
import json

import numpy as np
import pytest

from backends.simulator import SimulatorBackend
from backends.simulator.robot import SimulatedRobot
from dualcal_hal.cellfile import load_cell
from dualcal_hal.commissioning import Commissioning
from dualcal_hal.errors import LinkLost
from dualcal_hal.findings import Finding
from dualcal_hal.robot import JointPath, Mode, Motion, Robot, RobotState, StopResult
from tests.cells import TINY
from tests.command_line import dualcal

CELL = load_cell(TINY).cell
HOME = CELL.active.home_deg
POSTURES = [[10, -40, 50, 30, 40, 60], [-35, 20, 80, -40, -60, -100], [60, 35, -25, 75, 70, 20]]


@pytest.fixture
def real(tmp_path, monkeypatch):
    """A cell file whose arms pass for real ones."""
    monkeypatch.setattr(SimulatorBackend, "simulated", False)
    path = tmp_path / "cell.yaml"
    path.write_text(TINY.read_text())
    return path


def record(path):
    return Commissioning.of(path, load_cell(path))


# Looking


def test_of_a_cell_in_order_every_device_is_told_of_within_80_columns(monkeypatch):
    result = dualcal("doctor", TINY)
    assert result.exit_code == 0, result.output
    for words in ("left, by simulator 'sim'", "right, by", "camera, by", "ready", "20.0 Hz", "9 of 9 corners"):
        assert words in result.output
    assert max(map(len, result.output.splitlines())) <= 80
    assert result.output.splitlines()[-1] == "All good."


def test_json_is_a_document_alone():
    result = dualcal("doctor", TINY, "--json")
    document = json.loads(result.stdout)
    assert document["format"] == "dualcal.doctor/1"
    assert document["good"]
    assert [device["device"] for device in document["devices"]] == ["left", "right", "camera"]
    assert {"subject", "said", "verdict", "advice"} == set(document["devices"][0]["findings"][0])
    assert document["missing"] == []


def test_a_device_that_cannot_be_opened_is_told_and_the_next_is_still_looked_at(monkeypatch):
    original = SimulatorBackend.open_alone

    def open_alone(self, device, timeout):
        if device == "left":
            raise LinkLost("left", "open", "127.0.0.1:11002: connection refused", "check that its server runs")
        original(self, device, timeout)

    monkeypatch.setattr(SimulatorBackend, "open_alone", open_alone)
    result = dualcal("doctor", TINY)
    assert result.exit_code == 1
    assert "PROBLEM  reachable  127.0.0.1:11002: connection refused" in result.output
    assert "-> check that its server runs" in result.output
    assert result.output.count("ready: it would carry out a motion") == 1
    assert result.output.splitlines()[-1] == "1 problem; see above."


def test_looking_moves_nothing_and_enables_nothing(monkeypatch):
    for command in ("start", "enable", "disable", "reset_fault", "stop"):
        monkeypatch.setattr(SimulatedRobot, command, lambda *_: pytest.fail("commanded"))
    assert dualcal("doctor", TINY).exit_code == 0


def test_on_a_cell_that_is_not_simulated_it_is_said_what_is_missing_before_its_first_run(real):
    result = dualcal("doctor", real)
    assert result.exit_code == 0
    assert result.output.count("was not done yet") == 4
    assert not record(real).path.exists()


def test_a_damaged_record_is_refused_before_anything_is_opened(real, monkeypatch):
    monkeypatch.setattr(SimulatorBackend, "open_alone", lambda *_: pytest.fail("opened"))
    record(real).path.write_text("{}")
    result = dualcal("doctor", real)
    assert result.exit_code == 2
    assert "key 'format' is missing" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--flange", "--wiggle"], "two checks"),
        (["--flange", "--arm", "middle", "--rotation", "kuka"], "there is no arm 'middle'; there are: left, right"),
        (["--flange"], "say with --rotation"),
        (["--flange", "--rotation", "euler"], "there are rotation-vector, abb, fanuc, kuka, motoman"),
        (["--rotation", "abb"], "are of the check with --flange"),
        (["--yes"], "are of --wiggle"),
        (["--enable", "--flange", "--rotation", "abb"], "are of --wiggle"),
        (["--arm", "left"], "is of --flange and --wiggle"),
    ],
)
def test_calls_that_make_no_sense_are_refused(arguments, words):
    result = dualcal("doctor", TINY, *arguments)
    assert result.exit_code == 2
    assert words in result.stderr


# The flange, typed


@pytest.fixture
def jogged(monkeypatch):
    """The arm stands at one posture after the other, and at the last from then on."""

    def jog(*postures):
        states = itertools.chain(postures, itertools.repeat(postures[-1]))
        numbers = itertools.count(1)

        def read(self, timeout):
            q = tuple(np.radians(next(states)))
            return RobotState(q, (0.0,) * len(q), Mode.READY, (), 0.0, next(numbers))

        monkeypatch.setattr(SimulatedRobot, "read", read)

    return jog


def shown(degrees, arm="left"):
    """x y z W P R, as a pendant shows them."""
    T = CELL.robots[arm].chain.forward(np.radians(degrees))
    R = T[:3, :3]
    wpr = np.degrees([np.arctan2(R[2, 1], R[2, 2]), -np.arcsin(R[2, 0]), np.arctan2(R[1, 0], R[0, 0])])
    return " ".join(f"{number:.2f}" for number in (*(1e3 * T[:3, 3]), *wpr))


def check_left(path, typed, *more):
    return dualcal("doctor", path, "--flange", "--rotation", "fanuc", "--arm", "left", *more, typed=typed)


def test_poses_typed_at_the_pendant_are_held_against_the_joints_read_there(real, jogged):
    jogged(*POSTURES)
    result = check_left(real, "\n".join(map(shown, POSTURES)) + "\n")
    assert result.exit_code == 0, result.output
    assert "Good: the pendant and our kinematics agree within 3 mm and 0.5 deg." in result.output
    assert "no tool, no work object" in result.output
    assert record(real).flange_checked("left")
    assert not record(real).flange_checked("right")


def test_a_mistaken_joint_is_named_with_what_to_change_and_recorded_as_not_passed(real, jogged):
    jogged(*[[a, b, -c, d, e, f] for a, b, c, d, e, f in POSTURES])
    result = check_left(real, "\n".join(map(shown, POSTURES)))
    assert result.exit_code == 1
    assert "Likely cause: the sign of joint 3 is wrong: it turns the other way" in result.output
    assert "-> change sign in the arm's joint_map" in result.output
    assert "the sign of joint 3" in record(real).missing()[0]


def test_what_poses_do_not_prove_is_asked_for_by_more_poses(real, jogged):
    still = [[*posture[:4], 25, posture[5]] for posture in POSTURES]
    all_ = [*still, [5, 15, 40, 10, -30, 80]]
    jogged(*all_)
    result = check_left(real, "\n".join(map(shown, all_)))
    assert result.exit_code == 0, result.output
    assert "the sign of joint 5: take a pose in which it stands elsewhere" in result.output
    assert "pose 4, x y z W P R:" in result.output


def test_what_is_no_pose_is_asked_for_again(real, jogged):
    jogged(*POSTURES)
    lines = ["1 2 3", "a b c d e f", "", *map(shown, POSTURES)]
    result = check_left(real, "\n".join(lines))
    assert result.exit_code == 0, result.output
    assert "3 numbers where x y z W P R are needed" in result.output


def test_an_input_that_ends_early_records_nothing(real, jogged):
    jogged(*POSTURES)
    result = check_left(real, shown(POSTURES[0]) + "\n")
    assert result.exit_code == 2
    assert "the input ended after 1 poses" in result.stderr
    assert not record(real).path.exists()


def test_the_usual_difference_is_an_option(real, jogged):
    jogged(*POSTURES)
    other = [shown(posture).split(" ", 1) for posture in POSTURES]
    typed = "\n".join(f"{float(x) + 4.0:.2f} {rest}" for x, rest in other)
    assert "Good, but more than 3 mm" in check_left(real, typed).output
    jogged(*POSTURES)
    assert "Not good" in check_left(real, typed, "--within-mm", "1").output


def test_on_a_simulated_cell_nothing_is_recorded(jogged, tmp_path):
    path = tmp_path / "cell.yaml"
    path.write_text(TINY.read_text())
    jogged(*POSTURES)
    result = check_left(path, "\n".join(map(shown, POSTURES)))
    assert result.exit_code == 0
    assert "simulated: nothing is recorded" in result.output
    assert list(tmp_path.iterdir()) == [path]


# The flange, from a file


@pytest.fixture
def poses_file(tmp_path):
    def write(postures, read=None, name="poses.json", **changes):
        path = tmp_path / name
        poses = []
        for posture, joints in zip(postures, read or postures, strict=True):
            x, y, z, w, p, r = (float(number) for number in shown(posture).split())
            T = CELL.active.chain.forward(np.radians(posture))
            poses.append({"flange_in_base": {"matrix": T.tolist()}, "joints_deg": joints})
            if path.suffix == ".csv":
                poses[-1] = [x, y, z, w, p, r, *joints]
        if path.suffix == ".csv":
            names = ["x", "y", "z", "W", "P", "R", "j1", "j2", "j3", "j4", "j5", "j6"]
            with path.open("w", newline="") as file:
                csv.writer(file).writerows([names, *poses])
        else:
            path.write_text(json.dumps({"arm": "left", "poses": poses, **changes}))
        return path

    return write


def test_a_file_of_poses_is_checked_with_the_arm_at_its_last(real, poses_file, jogged):
    jogged(POSTURES[-1])
    result = dualcal("doctor", real, "--flange", "--poses", poses_file(POSTURES), "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)["flange"]["left"]
    assert document["good"]
    assert len(document["deviation_mm"]) == 3
    assert record(real).flange_checked("left")


def test_a_table_of_poses_says_in_its_first_line_what_it_has(real, poses_file, jogged):
    jogged(POSTURES[-1])
    path = poses_file(POSTURES, name="poses.csv")
    result = dualcal("doctor", real, "--flange", "--poses", path, "--arm", "left")
    assert result.exit_code == 0, result.output


def test_a_file_whose_joints_are_not_those_that_we_read_is_refused(real, poses_file, jogged):
    """As the pendant's joints are, where a joint map lies between."""
    jogged(POSTURES[-1])
    pendants = [[a, b, c + b, d, e, f] for a, b, c, d, e, f in POSTURES]
    result = dualcal("doctor", real, "--flange", "--poses", poses_file(POSTURES, pendants))
    assert result.exit_code == 2
    assert "does not stand at the file's last pose: joint 3 is read 35.00 deg away" in result.stderr
    assert not record(real).path.exists()


def test_a_last_pose_that_tells_no_joints_apart_proves_nothing_of_them(real, poses_file):
    result = dualcal("doctor", real, "--flange", "--poses", poses_file([*POSTURES, list(HOME)]))
    assert result.exit_code == 2
    assert "put one last in which each joint is 1 deg or more away from zero and from all others" in result.stderr


def test_joints_that_a_file_does_not_have_are_read_with_the_arm_jogged_there(real, poses_file, jogged):
    path = poses_file(POSTURES)
    document = json.loads(path.read_text())
    for pose in document["poses"]:
        del pose["joints_deg"]
    path.write_text(json.dumps(document))
    jogged(*POSTURES)
    result = dualcal("doctor", real, "--flange", "--poses", path, typed="\n\n\n")
    assert result.exit_code == 0, result.output
    assert "Jog 'left' to pose 3 of the file" in result.output


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ('{"arm": "left"}', "poses: "),
        ('{"arm": "left", "poses": [{"flange_in_base": {"translation_mm": [1, 2, 3]}}]}', "must have translation_mm"),
        ('{"arm": "left", "poses": [{"flange": 1}]}', "poses.0.flange"),
        ('{"arm": "left", "poses": []}', "0 poses; at least 3"),
        ('{"arm": "up", "poses": []}', "say with --arm whose"),
        ("x", "is not JSON"),
    ],
)
def test_a_file_that_has_no_poses_is_refused_in_words(real, tmp_path, content, words):
    path = tmp_path / "poses.json"
    path.write_text(content)
    result = dualcal("doctor", real, "--flange", "--poses", path)
    assert result.exit_code == 2
    assert words in result.stderr


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "must name its columns"),
        ("a,b\n1,2", "must name its columns"),
        ("x,y,z,W,P,R,q1\n", "after R come j1,j2"),
        ("x,y,z,W,P,R\n1,2,3\n", "poses.csv:2: 3 values where there are 6 columns"),
        ("x,y,z,W,P,R\n1,2,3,4,5,nan\n", "not finite"),
        ("x,y,z,q1,q2,q3,q4\n1,2,3,4,5,6,7\n", "a quaternion has length 1"),
        ("x,y,z,W,P,R\n1,2,3,4,5,six\n", "could not convert"),
    ],
)
def test_a_table_that_has_no_poses_is_refused_with_the_line(real, tmp_path, content, words):
    path = tmp_path / "poses.csv"
    path.write_text(content)
    result = dualcal("doctor", real, "--flange", "--poses", path, "--arm", "left")
    assert result.exit_code == 2
    assert words in result.stderr


def test_a_quaternion_with_a_pendants_few_digits_is_a_rotation(real, tmp_path, jogged):
    jogged(POSTURES[-1])
    path = tmp_path / "poses.json"
    flange = {"translation_mm": [1, 2, 3], "quaternion_xyzw": [0, 0.707, 0, 0.707]}
    path.write_text(json.dumps({"arm": "left", "poses": [{"flange_in_base": flange, "joints_deg": POSTURES[-1]}] * 3}))
    assert dualcal("doctor", real, "--flange", "--poses", path).exit_code == 1


# The wiggle


class Mistaken(Robot):
    """An arm whose joints are others than the cell file says: turned by signs, and exchanged."""

    def __init__(self, robot, clock, order, sign):
        self.name, self._robot, self._clock = robot.name, robot, clock
        self._order, self._sign = np.array(order), np.array(sign)

    @property
    def joints(self):
        return self._robot.joints

    def _true(self, q):
        return tuple((np.array(q) * self._sign)[np.argsort(self._order)])

    def _seen(self, q):
        return tuple(np.array(q)[self._order] * self._sign)

    def read(self, timeout):
        return self._seen_state(self._robot.read(timeout))

    def _seen_state(self, state):
        rest = (0.0,) * self.joints
        return RobotState(self._seen(state.positions), rest, state.mode, state.faults, state.time, state.sequence)

    def start(self, path):
        waypoints = tuple(self._true(waypoint) for waypoint in path.waypoints)
        sent = self._robot.start(JointPath(waypoints, path.speed, path.acceleration))
        motion = Motion(self.name, self._clock)
        sent.on_end(lambda: motion.end(sent.state, sent.final and self._seen_state(sent.final), sent.error))
        return motion

    def subscribe(self, function):
        return lambda: None

    def stop(self, reason):
        return self._robot.stop(reason)

    def enable(self, timeout):
        self._robot.enable(timeout)

    disable = reset_fault = enable


@pytest.fixture
def mistaken(monkeypatch):
    def mistake(order, sign):
        original = SimulatorBackend.robot

        def robot(self, name):
            true = original(self, name)
            return Mistaken(true, self.clock, order, sign) if name == "right" else true

        monkeypatch.setattr(SimulatorBackend, "robot", robot)

    return mistake


STRAIGHT = (0, 1, 2, 3, 4, 5), (1, 1, 1, 1, 1, 1)


def wiggle(path, typed, *more):
    return dualcal("doctor", path, "--wiggle", *more, typed=typed)


def test_each_joint_is_turned_and_back_and_what_the_camera_saw_needs_no_answer(real):
    result = wiggle(real, "y\n", "--arm", "right")
    assert result.exit_code == 0, result.output
    assert result.output.count("the camera saw it") == 6
    assert "'right', joint 2 by +1.0 deg: its flange moves inward by 11.9 mm" in result.output
    assert record(real).wiggled("right")
    assert not record(real).wiggled("left")


def test_where_the_camera_does_not_tell_the_operator_is_asked(real):
    result = wiggle(real, "y\n" * 7, "--arm", "left")
    assert result.exit_code == 0, result.output
    assert result.output.count("Did this joint alone turn") == 3
    assert record(real).wiggled("left")


def test_a_no_names_sign_or_order_and_the_other_joints_are_still_turned(real):
    result = wiggle(real, "y\nn\ny\ny\n", "--arm", "left")
    assert result.exit_code == 1
    assert "'left': joint 2: did not turn so: its sign or the order of the joints is wrong." in result.output
    assert "'left', joint 6 by" in result.output
    assert any("joint 2: did not turn so" in lack for lack in record(real).missing())


@pytest.mark.parametrize(
    ("order", "sign", "words"),
    [
        (STRAIGHT[0], (-1, 1, 1, 1, 1, 1), "joint 1: the camera saw it turn the other way: its sign is wrong"),
        ((4, 1, 2, 3, 0, 5), STRAIGHT[1], "joint 1: the camera saw joint 5 turn in its place"),
    ],
)
def test_a_mistaken_joint_is_found_by_the_camera(real, mistaken, order, sign, words):
    mistaken(order, sign)
    # Both postures are within limits, and the arm stands in one where its joints are told apart.
    result = wiggle(real, "y\n" * 10, "--arm", "right", "--set", "robots.right.home_deg=[30, 0, 60, 10, 30, 20]")
    assert result.exit_code == 1, result.output
    assert words in result.output


def test_nothing_moves_before_it_is_confirmed(real, monkeypatch):
    monkeypatch.setattr(SimulatedRobot, "start", lambda *_: pytest.fail("moved"))
    for typed in ("n\n", ""):
        result = wiggle(real, typed)
        assert result.exit_code == 2
        assert "not confirmed; nothing was moved" in result.stderr
    assert "What 'right' will do" in result.output


def test_yes_begins_without_asking_and_answers_nothing_else(real):
    result = wiggle(real, "", "--yes", "--arm", "left")
    assert result.exit_code == 2
    assert "joint 2 of 'left' is back, and nobody said what was seen of it" in result.stderr
    assert not record(real).path.exists()


def test_a_target_out_of_view_leaves_all_to_the_operator(real):
    away = "robots.right.home_deg=[150, 0, 60, 0, 30, 0]"
    result = wiggle(real, "y\n" * 8, "--arm", "right", "--set", away)
    assert result.exit_code == 0, result.output
    assert result.output.count("the camera is of no help: ") == 6


def test_joints_turn_slowly_there_and_back_one_at_a_time(real, monkeypatch):
    sent = []
    original = SimulatedRobot.start
    monkeypatch.setattr(SimulatedRobot, "start", lambda self, path: sent.append(path) or original(self, path))
    assert wiggle(real, "y\n", "--arm", "right").exit_code == 0
    assert len(sent) == 12
    home = np.radians(HOME)
    for number, path in enumerate(sent):
        (goal,) = np.degrees(np.array(path.waypoints) - home)
        wanted = np.eye(6)[number // 2] if number % 2 == 0 else np.zeros(6)
        np.testing.assert_allclose(goal, wanted, atol=0.01)
        assert max(path.speed) <= np.deg2rad(2.0) + 1e-12


def test_an_arm_that_is_not_ready_is_not_moved_unless_it_is_to_be_enabled(real, monkeypatch):
    original = SimulatorBackend.open

    def opened(self, timeout):
        original(self, timeout)
        for arm in ("left", "right"):
            self.robot(arm).disable(1.0)

    monkeypatch.setattr(SimulatorBackend, "open", opened)
    result = wiggle(real, "y\n", "--arm", "right")
    assert result.exit_code == 1
    assert "not ready: mode 'disabled'" in result.stderr
    result = wiggle(real, "y\n", "--arm", "right", "--enable")
    assert result.exit_code == 0, result.output
    assert "right: its drives were switched on" in result.output


class Interrupting:
    """Signals of which one comes as soon as anybody asks."""

    def __enter__(self):
        return self

    def __exit__(self, *error):
        return None

    def pass_on_to(self, abort):
        abort("interrupted by SIGINT")


@pytest.mark.parametrize("confirmed", [True, False])
def test_an_interrupt_stops_the_arm_on_its_way_and_nothing_is_recorded(real, monkeypatch, confirmed):
    stopped = []
    original = SimulatedRobot.stop

    def stop(self, reason):
        stopped.append((self.name, reason))
        original(self, reason)
        return StopResult(confirmed, "no newer state came")

    monkeypatch.setattr(SimulatedRobot, "stop", stop)
    monkeypatch.setattr("tools.cli.wiggle.signals_deferred", Interrupting)
    result = wiggle(real, "y\n" * 10)
    assert result.exit_code != 0
    assert stopped[0] == ("left", "interrupted by SIGINT")
    assert ("use the emergency stop" in result.stderr) == (not confirmed)
    assert not record(real).path.exists()


def test_long_lines_of_a_device_are_folded_and_never_cut(monkeypatch):
    said = "a sentence that says all there is to say of a thing, and goes on and on for longer than a line has room"
    found = [Finding("joint 1 (node 1) heartbeat", said, "note", "x" * 100)]
    monkeypatch.setattr(SimulatedRobot, "findings", lambda self: found)
    output = dualcal("doctor", TINY).output
    assert max(map(len, output.splitlines())) <= 80
    words = " ".join(output.split())
    assert "heartbeat" in words
    assert "longer than a line has room" in " ".join(line[29:].strip() for line in output.splitlines())
    assert output.count("x") >= 100
