"""``dualcal doctor --wiggle``: one joint after the other turned by a degree and back, and what was seen of it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from dualcal_hal.cell import Arm, Cell
from dualcal_hal.cellfile import CellFile
from dualcal_hal.commissioning import Commissioning
from dualcal_hal.errors import CommandRefused, DeviceError, Interrupted, UsageError
from dualcal_hal.guard import READ_TIMEOUT
from dualcal_hal.robot import JointPath
from dualcal_hal.transforms import Array
from procedures.commissioning.wiggle import (
    ACCELERATION,
    SPEED,
    Outcome,
    Seen,
    expected_motions,
    judge,
    turned,
    words,
)
from procedures.detection import Detection, Detector, Missed, board_poses
from procedures.engine import GRAB_TIMEOUT
from procedures.planning.model import CellModel
from tools.cli.answers import yes_or_no
from tools.cli.exits import signals_deferred

MOVE_TIMEOUT = 10.0
"""Seconds that a degree may take at most, of the one or so that it needs."""


@dataclass(frozen=True)
class WiggleOptions:
    """arm: None for both; enable: switch the drives on before; yes: do not ask before the first motion."""

    arm: str | None
    enable: bool
    yes: bool


@dataclass(frozen=True)
class Joint:
    """One joint's turn: what was expected, whether that was seen, and what was."""

    number: int
    expected: str
    good: bool
    said: str


def wiggle_arms(
    console: Console, file: CellFile, commissioning: Commissioning | None, options: WiggleOptions
) -> tuple[bool, dict[str, Any]]:
    """Whether every joint was seen to turn as it should, and the document; what was found is recorded."""
    arms = [options.arm] if options.arm is not None else list(file.cell.arms)
    cell, model = Cell(file), CellModel(file.cell)
    joints: dict[str, list[Joint]] = {}
    with cell:
        _confirm(console, cell, model, arms, options)
        if options.enable:
            for name in cell.enable_arms():
                _say(console, f"{name}: its drives were switched on")
        for name in arms:
            joints[name] = list(_Wiggle(console, cell, model, name).joints())
            _conclude(console, commissioning, name, joints[name])
    document = {name: [vars(joint) for joint in found] for name, found in joints.items()}
    return all(joint.good for found in joints.values() for joint in found), {"wiggle": document}


def _confirm(console: Console, cell: Cell, model: CellModel, arms: list[str], options: WiggleOptions) -> None:
    for name in arms:
        table = Table(title=Text(f"What '{name}' will do", "bold"), title_justify="left", box=None, pad_edge=False)
        table.add_column("joint", justify="right")
        table.add_column("from, deg", justify="right")
        table.add_column("to, deg", justify="right")
        table.add_column("what should be seen", overflow="fold")
        arm = cell.arm(name)
        q = np.array(arm.robot.read(READ_TIMEOUT).positions)
        for joint in range(len(q)):
            goal = turned(q, joint, arm.limits.lower, arm.limits.upper)
            told = words(arm.chain, q, goal, *_carried(model, name))
            table.add_row(str(joint + 1), f"{np.degrees(q[joint]):z.2f}", f"{np.degrees(goal[joint]):z.2f}", told)
        console.print(table)
    _say(
        console,
        "One joint at a time turns there and back, at 2 deg/s. Up is along the z of the arm's base; outward, left and "
        "right are as seen from behind its base. Stay out of reach, with a hand at the emergency stop.",
    )
    if not (cell.simulated or options.yes) and not yes_or_no(console, "Begin?"):
        raise UsageError("not confirmed; nothing was moved")


def _carried(model: CellModel, arm: str) -> tuple[Array, str]:
    """Where on its flange an arm carries what."""
    return (model.nominal.T_H_E, "its camera") if arm == model.active.name else (model.T_F_T, "its target")


def _conclude(console: Console, commissioning: Commissioning | None, arm: str, joints: list[Joint]) -> None:
    wrong = [joint for joint in joints if not joint.good]
    said = "; ".join(f"joint {joint.number}: {joint.said}" for joint in wrong) or "each joint turns as it should"
    _say(console, f"'{arm}': {said}.")
    if wrong:
        _say(console, "-> see sign and order in its joint_map (on CAN: sign of the drives and their order)")
    if commissioning is None:
        _say(console, "This cell is simulated: nothing is recorded.")
        return
    commissioning.record_wiggle(arm, not wrong, said)
    _say(console, f"Recorded in {commissioning.path}.")


class _Wiggle:
    """The joints of one arm."""

    def __init__(self, console: Console, cell: Cell, model: CellModel, name: str) -> None:
        self._console, self._cell, self._model = console, cell, model
        self._arm: Arm = cell.arm(name)
        self._name = name
        self._detector = Detector(model.board, model.intrinsics.size)

    def joints(self) -> Iterator[Joint]:
        """One after the other, each back before the next."""
        for joint in range(self._arm.robot.joints):
            yield self._turn(joint)

    def _turn(self, joint: int) -> Joint:
        start = self._read()
        goal = turned(start, joint, self._arm.limits.lower, self._arm.limits.upper)
        before = self._look()
        goal = self._go_either_way(start, goal, joint)
        expected = words(self._arm.chain, start, goal, *_carried(self._model, self._name))
        _say(
            self._console,
            f"'{self._name}', joint {joint + 1} by {np.degrees(goal - start)[joint]:+.1f} deg: {expected}",
        )
        seen = self._seen(before, start, joint, float(goal[joint] - start[joint]))
        good, said = self._decided(seen)
        _go(self._cell, self._arm, start)
        if good is None:
            raise UsageError(f"joint {joint + 1} of '{self._name}' is back, and nobody said what was seen of it")
        return Joint(joint + 1, expected, good, said)

    def _go_either_way(self, start: Array, goal: Array, joint: int) -> Array:
        """Where one way is not clear the other one tells as much."""
        try:
            _go(self._cell, self._arm, goal)
        except CommandRefused:
            other = 2 * start - goal
            limits = self._arm.limits
            if not limits.lower[joint] <= other[joint] <= limits.upper[joint]:
                raise
            _go(self._cell, self._arm, other)
            return other
        return goal

    def _decided(self, seen: Seen) -> tuple[bool | None, str]:
        """By the camera where it tells, else by the operator."""
        _say(self._console, f"  {seen.said}")
        if seen.outcome is not Outcome.OPEN:
            return seen.outcome is Outcome.PROVEN, seen.said
        good = yes_or_no(self._console, "  Did this joint alone turn, and the arm move so?")
        said = "the operator saw it" if good else "did not turn so: its sign or the order of the joints is wrong"
        return good, said

    def _read(self) -> Array:
        return np.array(self._arm.robot.read(READ_TIMEOUT).positions)

    def _look(self, near: Array | None = None) -> Detection | str:
        """The target's corners, or why they do not help."""
        try:
            frame = self._cell.camera.grab(self._cell.clock.now(), GRAB_TIMEOUT)
        except DeviceError as error:
            return error.why
        if near is None:
            q_a, q_p = (self._cell.arm(side.name).robot.read(READ_TIMEOUT).positions for side in self._sides())
            expected = self._model.predict_corners(q_a, q_p, self._model.nominal)
            near = expected if np.all(np.isfinite(expected)) else None
        found = self._detector.detect(frame.image, near)
        if isinstance(found, Missed):
            return found.reason
        return found if found.order_known else "the pattern looks alike from two sides"

    def _sides(self) -> tuple[Any, Any]:
        return self._model.active, self._model.passive

    def _seen(self, before: Detection | str, start: Array, joint: int, step: float) -> Seen:
        if isinstance(before, str):
            return Seen(Outcome.OPEN, f"the camera is of no help: {before}")
        near = before.corners if np.all(before.seen) else None
        after = self._look(near)
        if isinstance(after, str):
            return Seen(Outcome.OPEN, f"the camera is of no help: {after}")
        T_E_T, _ = board_poses(before.corners, self._model.board, self._model.intrinsics)[0]
        expected = expected_motions(self._model, self._name, start, T_E_T, step)
        return judge(after.corners - before.corners, expected, joint)


def _go(cell: Cell, arm: Arm, goal: Array) -> None:
    """Turn to joint angles (n,) in rad, slowly; whatever comes between, the arm is stopped before this ends."""
    speed, acceleration = np.minimum(arm.limits.speed, SPEED), np.minimum(arm.limits.acceleration, ACCELERATION)
    path = JointPath((tuple(goal.tolist()),), tuple(speed.tolist()), tuple(acceleration.tolist()))
    wake, reasons = threading.Event(), []

    def abort(reason: str) -> None:
        reasons.append(reason)
        wake.set()

    with signals_deferred() as signals:
        signals.pass_on_to(abort)
        motion = arm.robot.start(path)
        try:
            motion.on_end(wake.set)
            cell.clock.wait(wake, cell.clock.now() + MOVE_TIMEOUT)
            if reasons:
                raise Interrupted(reasons[0])
            motion.result(MOVE_TIMEOUT)
        except BaseException as error:
            _stop(arm, error)
            raise


def _stop(arm: Arm, error: BaseException) -> None:
    try:
        result = arm.robot.stop(str(error))
        detail = None if result.confirmed else result.detail
    except DeviceError as second:
        detail = str(second)
    if detail is not None:
        error.add_note(f"{arm.robot.name}: its stop is not confirmed ({detail}): use the emergency stop")


def _say(console: Console, line: str) -> None:
    console.print(line, soft_wrap=True, highlight=False)
