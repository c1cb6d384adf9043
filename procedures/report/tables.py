"""Tables for the command line: rich renderables, nothing is printed here. They fit into 80 columns and are ASCII."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from dualcal_hal.config import CellConfig
from dualcal_hal.transforms import Array
from procedures.planning.plan import Plan, PlannedConstraint
from procedures.planning.ways import Leg
from procedures.report.nominal_errors import (
    PAPER_ERRORS,
    PAPER_MISMATCH_MM,
    NominalErrors,
    is_papers_cell,
    nominal_errors,
)

BASE = "active_base_in_passive_base"
CAMERA = "camera_in_active_flange"

_NONE = "-"
_STYLES = {"ok": "bold green", "fail": "bold red"}


def result_tables(
    cell: CellConfig, result: Mapping[str, Any], truth: Mapping[str, ArrayLike] | None = None
) -> RenderableType:
    """All there is to say about a result.

    result: the content of ``result.json``; truth: ``{transform name: (4, 4), m}``, where it is known.
    """
    tables: list[RenderableType] = [error_table(cell, result, truth)]
    if result["mismatch_mm"] is not None:
        tables.append(mismatch_table(cell, result["mismatch_mm"]))
    return Group(*tables, outcome(result))


def error_table(
    cell: CellConfig, result: Mapping[str, Any], truth: Mapping[str, ArrayLike] | None = None
) -> Table:
    """What was wrong with the nominal transforms, as in the paper's Tables 3 and 4, beside the truth if it is known.

    result, truth: see :func:`result_tables`. Below it the ``truth_error`` of the result, if it has one.
    """
    found = {name: np.array(result["transforms"][name]["matrix"]) for name in (BASE, CAMERA)}
    paper = is_papers_cell(cell)
    columns = {"found": _errors(found, cell)}
    if truth is not None:
        columns["truth"] = _errors({name: np.asarray(truth[name], dtype=float) for name in (BASE, CAMERA)}, cell)
        columns["found - truth"] = _difference(columns["found"], columns["truth"])
    if paper:
        columns = {"paper": PAPER_ERRORS, **columns}

    kept = _shift_is_kept(result)
    table = _table("Errors of the nominal transforms (Tables 3 and 4)", "error", "unit", *columns)
    for name, unit, axis, values in _error_rows(columns, found[CAMERA][:3, 2]):
        mark = "*" if kept and axis else ""
        table.add_row(name, unit, *(value + (mark if column == "found" else "") for column, value in values.items()))
    if result["truth_error"] is not None:
        table.add_section()
        for name, unit, value in _truth_rows(result["truth_error"]):
            table.add_row(name, unit, *[""] * (len(columns) - 1), value)
    table.caption = _notes(result, kept, paper)
    return table


def mismatch_table(cell: CellConfig, mismatch_mm: Mapping[str, Mapping[str, float]]) -> Table:
    """Mismatch on the verification captures before and after, as in the paper's Fig. 8.

    mismatch_mm: of ``result.json``.
    """
    before, after = mismatch_mm["before"], mismatch_mm["after"]
    headers = ["", "before", "after", "less by"]
    if is_papers_cell(cell):
        headers += ["paper before", "paper after", "less by"]
    table = _table("Mismatch on the verification captures, mm (Fig. 8)", *headers)
    for name in ("mean", "rms", "p95", "max"):
        row = [name, f"{before[name]:.3f}", f"{after[name]:.3f}", _reduction(before[name], after[name])]
        if is_papers_cell(cell):
            row += _paper_mismatch(name)
        table.add_row(*row)
    return table


def outcome(result: Mapping[str, Any]) -> Text:
    """The verdict with its reasons, and the captures that were left out.

    result: the content of ``result.json``.
    """
    verdict = result["verdict"]
    text = Text.assemble("Verdict: ", (verdict, _STYLES.get(verdict, "bold yellow")))
    for reason in result["reasons"]:
        text.append(f"\n  {reason}")
    for rejected in result["captures_rejected"]:
        text.append(f"\n  left out {rejected['id']}: {rejected['reason']}")
    return text


def plan_table(plan: Plan) -> Table:
    """One line a constraint: how far, how tilted and how clear its positions are."""
    title = f"{'Provisional plan' if plan.provisional else 'Plan'}, from {plan.planned_from}"
    headers = ["constraint", "positions", "distance mm", "tilt deg", "clearance mm"]
    table = _table(title, *headers)
    for use in dict.fromkeys(constraint.use for constraint in plan.constraints):
        for constraint in plan.of(use):
            table.add_row(*_plan_row(constraint))
        table.add_section()
    return table


def way_table(legs: Sequence[Leg]) -> Table:
    """The moves of a way in their order, each to its joint angles."""
    joints = max((len(leg.goal) for leg in legs), default=0)
    table = _table("Way, joints in deg", "move", "arm", *(f"q{i}" for i in range(1, joints + 1)))
    for number, leg in enumerate(legs, start=1):
        angles = (f"{angle:.1f}" for angle in np.degrees(leg.goal))
        table.add_row(str(number), Text(leg.arm), *angles)
    return table


def _table(title: str, *headers: str) -> Table:
    table = Table(title=Text(title), box=box.SIMPLE_HEAD, title_justify="left", caption_justify="left", pad_edge=False)
    for number, header in enumerate(headers):
        table.add_column(header, justify="left" if number == 0 or header in ("unit", "arm") else "right")
    return table


# -- errors ------------------------------------------------------------------------------------------------------------


def _errors(transforms: Mapping[str, Array], cell: CellConfig) -> NominalErrors:
    return nominal_errors(transforms[BASE], transforms[CAMERA], cell.nominal)


def _difference(found: NominalErrors, truth: NominalErrors) -> NominalErrors:
    return NominalErrors(
        found.w - truth.w, found.dz - truth.dz, found.dp_P_A - truth.dp_P_A, found.dp_H_E - truth.dp_H_E
    )


def _error_rows(
    columns: Mapping[str, NominalErrors], z_H_E: Array
) -> Iterator[tuple[str, str, bool, dict[str, str]]]:
    """Name, unit, whether it holds the shift along the optical axis, and the value for each column."""
    for name, unit, scale, digits in (("w", "", 1, 4), ("dz", "", 1, 4), ("dp_P_A", "mm", 1e3, 2), ("dp_H_E", "mm", 1e3, 2)):
        for i, letter in enumerate("xyz"):
            values = {column: f"{scale * getattr(errors, name)[i]:.{digits}f}" for column, errors in columns.items()}
            yield f"{name}_{letter}", unit, False, values
    # The paper's own axis is in H too: its column is held against the axis found here.
    along = {column: f"{1e3 * errors.dp_H_E @ z_H_E:.2f}" for column, errors in columns.items()}
    yield "dp_H_E along the axis", "mm", True, along


def _truth_rows(truth_error: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    base, camera = truth_error[BASE], truth_error[CAMERA]
    yield "T_P_A rotation", "deg", f"{base['rotation_deg']:.4f}"
    yield "T_P_A translation", "mm", f"{base['translation_mm']:.3f}"
    yield "optical axis direction", "deg", f"{camera['axis_deg']:.4f}"
    yield "camera across the axis", "mm", f"{camera['sideways_mm']:.3f}"


def _shift_is_kept(result: Mapping[str, Any]) -> bool:
    """Whether the camera's shift along its axis is the nominal one by construction."""
    return any(entry["of"] == CAMERA and any(entry["direction"][:3]) for entry in result["unobservable"])


def _notes(result: Mapping[str, Any], kept: bool, paper: bool) -> Text:
    notes = ["w: axis times sine of the angle; dz: difference of unit vectors."]
    if kept:
        notes.append("* not observable: nominal by construction, and part of dp_H_E x, y, z above.")
    if paper:
        z = np.array([0.0, 0.0, 1.0]) + PAPER_ERRORS.dz
        x, y, z = z / np.linalg.norm(z) - [0.0, 0.0, 1.0]
        notes.append(f"The paper's dz is as printed; as a difference of unit vectors: {x:.4f} {y:.4f} {z:.4f}.")
    return Text("\n".join(notes))


# -- mismatch ----------------------------------------------------------------------------------------------------------


def _paper_mismatch(name: str) -> list[str]:
    if name not in PAPER_MISMATCH_MM:
        return [_NONE] * 3
    before, after = PAPER_MISMATCH_MM[name]
    return [f"{before:.1f}", f"{after:.1f}", _reduction(before, after)]


def _reduction(before: float, after: float) -> str:
    return f"{100 * (1 - after / before):.1f} %" if before > 0 else _NONE


# -- plan --------------------------------------------------------------------------------------------------------------


def _plan_row(constraint: PlannedConstraint) -> list[RenderableType]:
    positions = constraint.positions
    distances = [1e3 * position.distance for position in positions]
    tilts = [float(np.degrees(position.tilt)) for position in positions]
    clearance = 1e3 * min(position.clearance for position in positions)
    return [
        Text(constraint.name),
        str(len(positions)),
        f"{max(distances):.0f} to {min(distances):.0f}",
        f"{min(tilts):.0f} to {max(tilts):.0f}",
        f"{clearance:.0f}",
    ]
