"""A recorded run is played back: the same procedure, the same commands, the same result, and no device."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from backends.replay import ReplayBackend
from backends.replay.comparison import TOLERANCE, difference
from backends.simulator.robot import SimulatedRobot
from dualcal_hal.camera import Frame
from dualcal_hal.cell import Cell
from dualcal_hal.cellfile import load_cell
from dualcal_hal.errors import (
    CellFileError,
    DeviceTimeout,
    FrameMissing,
    LinkLost,
    LogDamaged,
    LogEnded,
    LogMissing,
    MotionFailed,
    NoPlan,
    ReplayMismatch,
)
from dualcal_hal.robot import JointPath, Mode, MotionState, RobotState, StopResult
from dualcal_hal.session.journal import Journal, StepKey
from dualcal_hal.session.log import (
    Call,
    FrameRef,
    LogReader,
    LogWriter,
    MotionEnded,
    Note,
    RecordedError,
    Reply,
    StepBegun,
    StepFinished,
    Worked,
)
from dualcal_hal.session.log.attempts import FinishedAttempts, begun_segments
from dualcal_hal.session.log.check import check_log
from dualcal_hal.session.log.layout import METADATA_NAME, RECORD_TOPICS
from dualcal_hal.session.log.writer import FileWriter
from dualcal_hal.session.result import T_P_A_NAME
from procedures.detection import Detector
from procedures.planning.poses import PosePlanner
from procedures.planning.ways import WayFinder
from tests.cells import PAPER, TINY
from tests.command_line import dualcal

STATE = RobotState((0.1,) * 6, (0.0,) * 6, Mode.READY, (), 2.0, 7)
PATH = JointPath(((0.1,) * 6, (0.2,) * 6), (1.0,) * 6, (2.0,) * 6)
LOOKS, POINT = StepKey("looks", "looks/0", None, "look"), StepKey("calibration", "calibration/00", 1, "point")


@pytest.fixture
def session(recorded, tmp_path):
    """A copy that may be spoilt."""
    return shutil.copytree(recorded, tmp_path / "session")


# -- a whole run ------------------------------------------------------------------------------------


def test_a_replay_comes_to_the_same_result_to_the_last_bit(recorded):
    result = dualcal("replay", recorded)
    assert result.exit_code == 0, result.output
    assert "The result is the same to the last bit." in result.output
    assert "s of recorded time in" in result.output


def test_a_replay_neither_plans_nor_simulates(recorded, monkeypatch):
    def never(*arguments, **options):
        raise AssertionError("the recording has it")

    for kind, method in ((PosePlanner, "plan"), (WayFinder, "find")):
        monkeypatch.setattr(kind, method, never)
    monkeypatch.setattr("procedures.calibrate.find_stand_off", never)
    monkeypatch.setattr("backends.simulator.world.World.__init__", never)
    assert dualcal("replay", recorded).exit_code == 0


def test_images_without_loss_are_looked_at_anew(recorded, monkeypatch):
    """So that a change to the detector shows."""
    detect = Detector.detect

    def shifted(self, image, predicted=None):
        found = detect(self, image, predicted)
        found.corners[:] += 0.01
        return found

    monkeypatch.setattr(Detector, "detect", shifted)
    result = dualcal("replay", recorded)
    assert result.exit_code == 1


def test_of_images_with_loss_the_recorded_detections_are_served(tmp_path, monkeypatch):
    folder = tmp_path / "session"
    assert dualcal("run", TINY, "--out", folder, "--set", "session.frames=jpeg").exit_code == 0
    monkeypatch.setattr(Detector, "detect", None)
    result = dualcal("replay", folder)
    assert result.exit_code == 0, result.output
    assert "to the last bit" in result.output
    assert "recorded detections" in result.output


def test_json_has_what_the_replay_found(recorded):
    document = json.loads(dualcal("replay", recorded, "--json").stdout)
    assert document["identical"] is True
    assert document["differences"] == []
    assert document["recorded_s"] > 10
    assert document["result"]["transforms"] == json.loads((recorded / "result.json").read_text())["transforms"]


def test_what_the_replay_gives_is_kept_where_asked(recorded, tmp_path):
    assert dualcal("replay", recorded, "--out", tmp_path / "again").exit_code == 0
    assert json.loads((tmp_path / "again/result.json").read_text()) == json.loads(
        (recorded / "result.json").read_text()
    )
    assert (tmp_path / "again/images/calibration-00-0.png").exists()


def test_a_cell_file_may_name_a_recording(recorded, tmp_path):
    """Its path is relative to the cell file, and the procedure runs on it unchanged."""
    shutil.copytree(recorded, tmp_path / "old")
    name = (tmp_path / "old" / "cell.yaml").read_text()
    (tmp_path / "cell.yaml").write_text(name)
    run = [f"--set={device}.backend=log" for device in ("robots.left", "robots.right", "camera")]
    run.append("--set=backends.log={type: replay, session: old}")
    result = dualcal("run", tmp_path / "cell.yaml", *run, "--out", tmp_path / "new")
    assert result.exit_code == 0, result.output
    assert json.loads((tmp_path / "new/result.json").read_text()) == json.loads((recorded / "result.json").read_text())
    shutil.rmtree(tmp_path / "old")
    assert "to the last bit" in dualcal("replay", tmp_path / "new").output, "it was recorded in its turn"
    there, here = (joint_states(folder) for folder in (recorded, tmp_path / "new"))
    assert {arm: len(states) for arm, states in here.items()} == {arm: len(states) for arm, states in there.items()}
    assert all(here[arm][-1].positions == states[-1].positions for arm, states in there.items())


def joint_states(folder):
    found = {}
    with LogReader(folder / "log-0001.mcap") as reader:
        for item in reader.items(lambda topic: topic.endswith("/joint_states")):
            found.setdefault(item.arm, []).append(item)
    return found


@pytest.mark.parametrize("size", [0, 8, 300])
def test_an_attempt_that_left_nothing_does_not_matter(session, size):
    """As where the disk was full, or the power went, before anything was on the disk."""
    log = session / "log-0001.mcap"
    (session / "log-0002.mcap").write_bytes(log.read_bytes()[:size])
    (session / "log-0003.mcap").write_bytes(log.read_bytes())
    log.write_bytes(log.read_bytes()[:size])
    result = dualcal("replay", session)
    assert result.exit_code == 0, result.output
    (session / "log-0003.mcap").unlink()
    assert "its log holds nothing" in dualcal("replay", session).output


def test_a_run_that_ended_in_another_way_than_its_replay_is_a_difference(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        lose_the_link(patch, at_move=18)
        assert dualcal("run", TINY, "--out", tmp_path / "session").exit_code == 1

    def confused(self, frame, *arguments, **options):
        raise NoPlan("this version does something else")

    monkeypatch.setattr(Detector, "detect", confused)
    result = dualcal("replay", tmp_path / "session")
    assert result.exit_code == 1
    assert "the recorded run ended so: " in result.output
    assert "the replay so: this version does something else" in result.output


def test_a_run_that_was_cut_off_is_replayed_up_to_there(session):
    """As by a power cut: the log ends in the middle of a step, and the journal before it."""
    whole = (session / "log-0001.mcap").read_bytes()
    (session / "log-0001.mcap").write_bytes(whole[: len(whole) * 6 // 10])
    with LogReader(session / "log-0001.mcap") as reader:
        finished = {item.key for item in reader.items() if isinstance(item, StepFinished)}
    journal = (session / "journal.jsonl").read_bytes().splitlines(keepends=True)
    kept = journal[:1] + [line for line in journal[1:] if StepKey(**json.loads(line)["step"]) in finished]
    assert 2 < len(kept) < len(journal)
    (session / "journal.jsonl").write_bytes(b"".join(kept))
    (session / "result.json").unlink()
    result = dualcal("replay", session)
    assert result.exit_code == 0, result.output
    assert "It ended so: it was cut off" in result.output


def test_a_part_of_a_run_without_a_log_cannot_be_replayed(session):
    """Nor may it seem that the run ended there."""
    with (session / "journal.jsonl").open("r+") as file:
        entry = json.loads(file.readlines()[-1])
        entry["step"]["constraint"] = "verification/99"
        file.write(json.dumps(entry) + "\n")
    result = dualcal("replay", session)
    assert result.exit_code == 1
    assert "it ends before verification/99" in result.output
    assert "--no-log" in result.output


def test_a_played_back_run_is_begun_anew_rather_than_gone_on_with(recorded, tmp_path):
    cell = (recorded / "cell.yaml").read_text().replace("{type: simulator}", "{type: replay, session: old}")
    (tmp_path / "cell.yaml").write_text(cell)
    shutil.copytree(recorded, tmp_path / "old")
    new = tmp_path / "new"
    assert dualcal("run", tmp_path / "cell.yaml", "--out", new).exit_code == 0
    journal = (new / "journal.jsonl").read_bytes().splitlines(keepends=True)
    (new / "result.json").unlink()
    for steps, exit_code in ((1, 2), (0, 0)):
        (new / "journal.jsonl").write_bytes(b"".join(journal[: 1 + steps]))
        result = dualcal("run", "--resume", new)
        assert result.exit_code == exit_code, result.output
        assert ("run it anew from its beginning" in result.output) == (steps > 0)


def test_a_run_that_failed_is_replayed_up_to_its_failure(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        moves = lose_the_link(patch, at_move=18)
        assert dualcal("run", TINY, "--out", tmp_path / "session").exit_code == 1
    result = dualcal("replay", tmp_path / "session")
    assert result.exit_code == 0, result.output
    said = f"The recorded run has no result. It ended so: {moves[17]}: move: no answer; check the cable"
    assert said in result.output.splitlines()
    assert "Its captures are the same to the last bit." in result.output


def lose_the_link(monkeypatch, at_move):
    """The motion of that number is answered by the device with an error; gives the arms that are moved, in order."""
    start, moves = SimulatedRobot.start, []

    def lossy(self, path):
        moves.append(self.name)
        if len(moves) == at_move:
            raise LinkLost(self.name, "move", "no answer", "check the cable")
        return start(self, path)

    monkeypatch.setattr(SimulatedRobot, "start", lossy)
    return moves


def test_a_run_without_a_plan_fails_alike(tmp_path, monkeypatch):
    def none(*arguments, **options):
        raise NoPlan("nothing will do")

    with monkeypatch.context() as patch:
        patch.setattr(PosePlanner, "plan", none)
        assert dualcal("run", TINY, "--out", tmp_path / "session").exit_code == 2
    result = dualcal("replay", tmp_path / "session")
    assert "It ended so: nothing will do" in result.output


def of_another_backend(session, entry):
    """As if it had been recorded on devices of which this program knows nothing."""
    text = (session / "cell.yaml").read_text()
    assert "{type: simulator}" in text
    (session / "cell.yaml").write_text(text.replace("{type: simulator}", entry))


@pytest.mark.parametrize("entry", ["{type: kuka, host: 10.0.0.1}", "{type: simulator, of_a_later_version: 3}"])
def test_a_session_is_replayed_where_its_backend_is_not_known(session, entry):
    of_another_backend(session, entry)
    result = dualcal("replay", session)
    assert result.exit_code == 0, result.output
    assert "The result is the same to the last bit." in result.output
    assert dualcal("run", session / "cell.yaml").exit_code == 2, "to run there is another matter"


@pytest.mark.parametrize("redetect", [[], ["--redetect"]])
def test_a_session_is_estimated_from_where_its_backend_is_not_known(session, redetect):
    before = dualcal("estimate", session, "--json", *redetect)
    of_another_backend(session, "{type: kuka, host: 10.0.0.1}")
    result = dualcal("estimate", session, "--json", *redetect)
    assert result.exit_code == 0, result.output
    there, here = (json.loads(each.stdout)["transforms"] for each in (before, result))
    assert here == there


def test_a_cell_file_that_is_wrong_elsewhere_is_told_by_a_replay_with_its_line(session):
    of_another_backend(session, "{type: kuka}")
    text = (session / "cell.yaml").read_text()
    (session / "cell.yaml").write_text(text.replace("tilt_max_deg: ", "tilt_max_deg: -"))
    line = 1 + text[: text.index("tilt_max_deg: ")].count("\n")
    result = dualcal("replay", session)
    assert result.exit_code == 2
    assert f"cell.yaml:{line}:" in result.output
    assert "kuka" not in result.output


# -- what is not the same ---------------------------------------------------------------------------


def test_another_result_is_told_in_words(session):
    document = json.loads((session / "result.json").read_text())
    document["transforms"][T_P_A_NAME]["matrix"][0][3] += 1e-6
    document["verdict"] = "fail"
    (session / "result.json").write_text(json.dumps(document))
    result = dualcal("replay", session)
    assert result.exit_code == 1
    assert f"{T_P_A_NAME} differs by 0.001 mm" in result.output
    assert "verdict: recorded fail, now ok" in result.output


def test_a_result_within_the_tolerance_is_the_same(session):
    document = json.loads((session / "result.json").read_text())
    document["transforms"][T_P_A_NAME]["matrix"][0][3] += 5e-10
    (session / "result.json").write_text(json.dumps(document))
    result = dualcal("replay", session)
    assert result.exit_code == 0
    assert "within 1e-6 mm and 1e-9 rad" in result.output


def test_a_changed_procedure_is_a_mismatch(recorded, monkeypatch):
    monkeypatch.setattr("procedures.alignment.LONGEST_STEP", 1e-4)
    result = dualcal("replay", recorded)
    assert result.exit_code == 1
    assert "replay: " in result.output
    assert "recorded: " in result.output


def test_a_cut_log_and_a_damaged_one_are_told(session):
    log = session / "log-0001.mcap"
    whole = log.read_bytes()
    log.write_bytes(whole[: len(whole) // 2])
    result = dualcal("replay", session)
    assert result.exit_code == 1
    assert "it was cut off" in result.output
    spoilt = bytearray(whole)
    spoilt[len(whole) // 2] ^= 0xFF
    log.write_bytes(spoilt)
    result = dualcal("replay", session)
    assert result.exit_code == 1
    assert "log-0001.mcap" in result.output


def steps_in(session):
    """The steps that the journal has, and those that the log has, finished."""
    with LogReader(session / "log-0001.mcap") as reader:
        logged = [item.key for item in reader.items() if isinstance(item, StepFinished)]
    return [key for key, _ in Journal(session / "journal.jsonl").results()], logged


@pytest.mark.slow
def test_wherever_a_log_is_cut_the_replay_says_what_is_missing(session):
    log = session / "log-0001.mcap"
    whole = log.read_bytes()
    told = Counter()
    for part in range(50):
        log.write_bytes(whole[: len(whole) * part // 50])
        result = dualcal("replay", session)
        try:
            begun_segments(session)
        except LogMissing:
            expected, code = f"{session}: its log holds nothing (log-0001.mcap)", 2
        else:
            journalled, logged = steps_in(session)
            missing = [key for key in journalled if key not in logged]
            place = missing and (missing[0].constraint or missing[0].kind)
            expected = f"it ends before {place}" if missing else "left: read: the recording ends here"
            code = 1
        assert (result.exit_code, expected in result.output) == (code, True), (part, expected, result.output)
        told[expected.split(" ")[1]] += 1
    assert len(told) >= 2


def cut_in_motion(session, number):
    """Leave of the log what came before the end of the motion of that number, as where the power went then."""
    log = session / "log-0001.mcap"
    with LogReader(log) as reader:
        layout, about, messages = reader.layout(), dict(reader.about()), list(reader.messages())
    ends = 0
    with log.open("wb") as file:
        writer = FileWriter(file, layout)
        writer.write_metadata(METADATA_NAME, about)
        for topic, message in messages:
            ends += topic == RECORD_TOPICS[MotionEnded]
            if ends == number:
                break
            writer.write(topic, message.publish_time, message.data, message.sequence)
        writer.sync()
    assert any(f"motion {index} has no end" in f.what for f in check_log(log).findings for index in range(1000))


@pytest.mark.parametrize("number", [1, 9, 17])
def test_a_log_that_is_cut_in_a_motion_lacks_the_step_that_it_was_in(session, number):
    cut_in_motion(session, number)
    journalled, logged = steps_in(session)
    missing = next(key for key in journalled if key not in logged)
    result = dualcal("replay", session)
    assert result.exit_code == 1
    assert f"it ends before {missing.constraint or missing.kind}" in result.output


@pytest.mark.parametrize("number", [1, 9, 17])
def test_a_run_that_was_cut_off_in_a_motion_is_replayed_up_to_there(session, number):
    cut_in_motion(session, number)
    _, logged = steps_in(session)
    lines = (session / "journal.jsonl").read_bytes().splitlines(keepends=True)
    (session / "journal.jsonl").write_bytes(b"".join(lines[: 1 + len(logged)]))
    (session / "result.json").unlink()
    result = dualcal("replay", session)
    assert result.exit_code == 0, result.output
    assert "The recorded run has no result. It ended so: it was cut off" in result.output
    assert "Its captures are the same to the last bit." in result.output


@pytest.mark.parametrize(
    ("content", "code", "said"),
    [(b"", 2, "its log holds nothing"), (b"no log at all, but some text", 1, "is no log")],
)
def test_a_file_that_is_no_log_is_told(session, content, code, said):
    (session / "log-0001.mcap").write_bytes(content)
    result = dualcal("replay", session)
    assert result.exit_code == code
    assert said in result.output


def test_a_log_of_a_later_version_is_refused(session, monkeypatch):
    monkeypatch.setattr("dualcal_hal.session.log.reader.FORMAT_VERSION", 0)
    result = dualcal("replay", session)
    assert result.exit_code == 2
    assert "update it" in result.output


def test_recorded_work_that_is_not_what_it_should_be_is_damage(recorded, monkeypatch):
    monkeypatch.setattr("backends.replay.backend._result", lambda work: {"odd": 1})
    result = dualcal("replay", recorded)
    assert result.exit_code == 1
    assert "what was worked out as stand-off cannot be read" in result.output


@pytest.mark.parametrize("lacking", ["log-0001.mcap", "cell.yaml"])
def test_a_session_that_cannot_be_replayed_is_refused(session, lacking):
    (session / lacking).unlink()
    result = dualcal("replay", session)
    assert result.exit_code == 2
    assert str(session) in result.output


def test_a_recording_is_not_mixed_with_other_backends(recorded):
    with pytest.raises(CellFileError, match="makes its own time"):
        Cell(load_cell(TINY, [f"backends.log={{type: replay, session: {recorded}}}", "robots.left.backend=log"]))


# -- single calls -----------------------------------------------------------------------------------


@pytest.fixture
def play(tmp_path):
    """Opens the replay of these records."""
    opened = []

    def write_and_open(*records, frames=()):
        with LogWriter(tmp_path / "log-0001.mcap", datetime(2026, 5, 4, tzinfo=UTC), arms=("left", "right")) as log:
            for record in records:
                match record:
                    case Frame():
                        log.frame(record)
                    case (arm, state):
                        log.joint_states(arm, state)
                    case _:
                        log.record(record)
        devices = [f"{device}.backend=log" for device in ("robots.left", "robots.right", "camera")]
        cell = load_cell(PAPER, [f"backends.log={{type: replay, session: {tmp_path}}}", *devices])
        backend = ReplayBackend("log", cell)
        backend.open(1.0)
        opened.append(backend)
        return backend

    yield write_and_open
    for backend in opened:
        backend.close()


def moved(waypoint, place):
    joints = list(PATH.waypoints[place])
    joints[3] += waypoint
    waypoints = list(PATH.waypoints)
    waypoints[place] = tuple(joints)
    return JointPath(tuple(waypoints), PATH.speed, PATH.acceleration)


def test_a_command_within_the_tolerance_is_the_recorded_one(play):
    end = MotionEnded("left", 0, MotionState.SETTLED, STATE, 2.0)
    backend = play(Call("left", 0, "start", {"path": PATH}, 1.0), Reply("left", 0, None, 1.0), end)
    motion = backend.robot("left").start(moved(TOLERANCE / 2, 1))
    assert motion.state is MotionState.RUNNING
    assert motion.wait(10.0).positions == STATE.positions


@pytest.mark.parametrize("place", [0, 1])
def test_the_first_other_command_is_a_mismatch_with_all_that_differs(play, place):
    backend = play(
        Call("left", 0, "read", {}, 0.5),
        Reply("left", 0, STATE, 0.5),
        Call("left", 1, "start", {"path": PATH}, 1.0),
        Reply("left", 1, None, 1.0),
    )
    robot = backend.robot("left")
    robot.read(1.0)
    with pytest.raises(ReplayMismatch, match=f"left: replay: .* 2. call: start: waypoint {place + 1} 4") as caught:
        robot.start(moved(3 * TOLERANCE, place))
    assert (caught.value.device, caught.value.index) == ("left", 1)
    assert caught.value.expected == PATH
    assert caught.value.got == moved(3 * TOLERANCE, place)


def test_another_kind_of_command_is_a_mismatch(play):
    backend = play(Call("left", 0, "read", {}, 0.5), Reply("left", 0, STATE, 0.5))
    with pytest.raises(ReplayMismatch, match="recorded: read; now: start"):
        backend.robot("left").start(PATH)


def test_devices_are_compared_each_for_itself(play):
    backend = play(
        Call("left", 0, "read", {}, 0.5),
        Reply("left", 0, STATE, 0.5),
        Call("right", 0, "read", {}, 0.6),
        Reply("right", 0, STATE, 0.6),
    )
    assert backend.robot("right").read(1.0) == backend.robot("left").read(1.0)


def test_after_its_end_a_recording_answers_nothing(play):
    with pytest.raises(LogEnded, match="left"):
        play().robot("left").read(1.0)


def test_a_call_without_a_reply_is_the_end(play):
    with pytest.raises(LogEnded, match="left"):
        play(Call("left", 0, "read", {}, 0.5)).robot("left").read(1.0)


def test_a_recording_that_ends_within_a_motion_says_so(play):
    """And not that the arm is late."""
    motion = play(Call("left", 0, "start", {"path": PATH}, 1.0), Reply("left", 0, None, 1.0)).robot("left").start(PATH)
    with pytest.raises(LogEnded, match="left: move: the recording ends here"):
        motion.wait(10.0)


def test_a_motion_whose_end_is_recorded_ends_so_though_nothing_follows(play):
    end = MotionEnded("left", 0, MotionState.SETTLED, STATE, 2.0)
    backend = play(Call("left", 0, "start", {"path": PATH}, 1.0), Reply("left", 0, None, 1.0), end)
    assert backend.robot("left").start(PATH).wait(10.0).sequence == STATE.sequence


@pytest.mark.parametrize(
    ("rest", "told"),
    [
        (Call("left", 4, "start", {"path": PATH}, 3.0), "left: replay: .* 5. call: it is not asked; recorded: start"),
        (Worked(6, "plan", None, [], 3.0), "procedure: replay: .* 7. work: it is not worked out; recorded: plan"),
    ],
)
def test_what_the_recorded_run_went_on_with_is_missed(play, rest, told):
    backend = play(Call("left", 3, "read", {}, 0.5), Reply("left", 3, STATE, 0.5), rest)
    backend.robot("left").read(1.0)
    with pytest.raises(ReplayMismatch, match=told):
        backend.procedure_ended()


def test_readings_and_stops_are_not_missed(play):
    backend = play(
        Call("left", 0, "read", {}, 0.5),
        Reply("left", 0, STATE, 0.5),
        Call("left", 1, "stop", {"reason": "the run has ended"}, 0.6),
        Reply("left", 1, StopResult(True), 0.6),
    )
    backend.procedure_ended()


def test_who_watches_an_arm_gets_the_states_kept_for_viewers(play):
    """At their times, which begin with the recording's first, in the order in which they came."""
    later = replace(STATE, time=5.0, sequence=8)
    backend = play(("left", STATE), ("left", later), Call("left", 0, "read", {}, 6.0), Reply("left", 0, STATE, 6.0))
    seen = []
    backend.robot("left").subscribe(lambda state: seen.append((state, backend.clock.now())))
    backend.robot("left").read(1.0)
    assert [(s.positions, s.sequence, s.time, now) for s, now in seen] == [
        (STATE.positions, 7, pytest.approx(0.0, abs=1e-6), pytest.approx(0.0, abs=1e-6)),
        (STATE.positions, 8, pytest.approx(3.0, abs=1e-6), pytest.approx(3.0, abs=1e-6)),
    ]


def test_recorded_errors_are_raised_again(play):
    error = DeviceTimeout("left", "read", "no answer", "check the cable")
    backend = play(
        Call("left", 0, "read", {}, 0.5),
        Reply("left", 0, None, 0.5, RecordedError.of(error)),
        Call("left", 1, "start", {"path": PATH}, 1.0),
        Reply("left", 1, None, 1.0),
        MotionEnded(
            "left", 1, MotionState.FAILED, None, 2.0, RecordedError.of(MotionFailed("left", "move", "E7", "look"))
        ),
    )
    with pytest.raises(DeviceTimeout, match="no answer; check the cable"):
        backend.robot("left").read(1.0)
    with pytest.raises(MotionFailed, match="E7; look"):
        backend.robot("left").start(PATH).wait(10.0)


def test_a_frame_whose_image_is_missing_is_told(play):
    image = np.zeros((8, 8), np.uint8)
    backend = play(
        Call("camera", 0, "grab", {}, 0.5),
        Frame(image, 0.5, 1),
        Reply("camera", 0, FrameRef("camera", 1, 0.5), 0.6),
        Call("camera", 1, "grab", {}, 0.7),
        Reply("camera", 1, FrameRef("camera", 2, 0.7), 0.8),
    )
    assert backend.camera("camera").grab(0.0, 1.0).sequence == 1
    with pytest.raises(FrameMissing, match=r"camera: .* no image 2"):
        backend.camera("camera").grab(0.0, 1.0)


def test_a_stop_that_was_not_recorded_ends_what_moves(play):
    backend = play(
        Call("left", 0, "start", {"path": PATH}, 1.0),
        Reply("left", 0, None, 1.0),
        MotionEnded("left", 0, MotionState.SETTLED, STATE, 2.0),
    )
    motion = backend.robot("left").start(PATH)
    assert backend.robot("left").stop("enough").confirmed
    assert motion.state is MotionState.STOPPED


def test_a_recorded_stop_has_the_recorded_answer(play):
    backend = play(
        Call("left", 0, "stop", {"reason": "x"}, 1.0), Reply("left", 0, StopResult(False, "no word of it"), 1.0)
    )
    assert backend.robot("left").stop("y") == StopResult(False, "no word of it")


def test_work_is_answered_if_the_same_is_asked(play):
    works = [
        Worked(0, "way", {"to": [0.1]}, [1], 0.1),
        Worked(1, "way", {"to": [0.2]}, [2], 0.2),
        Worked(2, "plan", None, None, 0.3, RecordedError.of(NoPlan("none will do"))),
    ]
    backend = play(*works)
    answer = backend.answer("way", {"to": [0.1 + TOLERANCE / 2]})
    assert (answer.result(), answer.images_are_exact) == ([1], True)
    with pytest.raises(ReplayMismatch, match=r"procedure: .* 2. work: way: to 1 differs by 0.1"):
        backend.answer("way", {"to": [0.3]})
    with pytest.raises(ReplayMismatch, match="recorded: way; now: plan"):
        backend.answer("plan", None)
    backend.answer("way", {"to": [0.2]})
    with pytest.raises(NoPlan, match="none will do"):
        backend.answer("plan", None).result()
    with pytest.raises(LogEnded):
        backend.answer("plan", None)


def test_a_reply_of_another_kind_is_damage(play):
    backend = play(Call("left", 0, "read", {}, 0.5), Reply("left", 0, "text", 0.5))
    with pytest.raises(LogDamaged):
        backend.robot("left").read(1.0)


def test_opening_again_plays_from_the_beginning_in_time_that_goes_on(play):
    backend = play(Call("left", 0, "read", {}, 0.5), Reply("left", 0, STATE, 2.5))
    first = backend.robot("left").read(1.0)
    backend.close()
    backend.open(1.0)
    again = backend.robot("left").read(1.0)
    assert again.positions == first.positions
    assert again.time > first.time


def test_a_session_without_a_log_is_refused_before_anything_is_opened(tmp_path):
    devices = [f"{device}.backend=log" for device in ("robots.left", "robots.right", "camera")]
    with pytest.raises(LogMissing, match="has no log"):
        ReplayBackend("log", load_cell(PAPER, [f"backends.log={{type: replay, session: {tmp_path}}}", *devices]))


def test_a_run_on_a_recording_that_is_not_there_leaves_no_session(recorded, tmp_path):
    cell = (recorded / "cell.yaml").read_text().replace("{type: simulator}", "{type: replay, session: old}")
    (tmp_path / "cell.yaml").write_text(cell)
    result = dualcal("run", tmp_path / "cell.yaml", "--out", tmp_path / "new")
    assert result.exit_code == 2
    assert f"{tmp_path / 'old'}: does not exist" in result.output
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("expected", "got", "where"),
    [
        ([1.0, [2.0]], [1.0, [2.5]], "2 1 differs by 0.5"),
        ({"a": 1}, {"b": 1}, "has other entries"),
        ([1], [1, 2], "has 2 entries instead of 1"),
        ("a", "b", "differs"),
        (None, 0.0, "differs"),
        (float("nan"), 0.0, "differs by nan"),
    ],
)
def test_differences_say_where(expected, got, where):
    assert difference(expected, got) == where


@pytest.mark.parametrize("same", [float("nan"), float("inf"), (1.0, [2, "x", None]), {"a": [0.1]}])
def test_what_is_the_same_has_no_difference(same):
    assert difference(json.loads(json.dumps(same)), same) is None


# -- several attempts -------------------------------------------------------------------------------


def segments(folder, *files):
    paths = []
    for number, records in enumerate(files, start=1):
        paths.append(folder / f"log-{number:04d}.mcap")
        with LogWriter(paths[-1], datetime(2026, 5, 4, tzinfo=UTC), arms=("left",)) as log:
            for record in records:
                log.record(record)
    return paths


def note(text):
    return Note("info", text, 1.0)


def told(paths):
    return [item.text for _, item in FinishedAttempts(paths).items() if isinstance(item, Note)]


def test_of_a_step_begun_twice_the_finished_attempt_counts(tmp_path):
    paths = segments(
        tmp_path,
        [StepBegun(LOOKS, 0), note("look"), StepFinished(LOOKS, 1), StepBegun(POINT, 2), note("interrupted")],
        [StepBegun(POINT, 0), note("point"), StepFinished(POINT, 1), note("home")],
    )
    assert told(paths) == ["look", "point", "home"]


def test_of_a_step_finished_twice_the_last_attempt_counts(tmp_path):
    """Its first result was lost between the log and the journal."""
    paths = segments(
        tmp_path,
        [StepBegun(POINT, 0), note("first"), StepFinished(POINT, 1)],
        [StepBegun(POINT, 0), note("second"), StepFinished(POINT, 1)],
    )
    assert told(paths) == ["second"]


def test_where_the_run_ended_all_counts(tmp_path):
    paths = segments(
        tmp_path,
        [note("before"), StepBegun(LOOKS, 0), note("look"), StepFinished(LOOKS, 1), note("between")],
        [note("again"), StepBegun(POINT, 0), note("fault")],
    )
    assert told(paths) == ["look", "again", "fault"]


def test_a_finished_step_within_an_unfinished_one_counts(tmp_path):
    paths = segments(
        tmp_path,
        [StepBegun(LOOKS, 0), note("outer"), StepBegun(POINT, 0), note("inner"), StepFinished(POINT, 1)],
        [StepBegun(LOOKS, 0), note("outer again"), StepFinished(LOOKS, 1)],
    )
    assert told(paths) == ["inner", "outer again"]


def test_time_goes_on_over_files(tmp_path):
    reads = [Call("left", 0, "read", {}, 5.0), Reply("left", 0, STATE, 6.0)]
    later = [Call("left", 0, "read", {}, 1.0), Reply("left", 0, STATE, 2.0)]
    finished = [StepBegun(LOOKS, 5.0), *reads, StepFinished(LOOKS, 6.0)]
    segments(tmp_path, finished, [StepBegun(POINT, 1.0), *later, StepFinished(POINT, 2.0)])
    devices = [f"{device}.backend=log" for device in ("robots.left", "robots.right", "camera")]
    backend = ReplayBackend("log", load_cell(PAPER, [f"backends.log={{type: replay, session: {tmp_path}}}", *devices]))
    backend.open(1.0)
    robot = backend.robot("left")
    assert robot.read(1.0).time < robot.read(1.0).time <= backend.clock.now()
    backend.close()


# -- what a run records -----------------------------------------------------------------------------


def test_a_run_records_all_that_a_replay_and_a_viewer_need(recorded):
    with LogReader(recorded / "log-0001.mcap") as log:
        topics = {topic for topic, _ in log.messages()}
        attached = {each.name: each.data for each in log.attachments()}
        versions = log.metadata()["versions"]
    assert {"/camera/image", "/camera/annotations", "/camera/calibration", "/tf", "/log"} <= topics
    assert {"/left/joint_states", "/right/joint_states", "/dualcal/calls", "/dualcal/steps/finished"} <= topics
    assert attached["cell.yaml"] == (recorded / "cell.yaml").read_bytes()
    assert attached["result.json"] == (recorded / "result.json").read_bytes()
    assert json.loads(attached["plan.json"]) == json.loads((recorded / "plan.json").read_text())
    assert versions["numpy"] == np.__version__
    result = dualcal("log", "check", recorded)
    assert result.exit_code == 0
    assert "note" not in result.output


def test_every_journalled_step_is_in_the_log(recorded):
    with LogReader(recorded / "log-0001.mcap") as log:
        finished = [item.key for item in log.items() if isinstance(item, StepFinished)]
    lines = [json.loads(line) for line in (recorded / "journal.jsonl").read_text().splitlines()[1:]]
    assert finished == [StepKey(**line["step"]) for line in lines]


def test_without_a_log_there_is_none(tmp_path):
    result = dualcal("run", TINY, "--no-log", "--out", tmp_path / "session")
    assert result.exit_code == 0
    assert not list((tmp_path / "session").glob("*.mcap"))


def test_a_log_that_cannot_be_written_stops_the_arms(tmp_path, monkeypatch):
    """The disk fills up in the middle of a run: clear words, the arms stopped, what was captured is kept."""
    write, written = LogWriter.frame, []

    def full(self, frame):
        written.append(frame)
        if len(written) == 8:
            self._writer.write = no_space
        write(self, frame)

    def no_space(*arguments):
        raise OSError(28, "No space left on device")

    stopped = []
    stop = SimulatedRobot.stop
    monkeypatch.setattr(SimulatedRobot, "stop", lambda self, why: (stopped.append(self.name), stop(self, why))[1])
    monkeypatch.setattr(LogWriter, "frame", full)
    result = dualcal("run", TINY, "--out", tmp_path / "session")
    assert result.exit_code == 1
    assert "log-0001.mcap: the log cannot be written: No space left on device" in result.output
    assert "stopped: left, right" in result.output
    assert set(stopped) == {"left", "right"}
    assert (tmp_path / "session" / "captures.json").exists()
