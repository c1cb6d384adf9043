"""``dualcal doctor --flange``: what the pendant shows of the flange, against the joints that are read."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from dualcal_hal.cellfile import CellFile
from dualcal_hal.commissioning import Commissioning
from dualcal_hal.errors import UsageError
from dualcal_hal.guard import STANDSTILL
from dualcal_hal.kinematics import Chain
from dualcal_hal.robot import Robot
from dualcal_hal.transforms import Array
from procedures.commissioning.causes import Cause
from procedures.commissioning.flange import LEAST_POSES, FlangeCheck, Tolerance, check_flange
from procedures.commissioning.poses_file import Posed, read_poses
from procedures.commissioning.readout import FORMS, numbers_of, pose_of
from tools.cli.answers import answer
from tools.cli.opening import opened_alone

READ_TIMEOUT = 2.0

_SAME_PLACE = float(np.deg2rad(0.2))
"""rad by which the joints may differ between a file and the arm that stands at its last pose."""


_APART = float(np.deg2rad(1.0))
"""rad by which joints are apart where none can be taken for another, or for itself the other way."""


@dataclass(frozen=True)
class FlangeOptions:
    """arm: None for both; rotation: the form in which orientations are typed; poses: a file in place of typing."""

    arm: str | None
    rotation: str | None
    poses: Path | None
    within: Tolerance


def check_flanges(
    console: Console, file: CellFile, commissioning: Commissioning | None, options: FlangeOptions
) -> tuple[bool, dict[str, Any]]:
    """Whether all arms that are asked for were found good, and the document; what was found is recorded."""
    given: list[Posed] | None = None
    arms = [options.arm] if options.arm is not None else list(file.cell.arms)
    if options.poses is not None:
        arm, given = _of_file(options.poses, options.arm, file)
        arms = [arm]
    elif options.rotation is None:
        raise UsageError(f"say with --rotation what the pendant shows of an orientation: {', '.join(FORMS)}")
    checks = {}
    for arm in arms:
        config = file.cell.robots[arm]
        with opened_alone(file, arm) as backend:
            robot = backend.robot(arm)
            if given is None:
                check = _asked(console, robot, config.chain, options)
            else:
                joints, flange = _given(console, robot, given)
                check = check_flange(config.chain, joints, flange, options.within)
        _show(console, arm, check, options.within)
        _record(console, commissioning, arm, check)
        checks[arm] = check
    return all(check.good for check in checks.values()), {"flange": {arm: _document(c) for arm, c in checks.items()}}


# Poses from a file


def _of_file(path: Path, arm: str | None, file: CellFile) -> tuple[str, list[Posed]]:
    named, poses = read_poses(path)
    if named is not None and arm not in (None, named):
        raise UsageError(f"{path}: has poses of '{named}', not of '{arm}'")
    arm = arm or named
    if arm is None or arm not in file.cell.arms:
        raise UsageError(f"{path}: say with --arm whose poses these are: {', '.join(file.cell.arms)}")
    joints = file.cell.robots[arm].chain.joints
    for number, pose in enumerate(poses, start=1):
        if pose.joints is not None and len(pose.joints) != joints:
            raise UsageError(f"{path}: pose {number} has {len(pose.joints)} joints; '{arm}' has {joints}")
    if len(poses) < LEAST_POSES:
        raise UsageError(f"{path}: {len(poses)} poses; at least {LEAST_POSES} are needed")
    return arm, poses


def _given(console: Console, robot: Robot, poses: list[Posed]) -> tuple[Array, Array]:
    """Joints (k, n) and flanges (k, 4, 4); joints that the file does not have are read, with the arm jogged there."""
    joints = []
    for number, pose in enumerate(poses, start=1):
        if pose.joints is None:
            joints.append(_read_at(console, robot, f"Jog '{robot.name}' to pose {number} of the file; then Enter:"))
        else:
            joints.append(pose.joints)
    if poses[-1].joints is not None:
        _require_standing_there(robot, poses[-1].joints)
    return np.stack(joints), np.stack([pose.flange for pose in poses])


def _read_at(console: Console, robot: Robot, question: str) -> Array:
    if answer(console, question) is None:
        raise UsageError("the input ended before all poses were taken; nothing is recorded")
    while (joints := _standing(robot)) is None:
        if answer(console, "It moves. Let it stand; then Enter:") is None:
            raise UsageError("the input ended before all poses were taken; nothing is recorded")
    return joints


def _require_standing_there(robot: Robot, joints: Array) -> None:
    """A file's joints are believed if the arm is seen at its last pose: they may be of other joints than we read."""
    apart = [abs(a - b) for a, b in combinations((0.0, *joints), 2)]
    if min(apart) < _APART:
        raise UsageError(
            f"the file's last pose does not tell joints from each other: put one last in which each joint is "
            f"{math.degrees(_APART):g} deg or more away from zero and from all others, and have the arm stand there"
        )
    away = np.abs(np.array(robot.read(READ_TIMEOUT).positions) - joints)
    if np.max(away) > _SAME_PLACE:
        joint = int(np.argmax(away))
        raise UsageError(
            f"'{robot.name}' does not stand at the file's last pose: joint {joint + 1} is read "
            f"{math.degrees(away[joint]):.2f} deg away. joints_deg are what this program reads (dualcal doctor shows "
            "them), not what the pendant shows; with the arm at the last pose this is seen to be so"
        )


def _standing(robot: Robot) -> Array | None:
    """Joint angles (n,) in rad, None while it moves."""
    state = robot.read(READ_TIMEOUT)
    return None if max(map(abs, state.velocities)) > STANDSTILL else np.array(state.positions)


# Poses that are typed


def _asked(console: Console, robot: Robot, chain: Chain, options: FlangeOptions) -> FlangeCheck:
    """Pose after pose, until what they tell is proven or something is found wrong."""
    form = options.rotation or ""
    names = " ".join(numbers_of(form))
    _say(
        console,
        f"Flange check of '{robot.name}'. Have its pendant show the pose of the flange in the arm's base: no tool, no "
        f"work object or user frame. Jog it to {LEAST_POSES} postures in which every joint stands differently, by 20 "
        f"deg or more, and type at each: {names} (mm, {'quaternion' if form == 'abb' else 'deg'}).",
    )
    joints: list[Array] = []
    flanges: list[Array] = []
    while True:
        flange = _typed(console, form, f"pose {len(flanges) + 1}, {names}:")
        read = None if flange is None else _standing(robot)
        if flange is None:
            raise UsageError(f"the input ended after {len(flanges)} poses, before all was proven; nothing is recorded")
        if read is None:
            _say(console, "It moves: let it stand, and type the pose again.")
            continue
        joints.append(read)
        flanges.append(flange)
        _say(console, f"joints as read: {' '.join(f'{angle:z.2f}' for angle in np.degrees(read))} deg")
        if len(flanges) < LEAST_POSES:
            continue
        check = check_flange(chain, np.stack(joints), np.stack(flanges), options.within)
        if check.good or not check.agrees:
            return check
        _say(console, f"So far all agrees within {check.deviation}. Not proven yet:")
        for what in check.unproven:
            _say(console, f"  {what}")


def _typed(console: Console, form: str, question: str) -> Array | None:
    """A pose (4, 4), asked for until it is one; None at the end of the input."""
    while (line := answer(console, question)) is not None:
        try:
            return pose_of(form, [float(part) for part in re.split(r"[\s;,]+", line) if part])
        except ValueError as error:
            _say(console, f"{error}; decimals with a point, blanks between the numbers")
    return None


# What comes of it


def _show(console: Console, arm: str, check: FlangeCheck, within: Tolerance) -> None:
    table = Table(title=Text(f"Flange of '{arm}'", "bold"), title_justify="left", box=None, pad_edge=False)
    for name in ("pose", "away, mm", "turned, deg"):
        table.add_column(name, justify="right")
    pairs = zip(check.deviation.translation, check.deviation.rotation, strict=True)
    for number, (distance, angle) in enumerate(pairs, start=1):
        table.add_row(str(number), f"{1e3 * distance:.2f}", f"{math.degrees(angle):.3f}")
    console.print(table)
    usual = f"{1e3 * within.translation:g} mm and {math.degrees(within.rotation):g} deg"
    if check.usual:
        _say(console, f"Good: the pendant and our kinematics agree within {usual}.")
    elif check.agrees:
        _say(console, f"Good, but more than {usual} away: the controller's model of the arm differs from ours.")
    else:
        _say(console, f"Not good: they agree only within {check.deviation}.")
    if check.cause is not None:
        _say_cause(console, "Likely cause" if not check.agrees else "It would be less if", check.cause)
        for other in check.others:
            _say_cause(console, "These poses do not tell it from", other)
    elif not check.agrees:
        _say(console, "No single cause explains it: not a sign, zero, coupling, order, tool, work object or length.")
        _say(console, "-> check what was typed, and that these are this arm's kinematics; take more poses")
    for what in check.unproven:
        _say(console, f"Not proven: {what}")


def _say_cause(console: Console, head: str, cause: Cause) -> None:
    _say(console, f"{head}: {cause.what} (leaves {cause.deviation})")
    _say(console, f"-> {cause.advice}")


def _record(console: Console, commissioning: Commissioning | None, arm: str, check: FlangeCheck) -> None:
    if commissioning is None:
        _say(console, "This cell is simulated: nothing is recorded.")
        return
    commissioning.record_flange(arm, check.good, in_words(check))
    _say(console, f"Recorded in {commissioning.path}.")


def in_words(check: FlangeCheck) -> str:
    """The result in one line."""
    if check.good:
        return f"{len(check.deviation.translation)} poses within {check.deviation}"
    if check.agrees:
        return f"not proven: {'; '.join(check.unproven)}"
    return "no single cause explains the deviations" if check.cause is None else check.cause.what


def _document(check: FlangeCheck) -> dict[str, Any]:
    return {
        "good": check.good,
        "said": in_words(check),
        "deviation_mm": (1e3 * check.deviation.translation).tolist(),
        "deviation_deg": np.degrees(check.deviation.rotation).tolist(),
        "cause": None if check.cause is None else _cause_document(check.cause),
        "others": [_cause_document(other) for other in check.others],
        "unproven": list(check.unproven),
    }


def _cause_document(cause: Cause) -> dict[str, Any]:
    return {"kind": cause.kind, "what": cause.what, "advice": cause.advice, "joints": list(cause.joints)}


def _say(console: Console, line: str) -> None:
    console.print(line, soft_wrap=True, highlight=False)
