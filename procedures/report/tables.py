"""Tables for the command line: rich renderables, nothing is printed here. They fit into 80 columns."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from dualcal_hal.config import CellConfig
from dualcal_hal.session.result import T_H_E_NAME, T_P_A_NAME, Mismatch, Rejected, Result, TruthError
from dualcal_hal.transforms import Array
from procedures.planning.choice import LEAST_SPREAD
from procedures.planning.model import Posture
from procedures.planning.plan import Plan, PlannedConstraint
from procedures.planning.ways import Leg
from procedures.report.accuracy_tables import accuracy_tables, advice
from procedures.report.kept import Kept
from procedures.report.nominal_errors import (
    PAPER_ERRORS,
    PAPER_MISMATCH_MM,
    NominalErrors,
    is_papers_cell,
    nominal_errors,
)

MOST_LEFT_OUT = 4
"""Reasons for which captures were left out that are shown, each with its captures."""

_NONE = "-"
_STYLES = {"ok": "bold green", "fail": "bold red"}
_KEPT = "*"  # beside what the paper's method leaves as it was given, wholly or in part
_WIDTH = 78
_MOST_IDS = 4


def result_tables(cell: CellConfig, result: Result, truth: Mapping[str, Array] | None = None) -> Group:
    """What there is to say about a result; truth: both transforms (4, 4) in m by their names, where they are known.

    The outcome comes last: it is what the screen stays at.
    """
    parts: list[RenderableType] = []
    accuracy = result.accuracy
    if accuracy is not None:
        parts += [accuracy_tables(result, accuracy), ""]
    if accuracy is None or truth is not None or is_papers_cell(cell):
        parts += [error_table(cell, result, truth), ""]
    if result.mismatch_before is not None and result.mismatch_after is not None:
        parts.append(mismatch_table(cell, result.mismatch_before, result.mismatch_after))
    return Group(*parts, outcome(result))


def error_table(cell: CellConfig, result: Result, truth: Mapping[str, Array] | None = None) -> Table:
    """What was wrong with the nominal transforms, as in the paper's Tables 3 and 4, beside the truth if it is known.

    truth: as in :func:`result_tables`. Below come the result's own errors against the truth, if it states them.
    """
    columns = {"found": nominal_errors(result.T_P_A, result.T_H_E, cell.nominal)}
    if is_papers_cell(cell):
        columns = {"paper": PAPER_ERRORS, **columns}
    if truth is not None:
        columns["truth"] = nominal_errors(truth[T_P_A_NAME], truth[T_H_E_NAME], cell.nominal)
        columns["found - truth"] = columns["found"] - columns["truth"]

    table = _table("Errors of the nominal transforms (Tables 3 and 4)", "error", "unit", *columns)
    kept = Kept.of(result)
    shift, roll = (_KEPT if is_kept else "" for is_kept in (kept.shift, kept.roll))
    for name, unit, values in _error_rows(columns, shift):
        table.add_row(name, unit, *values)
    along = [f"{1e3 * errors.dp_H_E @ result.optical_axis:z.2f}" for errors in columns.values()]
    table.add_row(f"dp_H_E along the axis{shift}", "mm", *along)
    rolls = [_NONE if np.isnan(errors.roll) else f"{np.degrees(errors.roll):z.4f}" for errors in columns.values()]
    table.add_row(f"roll about the axis{roll}", "deg", *rolls)
    if result.truth_error is not None:
        table.add_section()
        for name, unit, value in _truth_rows(result.truth_error):
            table.add_row(name, unit, *[""] * (len(columns) - 1), value)
    table.caption = _notes(cell, result)
    return table


def mismatch_table(cell: CellConfig, before: Mismatch, after: Mismatch) -> Table:
    """Mismatch on the verification captures with the nominal and the found transforms, as in the paper's Fig. 8."""
    headers = ["", "before", "after", "less by"]
    if is_papers_cell(cell):
        headers += ["paper before", "paper after", "less by"]
    table = _table("Mismatch on the verification captures, mm (Fig. 8)", *headers)
    table.min_width = len(str(table.title)) + 1
    for name in ("mean", "rms", "p95", "max"):
        old, new = 1e3 * getattr(before, name), 1e3 * getattr(after, name)
        row = [name, f"{old:.3f}", f"{new:.3f}", _reduction(old, new)]
        table.add_row(*row, *(_paper_mismatch(name) if is_papers_cell(cell) else ()))
    return table


def outcome(result: Result) -> Text:
    """The verdict with its reasons and warnings, what is to be done, and the captures that were left out."""
    text = Text.assemble("Verdict: ", (result.verdict, _STYLES.get(result.verdict, "bold yellow")))
    for line in (*_reasons(result), *_left_out(result.captures_rejected)):
        text.append("\n" + textwrap.fill(line, _WIDTH, initial_indent="  ", subsequent_indent="    "))
    return text


def _reasons(result: Result) -> Iterator[str]:
    told_below = tuple(f"{rejected.id}: {rejected.reason}" for rejected in result.captures_rejected)
    if result.verification is not None:
        told_below += result.verification.look_at
    yield from (reason for reason in result.reasons if not reason.endswith(told_below))
    if result.accuracy is not None:
        yield from advice(result.accuracy, result.verification)


def _left_out(rejected: Sequence[Rejected]) -> Iterator[str]:
    """A line for each reason, with its captures."""
    captures: dict[str, list[str]] = {}
    for one in rejected:
        captures.setdefault(one.reason, []).append(one.id)
    for reason, ids in list(captures.items())[:MOST_LEFT_OUT]:
        more = f" and {len(ids) - _MOST_IDS} more" if len(ids) > _MOST_IDS else ""
        yield f"left out {', '.join(ids[:_MOST_IDS])}{more}: {reason}"
    left = sum(len(ids) for ids in list(captures.values())[MOST_LEFT_OUT:])
    if left:
        yield f"left out {left} more captures; result.json has them all with their reasons"


def plan_table(plan: Plan) -> Table:
    """One line a constraint: how far, how tilted and how clear its positions are, and what else the plan says of it."""
    title = f"{'Provisional plan' if plan.provisional else 'Plan'}, from {plan.planned_from}"
    headers = [
        "constraint",
        "points",
        "distance\nmm",
        "tilt\ndeg",
        "clear\nmm",
        "manip.\ndm^3",
        "to limit\ndeg",
        "time\ns",
    ]
    table = _table(title, *headers)
    for use in dict.fromkeys(constraint.use for constraint in plan.constraints):
        for constraint in plan.of(use):
            table.add_row(*_plan_row(constraint))
        table.add_section()
    table.caption = Text("\n".join(_plan_notes(plan)))
    return table


def way_table(legs: Sequence[Leg]) -> Table:
    """The moves of a way in their order, each with the joint angles it passes and ends at."""
    joints = max((len(leg.goal) for leg in legs), default=0)
    table = _table("Way, joints in deg", "move", "arm", *(f"q{i}" for i in range(1, joints + 1)))
    for number, leg in enumerate(legs, start=1):
        for i, waypoint in enumerate(leg.waypoints):
            angles = (f"{angle:.1f}" for angle in np.degrees(waypoint))
            table.add_row(str(number) if i == 0 else "", Text(leg.arm), *angles)
    return table


def posture_table(posture: Posture) -> Table:
    """Where both arms are to stand."""
    joints = max(len(posture.active), len(posture.passive))
    table = _table("Posture, joints in deg", "arm", *(f"q{i}" for i in range(1, joints + 1)))
    for arm, angles in (("active", posture.active), ("passive", posture.passive)):
        table.add_row(arm, *(f"{angle:.1f}" for angle in np.degrees(angles)))
    return table


def _table(title: str, *headers: str) -> Table:
    table = Table(title=Text(title), box=box.SIMPLE_HEAD, title_justify="left", caption_justify="left", pad_edge=False)
    for number, header in enumerate(headers):
        table.add_column(header, justify="left" if number == 0 or header in ("unit", "arm") else "right")
    return table


# -- errors ------------------------------------------------------------------------------------------------------------


def _error_rows(columns: Mapping[str, NominalErrors], mark: str) -> Iterator[tuple[str, str, list[str]]]:
    """Name, unit, and the value for each column; mark: of the camera's position."""
    for name, unit, scale, digits, shown in (
        ("w", "", 1.0, 4, ""),
        ("dz", "", 1.0, 4, ""),
        ("dp_P_A", "mm", 1e3, 2, ""),
        ("dp_H_E", "mm", 1e3, 2, mark),
    ):
        for i, letter in enumerate("xyz"):
            values = [scale * getattr(errors, name)[i] for errors in columns.values()]
            yield f"{name}_{letter}{shown}", unit, [f"{value:z.{digits}f}" for value in values]


def _truth_rows(error: TruthError) -> Iterator[tuple[str, str, str]]:
    yield "T_P_A rotation", "deg", f"{np.degrees(error.base_rotation):.4f}"
    yield "T_P_A translation", "mm", f"{1e3 * error.base_translation:.3f}"
    yield "optical axis direction", "deg", f"{np.degrees(error.camera_axis):.4f}"
    yield "camera across the axis", "mm", f"{1e3 * error.camera_sideways:.3f}"
    if error.camera_rotation is not None:
        yield "T_H_E rotation", "deg", f"{np.degrees(error.camera_rotation):.4f}"
    if error.camera_translation is not None:
        yield "T_H_E translation", "mm", f"{1e3 * error.camera_translation:.3f}"


def _notes(cell: CellConfig, result: Result) -> Text:
    notes = ["w: axis times sine of the angle; dz: difference of unit vectors."]
    if is_papers_cell(cell):
        nominal = np.array([0.0, 0.0, 1.0])
        axis = nominal + PAPER_ERRORS.dz
        x, y, z = axis / np.linalg.norm(axis) - nominal
        notes.append(f"The paper's dz is as printed; as a difference of unit vectors {x:.4f} {y:.4f} {z:.4f}.")
    kept = Kept.of(result)
    if kept.words:
        notes.append(f"{_KEPT} Not observable, nominal by construction: the camera's {kept.words}.")
    if kept.shift:
        notes.append("  The depth is a part of dp_H_E x, y and z.")
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
    return [
        Text(constraint.name),
        str(len(positions)),
        f"{max(distances):.0f}-{min(distances):.0f}",
        f"{min(tilts):.0f}-{max(tilts):.0f}",
        f"{1e3 * constraint.clearance:.0f}",
        f"{1e3 * constraint.manipulability:.1f}",
        f"{np.degrees(constraint.joint_margin):.0f}",
        f"{constraint.seconds:.1f}",
    ]


def _plan_notes(plan: Plan) -> Iterator[str]:
    yield f"About {plan.seconds:.0f} s in all: ways, moves between the points, and pictures."
    if plan.axis_spread is not None:
        yield f"Spread of the axes {plan.axis_spread:.3f}: least eigenvalue of mean(z z^T), at least {LEAST_SPREAD:g}."
    error = "whatever the bases' error is after the looks" if plan.provisional else "whatever the bases' error"
    yield f"clear: {error}. manip.: sqrt(det J J^T)."
    yield "to limit: of the joint nearest to the limits a procedure keeps."
    yield "Each is the least of both arms."
