"""``dualcal doctor``: each device looked at in turn; and the checks that come before the first motion."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from dualcal_hal.cell import CAMERA_NAME
from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.commissioning import Commissioning
from dualcal_hal.errors import DeviceError, DualcalError, UsageError
from dualcal_hal.findings import Finding
from procedures.commissioning.examination import examine_camera, examine_robot
from procedures.commissioning.flange import Tolerance
from procedures.commissioning.readout import FORMS
from tools.cli.exits import FAULT
from tools.cli.flange import FlangeOptions, check_flanges
from tools.cli.opening import backend_of, is_simulated, opened_alone
from tools.cli.terminal import Screen
from tools.cli.wiggle import WiggleOptions, wiggle_arms

FORMAT = "dualcal.doctor/1"

_MARKS = {"good": Text("ok", "green"), "note": Text("note", "yellow"), "problem": Text("PROBLEM", "bold red")}


@dataclass(frozen=True)
class DoctorOptions:
    """What the command line says."""

    cell: Path
    overrides: tuple[str, ...] = ()
    flange: bool = False
    wiggle: bool = False
    arm: str | None = None
    rotation: str | None = None
    poses: Path | None = None
    within: tuple[float, float] = (3.0, 0.5)
    """mm and deg that are usual between the flange and our kinematics."""
    enable: bool = False
    yes: bool = False
    json: bool = False


@dataclass(frozen=True)
class Examined:
    """One device, what it is reached through, and what was found."""

    device: str
    reached: str
    findings: tuple[Finding, ...]

    @property
    def problems(self) -> int:
        return sum(finding.verdict == "problem" for finding in self.findings)


def diagnose(options: DoctorOptions) -> int:
    """Look, or do the check that is asked for; the exit code."""
    _require_sense(options)
    file = load_cell(options.cell, options.overrides)
    if options.arm is not None and options.arm not in file.cell.arms:
        raise UsageError(f"there is no arm '{options.arm}'; there are: {', '.join(file.cell.arms)}")
    # With --json standard output is for the document alone.
    console = Screen(stderr=options.json)
    commissioning = None if is_simulated(file.cell) else Commissioning.of(options.cell, file)
    if options.flange:
        millimetres, degrees = options.within
        within = Tolerance(millimetres / 1000, math.radians(degrees))
        asked = FlangeOptions(options.arm, options.rotation, options.poses, within)
        good, document = check_flanges(console, file, commissioning, asked)
    elif options.wiggle:
        wanted = WiggleOptions(options.arm, options.enable, options.yes)
        good, document = wiggle_arms(console, file, commissioning, wanted)
    else:
        good, document = _examine(console, file, commissioning, tables=not options.json)
    if options.json:
        typer.echo(json.dumps({"format": FORMAT, "good": good, **document}, indent=1, allow_nan=False))
    return 0 if good else FAULT


def _require_sense(options: DoctorOptions) -> None:
    if options.flange and options.wiggle:
        raise UsageError("--flange and --wiggle are two checks: one after the other")
    if not options.flange and (options.rotation or options.poses):
        raise UsageError("--rotation and --poses are of the check with --flange")
    if not options.wiggle and (options.enable or options.yes):
        raise UsageError("--enable and --yes are of --wiggle; nothing else moves")
    if not (options.flange or options.wiggle) and options.arm:
        raise UsageError("--arm is of --flange and --wiggle; without them all devices are looked at")
    if options.rotation is not None and options.rotation not in FORMS:
        raise UsageError(f"--rotation {options.rotation}: there are {', '.join(FORMS)}")


# Looking at each device


def _examine(
    console: Console, file: CellFile, commissioning: Commissioning | None, *, tables: bool
) -> tuple[bool, dict[str, Any]]:
    devices = []
    for examined in _examined(file):
        devices.append(examined)
        if tables:
            console.print(_table(examined))
    missing = [] if commissioning is None else commissioning.missing()
    for lack in missing:
        _say(console, f"note: {lack}")
    problems = sum(each.problems for each in devices)
    _say(console, "All good." if problems == 0 else f"{problems} problem{'s' if problems > 1 else ''}; see above.")
    return problems == 0, {"devices": [asdict(each) for each in devices], "missing": missing}


def _examined(file: CellFile) -> Iterator[Examined]:
    """One device after the other, each opened alone, so that a failure is its own."""
    cell = file.cell
    for device in (*cell.arms, CAMERA_NAME):
        name = backend_of(cell, device)
        yield Examined(device, f"{cell.backends[name].type} '{name}'", _findings(file, device))


def _findings(file: CellFile, device: str) -> tuple[Finding, ...]:
    findings: list[Finding] = []
    try:
        with opened_alone(file, device) as backend:
            if device == CAMERA_NAME:
                findings += examine_camera(backend.camera(device), file.cell, backend.clock)
            else:
                findings += examine_robot(backend.robot(device), file.cell.robots[device], backend.clock)
    except DualcalError as error:
        findings.append(_failure(device, error))
    return tuple(findings)


def _failure(device: str, error: DualcalError) -> Finding:
    if not isinstance(error, DeviceError):
        return Finding("reachable", str(error), "problem")
    whose = "" if error.device == device else f"{error.device}: "
    return Finding("reachable", f"{whose}{error.why}", "problem", error.advice)


def _table(examined: Examined) -> Table:
    title = Text(f"{examined.device}, by {examined.reached}", "bold")
    table = Table(title=title, title_justify="left", box=None, pad_edge=False, show_header=False)
    table.add_column(no_wrap=True, width=7)
    table.add_column(max_width=20)
    table.add_column(overflow="fold")
    for finding in examined.findings:
        said = Text(finding.said)
        if finding.advice and finding.verdict != "good":
            said.append(f"\n-> {finding.advice}")
        table.add_row(_MARKS[finding.verdict], finding.subject, said)
    table.add_row()
    return table


def _say(console: Console, line: str) -> None:
    console.print(line, soft_wrap=True, highlight=False)
