"""``dualcal enable``, ``disable`` and ``reset``: what no procedure does to an arm, and an operator may."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.console import Console

from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.errors import DualcalError, UsageError
from dualcal_hal.robot import Mode, Robot, RobotState
from tools.cli.answers import yes_or_no
from tools.cli.exits import FAULT
from tools.cli.opening import opened_alone
from tools.cli.terminal import Screen

Command = Literal["enable", "disable", "reset"]

TIMEOUT = 10.0
"""Seconds that an arm may take to do it, and to be read."""

_QUESTIONS: dict[Command, str] = {
    "enable": "Switch on the drives of '{arm}'? Nobody may be within its reach",
    "disable": "Switch off the drives of '{arm}'? What its brakes do not hold may sink",
    "reset": "Acknowledge the faults of '{arm}'? Their cause must be gone",
}


@dataclass(frozen=True)
class OperateOptions:
    """What the command line says."""

    command: Command
    cell: Path
    arm: str
    overrides: tuple[str, ...] = ()
    yes: bool = False


def operate(options: OperateOptions) -> int:
    """Ask, do it, and say how the arm is afterwards; the exit code."""
    console = Screen()
    file = load_cell(options.cell, options.overrides)
    if options.arm not in file.cell.arms:
        raise UsageError(f"there is no arm '{options.arm}'; there are: {', '.join(file.cell.arms)}")
    if not options.yes and not yes_or_no(console, _QUESTIONS[options.command].format(arm=options.arm)):
        raise UsageError("not confirmed; nothing was done")
    with opened_alone(file, options.arm) as backend:
        robot = backend.robot(options.arm)
        _carry_out(options.command, robot)
        state = robot.read(TIMEOUT)
    _say(console, f"{options.arm}: {_in_words(state)}")
    if options.command != "enable":
        return 0 if _is_as_wanted(options.command, state) else FAULT
    return _still_enabled(console, file, options, state)


def _carry_out(command: Command, robot: Robot) -> None:
    match command:
        case "enable":
            robot.enable(TIMEOUT)
        case "disable":
            robot.disable(TIMEOUT)
        case "reset":
            robot.reset_fault(TIMEOUT)


def _is_as_wanted(command: Command, state: RobotState) -> bool:
    if command == "disable":
        return state.mode is not Mode.READY
    return not state.faults and state.mode is not Mode.FAULT


def _still_enabled(console: Console, file: CellFile, options: OperateOptions, state: RobotState) -> int:
    """Drives that this program supervises go off when it ends: looked at, not guessed."""
    if state.mode is not Mode.READY:
        return FAULT
    try:
        with opened_alone(file, options.arm) as backend:
            after = backend.robot(options.arm).read(TIMEOUT)
    except DualcalError as error:
        _say(console, f"whether it stays so after this command is not known: {error}")
        return FAULT
    if after.mode is Mode.READY:
        return 0
    _say(
        console,
        f"{options.arm}: {_in_words(after)}, now that this command has ended: its drives stay on only as long as the "
        f"program that supervises them. Enable them for a run by: dualcal run {options.cell} --enable",
    )
    return FAULT


def _in_words(state: RobotState) -> str:
    faults = f"; faults: {'; '.join(state.faults)}" if state.faults else "; no faults"
    return f"{state.mode}{faults}"


def _say(console: Console, line: str) -> None:
    console.print(line, soft_wrap=True, highlight=False)
