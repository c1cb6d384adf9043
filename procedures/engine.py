"""The engine: the only code that touches devices, waits, records and reports."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar

import numpy as np

from dualcal_hal.backend import Answer
from dualcal_hal.cell import Arm, Cell
from dualcal_hal.errors import (
    ArmMoved,
    DeviceError,
    DualcalError,
    FormatError,
    Interrupted,
    LogDamaged,
    NotConfirmed,
    Problem,
    StopFailed,
)
from dualcal_hal.guard import READ_TIMEOUT
from dualcal_hal.robot import JointPath, Joints, Motion, RobotState
from dualcal_hal.session.folder import Session
from dualcal_hal.session.journal import Left, Standing
from procedures.observers import Observers
from procedures.steps import (
    ArmReading,
    Believe,
    Confirm,
    KeepDocument,
    KeepImage,
    Look,
    Mark,
    Move,
    Procedure,
    Read,
    Readings,
    Sighting,
    Task,
    Tell,
    Work,
)

T = TypeVar("T")

GRAB_TIMEOUT = 2.0
LATE_FACTOR, LATE_MARGIN = 2.0, 5.0
"""A motion is late after this factor of the time it needs at its speed, and this many seconds more."""

_ARRIVAL_SIGMAS = 8


Confirmation = Callable[[Callable[[], object], Callable[[], bool]], bool]
"""Whether the operator agrees to what is shown; looks now and then whether the run was aborted."""


class Engine:
    """Runs a procedure's steps on an open cell, and stops every arm it has moved on any exit."""

    def __init__(
        self, cell: Cell, session: Session, observers: Observers, confirm: Confirmation = lambda shown, aborted: True
    ) -> None:
        """``confirm`` asks the operator; it gets what is to be shown, and what says whether the run was aborted."""
        self._confirm = confirm
        self._cell = cell
        self._recording = cell.recording
        self._session = session
        self._observers = observers
        self._wake = threading.Event()
        self._abort_reason: str | None = None
        self._arms = {arm.robot.name: arm for arm in (cell.active, cell.passive)}
        self._beginning: Arm | None = None
        """The arm that is being told to move."""
        self._moved: set[str] = set()
        """Arms that this engine has moved: they are to be stopped."""
        self._commanded: dict[str, Joints] = {}
        """Where the run, of which this may be a later part, sent the arms last."""
        self._to_confirm: set[str] = set()
        """Arms of which it has to be seen yet whether they still stand there."""
        self._arrivals = dict.fromkeys(self._arms, 0)
        self._go_on()

    def run(self, procedure: Procedure[T]) -> T:
        """The procedure's return value; Interrupted after :meth:`abort`; device errors as they are."""
        try:
            result = self._drive(procedure)
        except BaseException as error:
            self._stop_after(error)
            raise
        self._stop_all("the run has ended")
        self._cell.procedure_ended()
        return result

    def _go_on(self) -> None:
        """Begin where the journal ends."""
        for name, arm in self._arms.items():
            left = self._session.journal.left.arms.get(name)
            if left is None:
                # Journals of old do not say; arrivals were counted by constraints then, each with a step of its own.
                self._arrivals[name] = len(self._session.journal.results())
                continue
            # An arm that may have been moved meanwhile, by whomever, counts as arrived anew.
            self._arrivals[name] = left.arrival + (0 if arm.repeats_targets else 1)
            if left.target is not None:
                if len(left.target) != arm.robot.joints:
                    where, what = self._session.journal.newest_line, f"'{name}' has {arm.robot.joints} joints"
                    raise FormatError([Problem(where, f"{what}, and was left with {len(left.target)}")])
                self._commanded[name] = left.target
                self._to_confirm.add(name)

    def abort(self, reason: str) -> None:
        """End the run at once: from any thread, any number of times; not from a signal's handler."""
        self._abort_reason = reason
        self._wake.set()
        beginning = self._beginning
        if beginning is not None:
            # A controller may take seconds to take a motion, and the run waits for that.
            with suppress(DeviceError):  # the run stops it once more, and tells
                beginning.robot.stop(reason)

    @property
    def aborted(self) -> bool:
        """Whether :meth:`abort` was called."""
        return self._abort_reason is not None

    def _drive(self, procedure: Procedure[T]) -> T:
        reply: Any = None
        error: DualcalError | None = None
        try:
            while True:
                try:
                    step = procedure.send(reply) if error is None else procedure.throw(error)
                except StopIteration as end:
                    result: T = end.value
                    return result
                reply, error = None, None
                try:
                    self._raise_if_aborted()
                    reply = self._execute(step)
                except DualcalError as caught:
                    error = caught
        finally:
            procedure.close()

    def _execute(self, step: object) -> Any:
        match step:
            case Read():
                return Readings(self._reading(self._cell.active), self._reading(self._cell.passive))
            case Move(arm, waypoints):
                return self._move(self._cell.arm(arm), waypoints)
            case Look():
                return self._look()
            case Task():
                return self._task(step)
            case Work():
                return self._work(step)
        return self._keep(step)

    def _keep(self, step: object) -> None:
        """Steps that ask nothing of the devices and have no reply."""
        match step:
            case Tell(event):
                self._recording.note(str(event))
                self._observers.tell(event)
            case Mark(time, feature):
                self._recording.mark(time, feature)
            case KeepImage(name, image):
                self._session.write_image(name, image)
            case KeepDocument(file_name, document):
                self._session.write_document(file_name, document)
                self._recording.document(file_name, document)
            case Confirm(body):
                self._ask(lambda: self._drive(body()))
            case Believe(placement, geometry, T_H_E):
                self._recording.belief(placement.T_P_A, T_H_E)
                self._cell.guard.place(placement, geometry)
            case _:
                raise TypeError(f"{step!r} is no step")

    def _ask(self, shown: Callable[[], object]) -> None:
        agreed = self._confirm(shown, lambda: self.aborted)
        self._raise_if_aborted()
        if not agreed:
            raise NotConfirmed("not confirmed by the operator: no arm is moved any further")

    def _task(self, task: Task) -> Any:
        finished = self._session.journal.result(task.key)
        if finished is not None:
            return self._session.journal.read(task.key, task.read)
        self._recording.step_begun(task.key)
        result = self._drive(task.body())
        self._recording.step_finished(task.key)
        self._session.journal.append(task.key, result.to_record(), self._left())
        return result

    def _left(self) -> Left:
        arms = {name: Standing(self._commanded.get(name), self._arrivals[name]) for name in self._arms}
        return Left(arms, self._cell.left())

    def _work(self, work: Work) -> Any:
        try:
            answer = self._cell.answer(work.what, work.asked)
            if answer is None or (work.of_image and answer.images_are_exact):
                result = work.body()
            else:
                result = _read_recorded(work, answer)
        except DualcalError as error:
            self._recording.worked(work.what, work.asked, None, error)
            raise
        self._recording.worked(work.what, work.asked, work.write(result))
        return result

    def _reading(self, arm: Arm) -> ArmReading:
        state = self._read(arm)
        return ArmReading(state, self._commanded.get(arm.robot.name))

    def _read(self, arm: Arm) -> RobotState:
        """The arm's state; where the run left it is believed only if it is seen there."""
        state, name = arm.robot.read(READ_TIMEOUT), arm.robot.name
        if name in self._to_confirm:
            self._to_confirm.remove(name)
            away = float(np.max(np.abs(np.subtract(state.positions, self._commanded[name]))))
            if away > _reading_noise(arm.encoder_sigma) + _ARRIVAL_SIGMAS * arm.joint_sigma:
                del self._commanded[name]
        return state

    def _move(self, arm: Arm, waypoints: tuple[Joints, ...]) -> RobotState:
        limits = arm.limits
        start = self._read(arm)
        path = self._cell.guard.path(arm.robot.name, start.positions, waypoints)
        ways = np.abs(np.diff([start.positions, *waypoints], axis=0))
        speed = np.array(path.speed)
        needed = np.max(ways / speed + speed / limits.acceleration, axis=1).sum()
        # Known as moved before the command leaves: a failure from here on finds the arm among those to stop.
        self._moved.add(arm.robot.name)
        self._commanded[arm.robot.name] = waypoints[-1]
        self._arrivals[arm.robot.name] += 1
        return self._wait(self._begin(arm, path), LATE_FACTOR * float(needed) + LATE_MARGIN)

    def _begin(self, arm: Arm, path: JointPath) -> Motion:
        # In made time nothing is waited for here, and a stop would make some.
        self._beginning = arm if self._cell.time == "real" else None
        try:
            self._raise_if_aborted()
            return arm.robot.start(path)
        finally:
            self._beginning = None

    def _wait(self, motion: Motion, timeout: float) -> RobotState:
        """The one place where the engine waits; wakes at once when the motion ends or the run is aborted."""
        self._wake.clear()
        motion.on_end(self._wake.set)
        self._raise_if_aborted()
        self._cell.clock.wait(self._wake, self._cell.clock.now() + timeout)
        self._raise_if_aborted()
        return motion.result(timeout)

    def _look(self) -> Sighting:
        arms = (self._cell.active, self._cell.passive)
        before = [self._read(arm) for arm in arms]
        frame = self._cell.camera.grab(self._cell.clock.now(), GRAB_TIMEOUT)
        after = [arm.robot.read(READ_TIMEOUT) for arm in arms]
        joints = []
        for arm, first, last in zip(arms, before, after, strict=True):
            moved = float(np.max(np.abs(np.subtract(last.positions, first.positions)), initial=0.0))
            if moved > _reading_noise(arm.encoder_sigma):
                raise ArmMoved(
                    arm.robot.name,
                    "take a picture",
                    f"a joint moved by {np.rad2deg(moved):.4f} deg during the exposure, more than the "
                    f"{np.rad2deg(_reading_noise(arm.encoder_sigma)):.4f} deg that encoder_sigma_mrad explains",
                    "check what moves or shakes the arm, or what its encoders scatter by",
                )
            joints.append(tuple(map(float, np.mean([first.positions, last.positions], axis=0))))
        self._recording.stands(frame.time, {arm.robot.name: q for arm, q in zip(arms, joints, strict=True)})
        active, passive = joints
        return Sighting(frame, active, passive, self._arrivals[self._cell.active.robot.name])

    def _raise_if_aborted(self) -> None:
        if self._abort_reason is not None:
            raise Interrupted(self._abort_reason)

    def _stop_after(self, error: BaseException) -> None:
        """Stop the arms because of an error, and let the error say what became of it."""
        try:
            self._stop_all(str(error) or type(error).__name__)
        except StopFailed as failure:
            error.add_note(str(failure))
            return
        if self._moved:
            error.add_note(f"stopped: {', '.join(sorted(self._moved))}")
        else:
            error.add_note("no arm was moved")

    def _stop_all(self, cause: str) -> None:
        """Stop every arm that was moved, each whatever the others' stops do; StopFailed names those that may move."""
        failures: dict[str, str] = {}
        # One that moves does not wait until another has confirmed that it stands.
        for name in sorted(self._moved, key=lambda name: (not self._cell.arm(name).robot.moving, name)):
            try:
                result = self._cell.arm(name).robot.stop(cause)
            except Exception as error:  # noqa: BLE001 - the other arm must still be stopped; told by StopFailed
                failures[name] = f"{type(error).__name__}: {error}"
                continue
            if not result.confirmed:
                failures[name] = f"not confirmed: {result.detail}"
        if failures:
            arms, reasons = ", ".join(failures), "; ".join(f"{name}: {why}" for name, why in failures.items())
            raise StopFailed(arms, "stop", reasons, "it may still move: use the emergency stop")


def _read_recorded(work: Work, answer: Answer) -> Any:
    recorded = answer.result()
    try:
        return work.read(recorded)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        what = f"what was worked out as {work.what} cannot be read ({type(error).__name__}: {error})"
        raise LogDamaged(answer.place, None, what) from error


def _reading_noise(encoder_sigma: float) -> float:
    """How far (rad) two readings of an arm that stands may differ: eight sigma of a difference, at least 0.1 mrad."""
    return max(1e-4, 8 * math.sqrt(2) * encoder_sigma)
