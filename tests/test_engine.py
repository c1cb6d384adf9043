"""The engine: it alone touches devices, and whatever happens the arms it moved are stopped."""

from __future__ import annotations

import re
import threading
from dataclasses import dataclass

import numpy as np
import pytest

from dualcal_hal.cell import Cell
from dualcal_hal.errors import ArmMoved, CommandRefused, Interrupted, LinkLost, MotionStopped, StopFailed
from dualcal_hal.robot import StopResult
from dualcal_hal.session.folder import Session
from dualcal_hal.session.journal import StepKey
from procedures.engine import Engine
from procedures.observers import Observers
from procedures.steps import look, move, read, task, tell
from tests.cells import small_cell


@dataclass(frozen=True)
class Note:
    """A result to journal."""

    number: float

    def to_record(self):
        return {"number": self.number}

    @classmethod
    def from_record(cls, record):
        return cls(record["number"])


@pytest.fixture
def cell():
    with Cell(small_cell()) as opened:
        yield opened


@pytest.fixture
def stops(cell, monkeypatch):
    """Which arms were told to stop, and why."""
    told = []
    for arm in (cell.active, cell.passive):
        original = arm.robot.stop

        def recording(reason, name=arm.robot.name, original=original):
            told.append((name, reason))
            return original(reason)

        monkeypatch.setattr(arm.robot, "stop", recording)
    return told


@pytest.fixture
def events():
    return []


@pytest.fixture
def engine(cell, tmp_path, events):
    file = small_cell()
    session = Session.create(tmp_path / "session", file.text)
    with Observers(events.append) as observers:
        yield Engine(cell, session, observers)


def nearby(cell, step=0.05):
    return tuple(q + step for q in cell.active.home)


def test_a_move_ends_settled_at_its_goal(engine, cell):
    def procedure():
        return (yield from move("left", nearby(cell)))

    state = engine.run(procedure())
    np.testing.assert_allclose(state.positions, nearby(cell), atol=1e-4)


def test_readings_tell_what_the_arm_was_sent_to_in_this_run(engine, cell):
    def procedure():
        before = yield from read()
        yield from move("left", nearby(cell))
        return before, (yield from read())

    before, after = engine.run(procedure())
    assert before.active.commanded is None
    assert after.active.commanded == nearby(cell)
    assert after.passive.commanded is None


def test_a_sighting_has_the_mean_of_the_readings_around_the_exposure(engine, cell):
    def procedure():
        return (yield from look())

    sighting = engine.run(procedure())
    assert sighting.frame.image.shape == (768, 1024)
    np.testing.assert_allclose(sighting.active, cell.active.home, atol=1e-4)


def test_a_good_end_stops_only_the_arms_that_moved(engine, cell, stops):
    def procedure():
        yield from move("left", nearby(cell))

    engine.run(procedure())
    assert {name for name, _ in stops} == {"left"}


def test_a_failing_procedure_stops_the_arms_with_the_cause(engine, cell, stops):
    def procedure():
        yield from move("left", nearby(cell))
        yield from move("right", nearby(cell))
        raise RuntimeError("the procedure is wrong")

    with pytest.raises(RuntimeError, match="the procedure is wrong"):
        engine.run(procedure())
    assert sorted(stops) == [("left", "the procedure is wrong"), ("right", "the procedure is wrong")]


def test_an_arm_that_cannot_be_stopped_does_not_keep_the_other_from_it(engine, cell, stops, monkeypatch):
    def no_answer(reason):
        raise OSError("cable cut")

    monkeypatch.setattr(cell.active.robot, "stop", no_answer)

    def procedure():
        yield from move("left", nearby(cell))
        yield from move("right", nearby(cell))

    with pytest.raises(StopFailed, match=r"left: stop: left: OSError: cable cut; it may still move"):
        engine.run(procedure())
    assert [name for name, _ in stops] == ["right"]


def test_the_arm_that_moves_is_stopped_first(engine, cell, stops):
    def procedure():
        yield from move("left", nearby(cell))
        cell.clock.call_at(cell.clock.now() + 0.05, lambda: engine.abort("enough"))
        yield from move("right", tuple(q + 0.5 for q in cell.passive.home))

    with pytest.raises(Interrupted):
        engine.run(procedure())
    assert [name for name, _ in stops] == ["right", "left"]


def test_a_stop_that_is_not_confirmed_is_no_good_end(engine, cell, monkeypatch):
    monkeypatch.setattr(cell.active.robot, "stop", lambda reason: StopResult(False, "no newer state"))

    def procedure():
        yield from move("left", nearby(cell))

    with pytest.raises(StopFailed, match=r"not confirmed: no newer state.*emergency stop"):
        engine.run(procedure())


@pytest.mark.parametrize(
    ("moved", "confirmed", "note"),
    [((), True, "no arm was moved"), (("left",), True, "stopped: left"), (("left",), False, "left: stop: .*emergency")],
)
def test_an_error_says_what_became_of_the_arms(engine, cell, monkeypatch, moved, confirmed, note):
    monkeypatch.setattr(cell.active.robot, "stop", lambda reason: StopResult(confirmed, "as told"))

    def procedure():
        for arm in moved:
            yield from move(arm, nearby(cell))
        raise LinkLost("right", "read", "no answer")

    with pytest.raises(LinkLost) as failure:
        engine.run(procedure())
    assert re.match(note, failure.value.__notes__[0])


def test_a_device_that_raises_stop_iteration_does_not_end_the_procedure_as_if_it_were_done(engine, cell, monkeypatch):
    def exhausted(not_before, timeout):
        raise StopIteration

    monkeypatch.setattr(cell.camera, "grab", exhausted)

    def procedure():
        yield from look()

    with pytest.raises(StopIteration):
        engine.run(procedure())


def test_a_sightings_joints_are_the_mean_of_both_readings(engine, cell, monkeypatch):
    states = []
    read_robot = cell.active.robot.read

    def recording(timeout):
        states.append(read_robot(timeout))
        return states[-1]

    monkeypatch.setattr(cell.active.robot, "read", recording)

    def procedure():
        return (yield from look())

    sighting = engine.run(procedure())
    assert states[0].positions != states[1].positions
    assert sighting.active == tuple(np.mean([states[0].positions, states[1].positions], axis=0))


def test_an_abort_before_a_step_ends_the_run_and_touches_nothing(engine, stops):
    engine.abort("the operator asked")

    def procedure():
        yield from move("left", (0.0,) * 6)

    with pytest.raises(Interrupted, match="the operator asked"):
        engine.run(procedure())
    assert stops == []


def test_an_abort_within_a_move_ends_it_on_the_way(engine, cell, stops):
    far = tuple(q + 0.5 for q in cell.active.home)
    cell.clock.call_at(cell.clock.now() + 0.1, lambda: engine.abort("interrupted by SIGINT"))

    def procedure():
        yield from move("left", far)

    with pytest.raises(Interrupted, match="SIGINT"):
        engine.run(procedure())
    assert stops == [("left", "interrupted by SIGINT")]
    standing = cell.active.robot.read(1.0)
    assert max(abs(v) for v in standing.velocities) == 0.0
    assert 0.0 < standing.positions[0] - cell.active.home[0] < 0.45


def test_a_procedures_cleanup_runs_on_an_abort(engine, cell):
    cleaned = []

    def procedure():
        try:
            yield from move("left", nearby(cell))
            yield from move("left", tuple(cell.active.home))
        finally:
            cleaned.append("done")

    cell.clock.call_at(cell.clock.now() + 0.01, lambda: engine.abort("enough"))
    with pytest.raises(Interrupted):
        engine.run(procedure())
    assert cleaned == ["done"]


def test_a_motion_stopped_by_somebody_else_is_no_success(engine, cell):
    far = tuple(q + 0.5 for q in cell.active.home)
    cell.clock.call_at(cell.clock.now() + 0.1, lambda: cell.active.robot.stop("somebody else"))

    def procedure():
        yield from move("left", far)

    with pytest.raises(MotionStopped, match="somebody else"):
        engine.run(procedure())


def test_errors_of_devices_are_thrown_into_the_procedure(engine, cell):
    def procedure():
        try:
            yield from move("left", (99.0,) * 6)
        except CommandRefused as refusal:
            return str(refusal)

    assert "beyond its limit" in engine.run(procedure())


def test_a_picture_with_a_moving_arm_is_refused(engine, cell, monkeypatch):
    grab = cell.camera.grab

    def shaken(not_before, timeout):
        from dualcal_hal.robot import JointPath

        frame = grab(not_before, timeout)
        limits = cell.passive.limits
        path = JointPath((nearby(cell, 0.01),), tuple(limits.speed), tuple(limits.acceleration))
        cell.passive.robot.start(path).wait(5.0)
        return frame

    monkeypatch.setattr(cell.camera, "grab", shaken)

    def procedure():
        yield from look()

    with pytest.raises(ArmMoved, match=r"right.*during the exposure"):
        engine.run(procedure())


def test_a_finished_task_is_answered_from_the_journal_and_not_done_again(engine):
    key, runs = StepKey("looks", "looks/0", None, "look"), []

    def body():
        runs.append(1)
        yield from tell("working")
        return Note(1 / 3)

    def procedure():
        first = yield from task(key, body, Note.from_record)
        again = yield from task(key, body, Note.from_record)
        return first, again

    assert engine.run(procedure()) == (Note(1 / 3), Note(1 / 3))
    assert len(runs) == 1


def test_a_task_that_fails_is_not_finished(engine):
    key = StepKey("looks", "looks/0", None, "look")

    def body():
        yield from move("left", (99.0,) * 6)

    def procedure():
        try:
            yield from task(key, body, Note.from_record)
        except CommandRefused:
            return "failed"

    assert engine.run(procedure()) == "failed"
    assert engine._session.journal.result(key) is None


def test_an_abort_stops_an_arm_whose_controller_is_still_taking_its_motion(engine, cell, monkeypatch):
    stopped, asked = threading.Event(), threading.Event()

    def start(path):
        asked.set()
        assert stopped.wait(20)
        raise MotionStopped("left", "move", "stopped: enough")

    def stop(reason):
        stopped.set()
        return StopResult(True)

    monkeypatch.setattr(Cell, "time", "real")
    monkeypatch.setattr(cell.active.robot, "start", start)
    monkeypatch.setattr(cell.active.robot, "stop", stop)

    def abort():
        assert asked.wait(20)
        engine.abort("enough")

    operator = threading.Thread(target=abort)
    operator.start()
    with pytest.raises(MotionStopped, match="enough"):
        engine.run(move(cell.active.robot.name, (0.1, 0.0, 1.0, 0.0, 0.5, 0.0)))
    operator.join()
