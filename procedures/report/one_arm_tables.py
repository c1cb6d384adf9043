"""Tables for the command line about cells with one arm. They fit into 80 columns."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from dualcal_hal.config import OneArmConfig
from dualcal_hal.session.accuracy import HiddenRecord
from dualcal_hal.session.one_arm_result import OffRecord, OneArmResult, OneArmVerificationRecord, OneArmViewRecord
from dualcal_hal.transforms import Array, inverse, vector_from_rotation
from procedures.planning.plan import Plan, PlannedConstraint
from procedures.report.accuracy_tables import MOST_HIDDEN

_STYLES = {"ok": "bold green", "fail": "bold red"}
_WORST = 3
"""Views that are told of by name."""


def one_arm_tables(config: OneArmConfig, result: OneArmResult, truth: Mapping[str, Array] | None = None) -> Group:
    """All there is to say about a result; truth: both transforms (4, 4) in m by their names, where they are known."""
    parts: list[RenderableType] = [transform_table(config, result, truth), ""]
    parts += [errors_table(result), ""]
    if result.cannot_be_seen:
        parts += [_hidden(result.cannot_be_seen), ""]
    return Group(*parts, _outcome(result))


def transform_table(config: OneArmConfig, result: OneArmResult, truth: Mapping[str, Array] | None = None) -> Table:
    """Both transforms with their uncertainty, beside the nominal and the truth if it is known."""
    headers = ["transform", "", "unit", "nominal", "found", "1 sigma"]
    table = _table("Where camera and target are", *headers, *([] if truth is None else ["found - truth"]))
    nominal = dict(zip(config.names, (config.nominal.camera, config.nominal.target), strict=True))
    sigmas = np.sqrt(np.diag(np.array(result.covariance.matrix)))
    for number, (name, found) in enumerate(result.transforms.items()):
        off = None if truth is None else inverse(truth[name]) @ found.T
        for row, cells in enumerate(_rows(nominal[name], found.T, sigmas[6 * number : 6 * number + 6], off)):
            table.add_row(name if row == 0 else "", *cells)
        table.add_section()
    table.caption = Text("Rotations are axis times angle; sigma and difference are in the transform's child frame.")
    return table


def _rows(nominal: Array, found: Array, sigmas: Array, off: Array | None) -> Iterator[list[str]]:
    for what, unit, scale, digits, part in (("p", "mm", 1e3, 3, 0), ("r", "deg", float(np.degrees(1.0)), 4, 1)):
        values = [scale * _parts(T)[part] for T in (nominal, found)]
        of = scale * sigmas.reshape(2, 3)[part]
        differs = None if off is None else scale * _parts(off)[part]
        for i, letter in enumerate("xyz"):
            cells = [f"{what}_{letter}", unit, f"{values[0][i]:z.1f}", f"{values[1][i]:z.{digits}f}"]
            cells.append(f"{of[i]:.{digits}f}")
            yield cells if differs is None else [*cells, f"{differs[i]:z.{digits}f}"]


def _parts(T: Array) -> tuple[Array, Array]:
    """(3,) m and (3,) rad."""
    return T[:3, 3], vector_from_rotation(T[:3, :3])


def errors_table(result: OneArmResult) -> Table:
    """How far corners are from their predictions, and what is predicted of points."""
    table = _table("Errors", "", "px", "mm at the target")
    proof = result.verification
    if proof is not None:
        table.add_row("verification views, nominal", *_off(proof.nominal))
        table.add_row("verification views, found", *_off(proof.found))
    table.add_row("each view, by the others", *_off(result.left_out))
    table.add_row("all views that were used, fitted", f"{result.fit.rms_px:.3f}", "")
    table.add_section()
    for words, error in (
        ("predicted: a point at the target", result.predicted_error.at_target),
        ("predicted: where the camera is", result.predicted_error.camera),
    ):
        table.add_row(words, "", f"{error.rms_mm:.3f}, 95 % {error.p95_mm:.3f}")
    table.caption = Text(
        f"rms; {len(result.captures_used)} views used, {_verified(proof)}; corners {result.noise.pixel_px:.3g} px, "
        f"joints {result.noise.joint_mrad:.3g} mrad"
    )
    return table


def _hidden(cannot_be_seen: Sequence[HiddenRecord]) -> Text:
    """The largest of it."""
    ordered = sorted(cannot_be_seen, key=lambda hidden: -hidden.error_mm)
    lines = ["Cannot be seen in any view, and puts a point off by:"]
    lines += [f"  {hidden.error_mm:.2f} mm: {hidden.by} of {hidden.what}" for hidden in ordered[:MOST_HIDDEN]]
    if left := len(ordered) - MOST_HIDDEN:
        lines.append(f"  and {left} more, all of them in result.json")
    return Text("\n".join(lines))


def _off(off: OffRecord | None) -> tuple[str, str]:
    """Of what would be behind the camera nothing can be said."""
    return ("-", "-") if off is None else (f"{off.rms_px:.3f}", f"{off.rms_mm:.3f}")


def _verified(proof: OneArmVerificationRecord | None) -> str:
    return "not verified" if proof is None else f"{len(proof.views)} to verify"


def _outcome(result: OneArmResult) -> Text:
    text = Text.assemble("Verdict: ", (result.verdict, _STYLES.get(result.verdict, "bold yellow")))
    for reason in result.reasons:
        text.append(f"\n  {reason}")
    if result.verdict == "fail":
        for view in _worst(result):
            text.append(f"\n  by the others off: {view.id}, {_far(view.left_out)}")
    for rejected in result.captures_rejected:
        text.append(f"\n  left out {rejected.id}: {rejected.reason}")
    return text


def _worst(result: OneArmResult) -> list[OneArmViewRecord]:
    """Those that should be behind the camera first."""
    return sorted(result.views, key=lambda view: -np.inf if view.left_out is None else -view.left_out.rms_px)[:_WORST]


def _far(off: OffRecord | None) -> str:
    return "its target should be behind the camera" if off is None else f"{off.rms_px:.2f} px, {off.rms_mm:.2f} mm"


def views_table(plan: Plan) -> Table:
    """One line a view: how far, how tilted and how clear it is, and what else the plan says of it."""
    title = f"{'Provisional plan' if plan.provisional else 'Plan'} of views, from {plan.planned_from}"
    headers = ["view", "distance\nmm", "tilt\ndeg", "clear\nmm", "manip.\ndm^3", "to limit\ndeg", "time\ns"]
    table = _table(title, *headers)
    phases = Counter(_phase(view) for view in plan.constraints)
    for phase in phases:
        for view in plan.constraints:
            if _phase(view) == phase:
                table.add_row(*_view_row(view))
        table.add_section()
    table.caption = Text(
        f"About {plan.seconds:.0f} s in all: ways and pictures.\n"
        "clear: whatever the error of what is known of camera and target. manip.: sqrt(det J J^T)."
    )
    return table


def _phase(view: PlannedConstraint) -> str:
    return view.name.partition("/")[0]


def _view_row(view: PlannedConstraint) -> list[str]:
    position = view.positions[0]
    return [
        view.name,
        f"{1e3 * position.distance:.0f}",
        f"{np.degrees(position.tilt):.0f}",
        f"{1e3 * position.clearance:.0f}",
        f"{1e3 * view.manipulability:.1f}",
        f"{np.degrees(view.joint_margin):.0f}",
        f"{view.seconds:.1f}",
    ]


def _table(title: str, *headers: str) -> Table:
    table = Table(title=Text(title), box=box.SIMPLE_HEAD, title_justify="left", caption_justify="left", pad_edge=False)
    for number, header in enumerate(headers):
        table.add_column(header, justify="left" if number == 0 or header == "unit" else "right")
    return table
