"""`dualcal run --resume`: a run that was interrupted goes on, and comes to what it would have come to."""

from __future__ import annotations

import json
import random
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from backends.simulator import SimulatorBackend
from dualcal_hal.errors import LinkLost
from dualcal_hal.guard import GuardedRobot
from dualcal_hal.session.captures import read_captures
from dualcal_hal.session.folder import Session
from dualcal_hal.session.journal import Journal
from dualcal_hal.session.lock import LOCK, SessionLock
from dualcal_hal.transforms import rotation_angle
from procedures.planning.ways import WayFinder
from tests.test_run import dualcal, sets
from tools.benchmarks.kills import differences_from, kill_many, once_journalled, survive

TINY = Path(__file__).parent.parent / "cells" / "tiny.yaml"
LEFT_BEHIND = ("result.json", "summary.png", "captures.json", "distances.json")
ALL_ERRORS = """simulation.errors={
  kinematics: {angle_deg: 0.01, length_mm: 0.05}, joint_zero: {offset_deg: {left: [0, 0.005, 0, 0, 0, 0]}},
  encoder_eccentricity: {amplitude_mrad: 0.05}, backlash: {gap_mrad: 0.15}, compliance: {sag_mrad: 0.3},
  arm_scale: {ppm: 200}, base_drift: {translation_mm_per_hour: 20, rotation_deg_per_hour: 1},
  thermal: {growth_ppm: 300, time_constant_min: 1}, mount_flex: {mrad_per_g: 0.2}, target_mount: {translation_mm: 0.2},
  target_slip: {translation_mm: 0.1, at_s: 15}, settle_time: {amplitude_mrad: 0.2}, time_skew: {delay_s: 0.03},
  square_scale: {x_ppm: 200}, flatness: {bow_mm: 0.05}, focal: {x_ppm: 200}, principal_point: {right_px: 0.2},
  lighting: {gradient_percent: 20}, corner_bias: {right_px: 0.02}, defocus: {px_per_dioptre: 0.1},
  motion_blur: {exposure_ms: 5}}"""


def run(folder, *overrides):
    return dualcal("run", TINY, "--out", folder, *sets(*overrides))


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A run that nothing has interrupted."""
    folder = tmp_path_factory.mktemp("whole") / "session"
    result = run(folder)
    assert result.exit_code == 0, result.output
    (folder / "output.txt").write_text(result.output)
    return folder


@pytest.fixture
def interrupted(session, tmp_path):
    """The session as it was when so many steps were finished."""

    def at(steps):
        folder = tmp_path / "interrupted"
        shutil.copytree(session, folder)
        for name in LEFT_BEHIND:
            (folder / name).unlink(missing_ok=True)
        lines = (session / "journal.jsonl").read_bytes().splitlines(keepends=True)
        (folder / "journal.jsonl").write_bytes(b"".join(lines[: 1 + steps]))
        return folder

    return at


@pytest.fixture
def lose_the_link(monkeypatch):
    """Have the link be lost once so many steps are finished in this process, or at the move of a number."""
    append, start, counts = Journal.append, GuardedRobot.start, {}

    def at(*, steps=None, move=None):
        counts.update(steps=steps, move=move)

    def appending(self, *arguments):
        append(self, *arguments)
        if counts["steps"] is not None:
            counts["steps"] -= 1
            if counts["steps"] == 0:
                raise LinkLost("right", "read", "no answer")

    def starting(self, path):
        if counts["move"] is not None:
            counts["move"] -= 1
            if counts["move"] == 0:
                raise LinkLost("right", "move", "no answer")
        return start(self, path)

    at()
    monkeypatch.setattr(Journal, "append", appending)
    monkeypatch.setattr(GuardedRobot, "start", starting)
    return at


def came_to(folder):
    """All that a run comes to but when it was."""
    captures = json.loads((folder / "captures.json").read_text())
    captures.pop("started")
    return captures, json.loads((folder / "result.json").read_text())


def steps_of(folder):
    return len(Session(folder).journal.results())


def contents(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def interrupted_after_each_step(folder, lose_the_link, *overrides):
    """A run that goes no farther than one step at a time; how often it was gone on with."""
    lose_the_link(steps=1)
    result = run(folder, *overrides)
    for times in range(100):
        if result.exit_code == 0:
            return times
        assert "no answer" in result.stderr
        assert steps_of(folder) == times + 1
        lose_the_link(steps=1)
        result = dualcal("run", "--resume", folder)
    raise AssertionError("it comes to no end")


# -- the same result -------------------------------------------------------------------------------


def test_a_run_that_is_interrupted_after_every_single_step_comes_to_the_same(session, tmp_path, lose_the_link):
    times = interrupted_after_each_step(tmp_path / "s", lose_the_link)
    assert times == steps_of(session)
    assert came_to(tmp_path / "s") == came_to(session)


@pytest.mark.parametrize("moves", [1, *(pytest.param(moves, marks=pytest.mark.slow) for moves in (4, 7))])
def test_a_run_that_is_interrupted_at_a_move_again_and_again_comes_to_the_same(session, tmp_path, lose_the_link, moves):
    lose_the_link(move=moves)
    result = run(tmp_path / "s")
    interruptions = 0
    while result.exit_code != 0:
        assert "no answer" in result.stderr
        interruptions += 1
        lose_the_link(move=moves + interruptions)
        result = dualcal("run", "--resume", tmp_path / "s")
    assert interruptions > 1
    assert came_to(tmp_path / "s") == came_to(session)


@pytest.mark.slow
def test_with_all_errors_of_real_cells_too_a_run_that_goes_on_comes_to_the_same(tmp_path, lose_the_link):
    whole = run(tmp_path / "whole", ALL_ERRORS)
    assert "Verdict" in whole.stdout
    lose_the_link(steps=3)
    result = run(tmp_path / "s", ALL_ERRORS)
    while "no answer" in result.stderr:
        lose_the_link(steps=3)
        result = dualcal("run", "--resume", tmp_path / "s")
    assert result.exit_code == whole.exit_code
    assert len(list((tmp_path / "s").glob("log-*.mcap"))) > 4
    assert came_to(tmp_path / "s") == came_to(tmp_path / "whole")


@pytest.mark.slow
def test_each_step_alone_may_be_the_last_before_the_run_is_killed(session, interrupted):
    for steps in range(steps_of(session)):
        folder = interrupted(steps)
        assert dualcal("run", "--resume", folder).exit_code == 0
        assert came_to(folder) == came_to(session)
        shutil.rmtree(folder)


@pytest.mark.slow
def test_in_physics_a_run_that_goes_on_comes_to_the_same_within_a_hundredth_of_a_millimetre(tmp_path, lose_the_link):
    bullet = "simulation.stepper=bullet"
    assert run(tmp_path / "whole", bullet).exit_code == 0
    lose_the_link(steps=7)
    assert run(tmp_path / "s", bullet).exit_code == 1
    lose_the_link(move=3)
    assert dualcal("run", "--resume", tmp_path / "s").exit_code == 1
    lose_the_link()
    resumed = dualcal("run", "--resume", tmp_path / "s")
    assert resumed.exit_code == 0
    whole, again = (json.loads((tmp_path / name / "result.json").read_text()) for name in ("whole", "s"))
    for name, transform in whole["transforms"].items():
        T, other = (np.array(each["matrix"]) for each in (transform, again["transforms"][name]))
        assert np.linalg.norm(T[:3, 3] - other[:3, 3]) <= 1e-5
        assert np.rad2deg(rotation_angle(T[:3, :3], other[:3, :3])) <= 1e-3
    # What was measured before the interruptions is still there.
    whole, again = (json.loads((tmp_path / name / "distances.json").read_text()) for name in ("whole", "s"))
    assert min(again["distance_mm"]) == pytest.approx(min(whole["distance_mm"]), abs=1)
    assert [part[0] for part in again["measured_s"]] == sorted(part[0] for part in again["measured_s"])
    assert len(again["measured_s"]) == 3
    assert "not known" not in resumed.stdout


def test_a_run_that_is_killed_goes_on_to_the_same_and_keeps_what_it_reported(session, tmp_path):
    moments = iter([once_journalled(tmp_path / "s", steps=8), None])
    trial = survive(TINY, (), tmp_path / "s", session, lambda: next(moments))
    assert trial.wrong == []
    assert len(trial.kills) == 1


@pytest.mark.slow
def test_runs_that_are_killed_at_any_moment_go_on_to_the_same(tmp_path):
    trials = kill_many(TINY, (), 5, random.Random(3), tmp_path)
    assert [wrong for trial in trials for wrong in trial.wrong] == []
    assert sum(len(trial.kills) for trial in trials) == 5


def test_the_script_that_kills_runs_tells_what_is_missing_or_differs(session, tmp_path):
    shutil.copytree(session, tmp_path / "s")
    for name, change in (
        ("captures.json", lambda document: document["captures"].pop()),
        ("result.json", lambda document: document.update(verdict="fail")),
    ):
        document = json.loads((session / name).read_text())
        change(document)
        (tmp_path / "s" / name).write_text(json.dumps(document))
    lines = (session / "journal.jsonl").read_bytes().splitlines(keepends=True)
    (tmp_path / "s" / "journal.jsonl").write_bytes(b"".join(lines[:-1]))
    (tmp_path / "s" / "images" / "calibration-00-1.png").unlink()
    (tmp_path / "s" / "log-0001.mcap").write_bytes((session / "log-0001.mcap").read_bytes().replace(b"calib", b"CALIB"))
    wrong = differences_from(tmp_path / "s", session, {"verification/00/2"})
    assert len(wrong) >= 5
    for words in (
        "verification/00/2 was reported",
        "calibration-00-1.png",
        "captures.json differs",
        "result.json differs",
    ):
        assert any(words in line for line in wrong)
    assert any("log-0001.mcap" in line for line in wrong)
    assert differences_from(session, session, {"verification/00/2"}) == []


def test_the_start_that_is_told_is_the_first_one(interrupted):
    folder = interrupted(6)
    started = Session(folder).journal.started
    assert started is not None
    assert dualcal("run", "--resume", folder).exit_code == 0
    assert read_captures(folder / "captures.json").started == started


@pytest.mark.parametrize(
    "left", [*(pytest.param(left, marks=pytest.mark.slow) for left in ("nothing", "no byte")), "half a line"]
)
def test_a_session_that_was_killed_before_its_first_step_is_begun_anew(session, interrupted, left):
    folder = interrupted(0)
    if left == "nothing":
        (folder / "journal.jsonl").unlink()
    else:
        (folder / "journal.jsonl").write_bytes(b"" if left == "no byte" else b'{"format": "dual')
    assert dualcal("run", "--resume", folder).exit_code == 0
    assert came_to(folder) == came_to(session)
    assert Session(folder).journal.results()[0][0].kind == "stand-off"


def test_a_journal_that_does_not_say_how_the_steps_left_the_cell_is_gone_on_with(session, interrupted):
    folder = interrupted(6)
    journal = folder / "journal.jsonl"
    header, *entries = [json.loads(line) for line in journal.read_text().splitlines()]
    header.pop("started")
    for entry in entries:
        del entry["arms"], entry["backends"]
        if entry["result"].get("servo_first") is not None:
            del entry["result"]["servo_first"]
    journal.write_text("".join(json.dumps(line) + "\n" for line in (header, *entries)))
    assert dualcal("run", "--resume", folder).exit_code == 0
    before, after = (json.loads((each / "result.json").read_text()) for each in (session, folder))
    assert after["transforms"] == before["transforms"]


@pytest.mark.parametrize("steps", [*(pytest.param(steps, marks=pytest.mark.slow) for steps in (0, 2)), 7])
def test_a_session_whose_images_are_lost_goes_on(session, interrupted, steps):
    folder = interrupted(steps)
    shutil.rmtree(folder / "images")
    result = dualcal("run", "--resume", folder)
    assert result.exit_code == 0, result.output
    assert came_to(folder) == came_to(session)
    assert (folder / "images" / "verification-00-2.png").exists()


@pytest.mark.parametrize("lost", ["images", "images/calibration-00-0.png", "plan.json"])
def test_a_session_that_has_all_captured_is_concluded_without_the_part_of_the_picture_that_is_lost(
    session, interrupted, lost, capfd
):
    folder = interrupted(steps_of(session))
    shutil.rmtree(folder / lost) if (folder / lost).is_dir() else (folder / lost).unlink()
    result = dualcal("run", "--resume", folder)
    assert result.exit_code == 0, result.output
    said = "plan.json: is missing; the picture" if lost == "plan.json" else "calibration-00-0.png: there is no readable"
    assert [said in line for line in result.stdout.splitlines()].count(True) == 1
    assert capfd.readouterr().err == ""
    assert came_to(folder) == came_to(session)
    assert (folder / "summary.png").exists()
    assert "taken over" not in dualcal("run", "--resume", folder).stdout, "it is finished now"


# -- where the arms stand --------------------------------------------------------------------------


def arrivals(folder):
    """The numbers of the active arm's arrivals, by constraint."""
    numbers = {}
    for capture in read_captures(folder / "captures.json").captures:
        numbers.setdefault(capture.constraint, []).append(capture.active_arrival)
    return numbers


def test_an_arm_that_may_have_been_moved_meanwhile_counts_as_arrived_anew(session, interrupted, monkeypatch):
    monkeypatch.setattr(SimulatorBackend, "repeats_targets", False)
    folder = interrupted(7)
    assert Session(folder).journal.results()[-1][0].position == 1
    assert dualcal("run", "--resume", folder).exit_code == 0
    first, *others = arrivals(folder).values()
    assert first[0] == first[1] != first[2]
    assert all(len(set(numbers)) == 1 for numbers in others)
    every = [number for numbers in (first[1:], *others) for number in dict.fromkeys(numbers)]
    assert len(set(every)) == len(every)
    before, after = (json.loads((each / "result.json").read_text()) for each in (session, folder))
    assert after == before


@pytest.mark.parametrize("moved", ["left", "right"])
def test_an_arm_that_stands_elsewhere_than_it_was_left_is_taken_from_there(session, interrupted, moved):
    folder = interrupted(7)
    header, *entries = [json.loads(line) for line in (folder / "journal.jsonl").read_text().splitlines()]
    arm = entries[-1]["backends"]["sim"]["arms"][moved]
    for key in ("target_rad", "joints_rad"):
        arm[key][5] += 0.02
    (folder / "journal.jsonl").write_text("".join(json.dumps(line) + "\n" for line in (header, *entries)))
    assert dualcal("run", "--resume", folder).exit_code == 0
    whole, resumed = (read_captures(each / "captures.json").captures for each in (session, folder))
    assert len(resumed) == len(whole)
    for before, after in zip(whole, resumed, strict=True):
        np.testing.assert_allclose(after.active_joints, before.active_joints, atol=1e-3)


def test_only_arms_that_were_moved_since_are_told_to_stop(interrupted, lose_the_link):
    folder = interrupted(7)
    lose_the_link(move=1)
    result = dualcal("run", "--resume", folder)
    assert result.exit_code == 1
    assert "stopped: right" in result.stderr


def test_an_arm_that_stands_where_it_was_left_within_its_scatter_is_believed_to(interrupted, monkeypatch):
    """Planning then begins at where it was sent, not at a reading of that."""
    folder, asked = interrupted(7), []
    find = WayFinder.find
    monkeypatch.setattr(WayFinder, "find", lambda self, *query: asked.append(query[0]) or find(self, *query))
    left = Session(folder).journal.left.arms
    assert dualcal("run", "--resume", folder).exit_code == 0
    assert (asked[0].active, asked[0].passive) == (left["left"].target, left["right"].target)


# -- finished and captured -------------------------------------------------------------------------


def test_a_finished_session_is_reported_again_and_nothing_is_opened_or_written(session, monkeypatch):
    monkeypatch.setattr(SimulatorBackend, "open", lambda self, timeout: pytest.fail("a device was opened"))
    before = contents(session)
    again = dualcal("run", "--resume", session)
    assert again.exit_code == 0
    table = again.stdout[: again.stdout.index("session:")]
    assert "Verdict: ok" in table
    assert table in (session / "output.txt").read_text()
    assert dualcal("run", "--resume", session, "--json").stdout == (session / "result.json").read_text()
    assert contents(session) == before


def test_a_finished_session_has_the_exit_code_that_it_had(session, tmp_path):
    shutil.copytree(session, tmp_path / "s")
    result = json.loads((session / "result.json").read_text())
    (tmp_path / "s" / "result.json").write_text(json.dumps({**result, "verdict": "fail"}))
    assert dualcal("run", "--resume", tmp_path / "s").exit_code == 1


@pytest.mark.parametrize("missing", [["result.json"], ["summary.png"], ["result.json", "captures.json", "summary.png"]])
def test_a_run_that_has_captured_all_is_only_analysed(session, tmp_path, monkeypatch, missing):
    monkeypatch.setattr(SimulatorBackend, "open", lambda self, timeout: pytest.fail("a device was opened"))
    shutil.copytree(session, tmp_path / "s")
    for name in missing:
        (tmp_path / "s" / name).unlink()
    result = dualcal("run", "--resume", tmp_path / "s")
    assert result.exit_code == 0
    assert "no arm is moved" in " ".join(result.stdout.split())
    assert came_to(tmp_path / "s") == came_to(session)
    assert (tmp_path / "s" / "summary.png").exists()


def test_a_result_that_was_estimated_meanwhile_does_not_end_the_run(session, interrupted):
    folder = interrupted(12)
    shutil.copy(session / "result.json", folder)
    shutil.copy(session / "summary.png", folder)
    assert dualcal("run", "--resume", folder).exit_code == 0
    assert steps_of(folder) == steps_of(session)


def test_an_estimate_is_from_all_captures_also_those_of_a_part_that_was_killed(session, tmp_path):
    shutil.copytree(session, tmp_path / "s")
    captures = json.loads((session / "captures.json").read_text())
    captures["captures"] = captures["captures"][:4]
    (tmp_path / "s" / "captures.json").write_text(json.dumps(captures))
    result = dualcal("estimate", tmp_path / "s", "--json")
    assert json.loads(result.stdout) == json.loads((session / "result.json").read_text())


# -- what the operator is told ---------------------------------------------------------------------


def test_a_run_that_fails_names_the_command_that_goes_on(tmp_path, lose_the_link):
    lose_the_link(steps=2)
    result = run(tmp_path / "a session")
    assert f"dualcal run --resume '{tmp_path / 'a session'}'" in result.stderr
    assert f"dualcal estimate '{tmp_path / 'a session'}'" in result.stderr


def test_a_run_that_goes_on_tells_how_much_is_finished(interrupted):
    assert "7 steps are finished" in dualcal("run", "--resume", interrupted(7)).stdout


def test_a_new_file_of_the_log_is_begun_and_the_old_ones_are_left_alone(interrupted):
    folder = interrupted(9)
    old = (folder / "log-0001.mcap").read_bytes()[:-5000]
    (folder / "log-0001.mcap").write_bytes(old)
    assert dualcal("run", "--resume", folder).exit_code == 0
    assert (folder / "log-0001.mcap").read_bytes() == old
    assert dualcal("log", "check", folder / "log-0002.mcap").exit_code == 0
    assert not (folder / "log-0003.mcap").exists()


# -- the cell file ---------------------------------------------------------------------------------


def test_a_cell_file_and_values_that_say_the_same_are_taken(session):
    for arguments in (
        [TINY],
        [TINY, "--seed", 1],
        ["--seed", 1],
        sets("procedure.tolerance_px=0.1"),
        sets("procedure.tolerance_px=0.10"),
        ["--method", "paper"],
    ):
        assert dualcal("run", *arguments, "--resume", session).exit_code == 0, arguments


@pytest.mark.parametrize(
    ("arguments", "lines"),
    [
        (["--seed", 2], ["-  seed: 1  # chosen", "+  seed: 2  # chosen"]),
        ([TINY, *sets("procedure.tolerance_px=0.2")], ["-  tolerance_px: 0.1", "+  tolerance_px: 0.2"]),
        ([*sets("procedure.stand_off=null")], ["+  stand_off:"]),
    ],
)
def test_other_values_are_refused_with_what_differs(interrupted, arguments, lines):
    folder = interrupted(3)
    before = contents(folder)
    result = dualcal("run", *arguments, "--resume", folder)
    assert result.exit_code == 2
    assert all(line in result.stderr for line in lines)
    assert len(result.stderr.splitlines()) < 20
    assert contents(folder) == before


def test_a_session_has_its_meshes_with_it(tmp_path, lose_the_link):
    (tmp_path / "parts").mkdir()
    (tmp_path / "cell.yaml").write_text(TINY.read_text().replace("floor_mm: 0", FIXTURE + "floor_mm: 0"))
    (tmp_path / "parts" / "cube.stl").write_text(CUBE)
    lose_the_link(steps=1)
    assert dualcal("run", tmp_path / "cell.yaml", "--out", tmp_path / "s").exit_code == 1
    given = tmp_path / "cell.yaml"
    (tmp_path / "parts" / "cube.stl").write_text(CUBE.replace("0.05", "0.06"))
    other = dualcal("run", given, "--resume", tmp_path / "s")
    assert other.exit_code == 2
    assert "meshes/" in other.stderr
    (tmp_path / "parts" / "cube.stl").write_text(CUBE)
    lose_the_link(steps=1)
    assert "no answer" in dualcal("run", given, "--resume", tmp_path / "s").stderr
    shutil.rmtree(tmp_path / "parts")
    (tmp_path / "s").rename(tmp_path / "elsewhere")
    lose_the_link(steps=1)
    assert "no answer" in dualcal("run", "--resume", tmp_path / "elsewhere").stderr
    assert steps_of(tmp_path / "elsewhere") == 3


FIXTURE = """fixtures:
  cube:
    in: active_base
    at: {translation_mm: [-800, 0, 500], rotation_vector_deg: [0, 0, 0]}
    mesh: {file: parts/cube.stl, scale: 1}
"""


def _cube(side):
    lines = ["solid cube"]
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij")).reshape(3, -1).T * side
    for a, b, c, d in ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)):
        for triangle in ((a, b, c), (a, c, d)):
            lines += ["facet normal 0 0 0", "outer loop"]
            lines += ["vertex {} {} {}".format(*corners[i]) for i in triangle] + ["endloop", "endfacet"]
    return "\n".join([*lines, "endsolid cube", ""])


CUBE = _cube(0.05)


# -- one at a time ---------------------------------------------------------------------------------


HOLDER = """
import sys
from pathlib import Path
from dualcal_hal.session.lock import SessionLock
with SessionLock(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder():
    """A process that holds a session's lock until it is killed or its input ends."""
    processes = []

    def hold(folder):
        command = [sys.executable, "-c", HOLDER, str(folder)]
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=TINY.parents[1]
        )
        processes.append(process)
        assert process.stdout.readline() == "held\n"
        return process

    yield hold
    for process in processes:
        process.kill()
        process.communicate()


def test_a_session_that_another_process_writes_is_refused_by_that_ones_name(interrupted, holder):
    folder = interrupted(7)
    process = holder(folder)
    before = contents(folder)
    result = dualcal("run", "--resume", folder)
    assert result.exit_code == 2
    assert f"is being written by process {process.pid} of " in result.stderr
    assert contents(folder) == before
    assert dualcal("estimate", folder).exit_code == 2  # too few captures: it asks for no lock
    assert "being written" not in dualcal("estimate", folder).stderr


def test_the_lock_of_a_process_that_is_dead_is_taken_over_and_told_of(interrupted, holder):
    folder = interrupted(14)
    process = holder(folder)
    process.kill()
    process.wait()
    result = dualcal("run", "--resume", folder)
    assert result.exit_code == 0
    assert f"taken over from process {process.pid} of " in " ".join(result.stdout.split())


def test_of_a_lock_that_was_given_back_nothing_is_told(tmp_path):
    for _ in range(2):
        with SessionLock(tmp_path) as lock:
            assert lock.left_by is None
            assert json.loads((tmp_path / LOCK).read_text())["pid"] > 0
    assert (tmp_path / LOCK).exists()


def test_a_run_holds_the_lock_of_its_session_from_the_first_step_on(tmp_path, monkeypatch):
    seen = []

    def opening(self, timeout):
        seen.append(dualcal("run", "--resume", tmp_path / "s"))
        raise LinkLost(self.name, "open", "as if")

    monkeypatch.setattr(SimulatorBackend, "open", opening)
    assert run(tmp_path / "s").exit_code == 1
    (refused,) = seen
    assert refused.exit_code == 2
    assert "is being written by process" in refused.stderr


# -- what cannot be gone on with -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "name a cell file, or with --resume a session"),
        (["--resume", "nowhere"], "nowhere: there is no such session"),
        (["--resume", "."], "no cell.yaml"),
        (["--resume", "file"], "there is no such session"),
        (["--resume", ".", "--dry-run"], "neither --out nor --dry-run"),
        (["--resume", ".", "--out", "other"], "neither --out nor --dry-run"),
    ],
)
def test_what_is_no_session_is_refused_in_words(tmp_path, monkeypatch, arguments, words):
    (tmp_path / "file").write_text("")
    monkeypatch.chdir(tmp_path)
    result = dualcal("run", *arguments)
    assert result.exit_code == 2
    assert words in result.stderr


def in_line(number, change):
    """A journal's lines with one of them changed as JSON."""

    def changed(lines):
        entry = json.loads(lines[number - 1])
        change(entry)
        return [*lines[: number - 1], json.dumps(entry).encode(), *lines[number:]]

    return changed


def plan_of(entry):
    """The first constraint of a journalled plan."""
    return entry["result"]["constraints"][0]


@pytest.mark.parametrize(
    ("damage", "where"),
    [
        (lambda lines: [*lines[:3], b"\x00\xff nonsense", *lines[4:]], "journal.jsonl:4"),
        (lambda lines: [b"{}", *lines[1:]], "journal.jsonl:1"),
        (lambda lines: [*lines, lines[-1]], "is finished already"),
        (in_line(3, lambda entry: entry["result"].pop("view")), "journal.jsonl:3"),
        (in_line(7, lambda entry: entry.update(result={"outcome": 3})), "journal.jsonl:7"),
        (in_line(8, lambda entry: entry.update(arms=[])), "journal.jsonl:8"),
        (in_line(8, lambda entry: entry["arms"]["left"].update(arrival=-1)), "journal.jsonl:8"),
        (
            in_line(8, lambda entry: entry["arms"]["left"].update(target_rad=[0.0])),
            "journal.jsonl:8: 'left' has 6 joints",
        ),
        (in_line(8, lambda entry: entry["arms"]["left"]["target_rad"].__setitem__(0, np.nan)), "journal.jsonl:8"),
        (in_line(8, lambda entry: entry["backends"].update(sim=7)), "journal.jsonl:8: backends.sim"),
        (in_line(8, lambda entry: entry["backends"].update(other={})), "backends.other"),
        (in_line(8, lambda entry: entry["backends"]["sim"].pop("clock_s")), "backends.sim.clock_s"),
        (in_line(8, lambda entry: entry["backends"]["sim"]["arms"].pop("left")), "backends.sim.arms"),
        (in_line(8, lambda entry: entry["backends"]["sim"]["arms"]["left"]["way"].pop()), "backends.sim.arms.left.way"),
        (in_line(8, lambda entry: entry["backends"]["sim"].update(clock_s=-1.0)), "backends.sim.clock_s"),
        (in_line(2, lambda entry: entry["result"]["active_rad"].pop()), "journal.jsonl:2: .* 'left' has 6 joints"),
        (in_line(3, lambda entry: entry["result"]["view"].update(corners_px=[[1.0, 2.0]])), "journal.jsonl:3: .* view"),
        (in_line(6, lambda entry: plan_of(entry).update(active_joints_rad=["x"] * 6)), "journal.jsonl:6: .* finite"),
        (in_line(6, lambda entry: plan_of(entry)["positions"][0].update(passive_joints_rad=[0.0])), "journal.jsonl:6"),
        (in_line(7, lambda entry: entry["result"].update(servo_first=[[0.0, 0.0], [0.0, 0.0]])), "journal.jsonl:7"),
        (
            in_line(7, lambda entry: entry["result"]["capture"]["passive_joints_rad"].pop()),
            "journal.jsonl:7: .* 5 joint",
        ),
        (in_line(7, lambda entry: entry["result"]["capture"].update(id="\ud800")), "journal.jsonl:7: .* surrogate"),
        (
            in_line(8, lambda entry: entry["arms"]["left"].update(target_rad=[10**400] * 6)),
            "journal.jsonl:8: .* digits",
        ),
    ],
)
def test_a_damaged_journal_is_told_by_its_line_and_left_as_it_is(interrupted, damage, where):
    folder = interrupted(7)
    journal = folder / "journal.jsonl"
    journal.write_bytes(b"\n".join(damage(journal.read_bytes().splitlines())) + b"\n")
    before = journal.read_bytes()
    result = dualcal("run", "--resume", folder)
    assert result.exit_code == 2
    assert re.search(where, result.stderr), result.stderr
    assert "Traceback" not in result.stderr
    assert journal.read_bytes() == before


def test_a_folder_that_cannot_be_written_to_is_told(interrupted):
    folder = interrupted(7)
    (folder / LOCK).unlink()
    (folder / LOCK).mkdir()  # root may write to what is read-only
    result = dualcal("run", "--resume", folder)
    assert result.exit_code == 2
    assert "cannot be written" in result.stderr


@pytest.mark.parametrize(
    "full",
    [
        "journal.jsonl",
        "result.json",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("calibration-01-0.png", "captures.json")),
    ],
)
def test_a_run_that_a_full_disk_ends_goes_on_once_there_is_room(session, tmp_path, monkeypatch, full):
    from dualcal_hal.session import files, folder

    def no_room(path):
        raise OSError(28, "No space left on device", str(path))

    write, append = files.write_atomically, Journal.append

    def writing(path, content):
        return no_room(path) if path.name == full else write(path, content)

    def appending(self, key, *rest):
        return no_room(self.path) if full == self.path.name and key.kind == "point" else append(self, key, *rest)

    with monkeypatch.context() as patch:
        for module in (files, folder):
            patch.setattr(module, "write_atomically", writing)
        patch.setattr(Journal, "append", appending)
        ended = run(tmp_path / "s")
    assert ended.exit_code == 1
    assert f"{full}: No space left on device" in ended.stderr
    assert "--resume" in ended.stderr
    assert dualcal("run", "--resume", tmp_path / "s").exit_code == 0
    assert came_to(tmp_path / "s") == came_to(session)
