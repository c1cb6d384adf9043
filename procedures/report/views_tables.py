"""Tables of what came of photographs with flange poses: rich renderables of at most 80 columns, nothing is printed."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator

import numpy as np
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from dualcal_hal.session.views_result import COEFFICIENTS, ViewResult, ViewsResult
from dualcal_hal.transforms import Array, vector_from_rotation

_STYLES = {"ok": "bold green", "fail": "bold red"}
_LONGEST_NAME = 34
_WIDTH = 80

_PLACEMENTS = {
    "eye-in-hand": "the camera is on the arm, the target stays",
    "eye-to-hand": "the camera stays, the target is on the arm",
}
_POSES = {
    "as read": "flange poses as they were read",
    "with errors": "flange poses off by their noise",
}


def views_tables(result: ViewsResult) -> Group:
    """All there is to say about a result."""
    parts: list[RenderableType] = [
        _wrapped(_placement(result)),
        "",
        _transforms(result),
        _wrapped("rx, ry, rz: rotation vector. sigma: along and about the axes of the outer frame."),
        "",
        _views(result),
        _wrapped(
            "off by: px, rms per axis, with the flange where it was read. left out: by an estimate without the view; mm"
            " across the line of sight, at the target."
        ),
        "",
    ]
    if result.intrinsics_sigmas:
        parts += [_intrinsics(result), ""]
    parts += [_fits(result), _wrapped(_noise(result)), "", _outcome(result)]
    return Group(*parts)


def _placement(result: ViewsResult) -> str:
    placement = result.placement
    said = f"{placement.name}: {_PLACEMENTS[placement.name]}"
    if placement.stated:
        return f"{said}, as the file states."
    if placement.ratio is None:
        return f"{said}; found so, the other way round nothing explains the views."
    return f"{said}; found so, the other way round corners are {placement.ratio:.0f} times as far off."


def _transforms(result: ViewsResult) -> Table:
    used, corners = result.used, sum(view.seen for view in result.used)
    headers = ("x\nmm", "y\nmm", "z\nmm", "rx\ndeg", "ry\ndeg", "rz\ndeg")
    table = _table(f"From {len(used)} of {len(result.views)} views, {corners} corners", *headers)
    for name, found in result.transforms.items():
        rotation = np.degrees(vector_from_rotation(found.T[:3, :3]))
        table.add_row(name, *_cells(1e3 * found.T[:3, 3], 2), *_cells(rotation, 3), style="bold")
        sigmas = found.sigmas("position"), found.sigmas("rotation")
        table.add_row("sigma", *_cells(1e3 * sigmas[0], 2), *_cells(np.degrees(sigmas[1]), 3), end_section=True)
    return table


def _views(result: ViewsResult) -> Table:
    table = _table("Views", "corners", "off by\npx", "left out\npx", "left out\nmm", "")
    for view in result.views:
        remark = "" if view.used else "not used"
        cells = (
            (f"{view.rms:.2f}", f"{view.left_out_px:.2f}", f"{1e3 * view.left_out:.2f}") if view.seen else ("-",) * 3
        )
        table.add_row(Text(_short(view)), str(view.seen), *cells, remark, style=None if view.used else "yellow")
    return table


def _short(view: ViewResult) -> str:
    return view.name if len(view.name) <= _LONGEST_NAME else f"...{view.name[3 - _LONGEST_NAME :]}"


def _intrinsics(result: ViewsResult) -> Table:
    table = _table("Intrinsics, freed", "given", "found", "sigma")
    given, found = (
        (*lens.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *lens.distortion)
        for lens in (result.intrinsics_given, result.intrinsics)
    )
    for name, before, after in zip(COEFFICIENTS, given, found, strict=True):
        digits = 2 if name in COEFFICIENTS[:4] else 5
        sigma = result.intrinsics_sigmas.get(name)
        cells = f"{before:.{digits}f}", f"{after:.{digits}f}", "-" if sigma is None else f"{sigma:.{digits}f}"
        table.add_row(f"{name}, px" if digits == 2 else name, *cells)
    return table


def _fits(result: ViewsResult) -> Table:
    table = _table(
        "Fits compared" if len(result.attempts) > 1 else "Fit", "off by\npx", "left out\npx", "left out\nmm", ""
    )
    for name, attempt in result.attempts.items():
        taken = "taken" if name == result.poses and len(result.attempts) > 1 else ""
        numbers = f"{attempt.rms:.2f}", f"{attempt.left_out_px:.2f}", f"{1e3 * attempt.left_out:.2f}"
        table.add_row(_POSES[name], *numbers, taken)
    return table


def _noise(result: ViewsResult) -> str:
    noise = result.noise
    where = "found in the views" if noise.found else "as stated"
    return (
        f"Noise {where}, sigma per axis: {noise.pixel:.2g} px of a corner, {1e3 * noise.translation:.2g} mm and"
        f" {np.degrees(noise.rotation):.2g} deg of a flange pose."
    )


def _outcome(result: ViewsResult) -> Text:
    text = Text.assemble("Verdict: ", (result.verdict, _STYLES.get(result.verdict, "bold yellow")))
    for line in (*result.reasons, *_not_used(result)):
        text.append(f"\n{_broken(line, '  ')}")
    for warning in result.warnings:
        text.append(f"\n{_broken(f'warning: {warning}', '  ')}", style="yellow")
    return text


def _not_used(result: ViewsResult) -> Iterator[str]:
    for view in result.views:
        if not view.used:
            yield f"not used, {view.name}: {view.missed or view.dropped}"


def _wrapped(text: str) -> Text:
    return Text(_broken(text))


def _broken(text: str, indent: str = "") -> str:
    """Between words, further lines set in."""
    return textwrap.fill(text, _WIDTH, initial_indent=indent, subsequent_indent=indent + indent)


def _table(title: str, *headers: str) -> Table:
    table = Table(title=Text(title), box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
    table.add_column("")
    for header in headers:
        table.add_column(header, justify="right" if header else "left")
    return table


def _cells(values: Array, digits: int) -> list[str]:
    return [f"{value:z.{digits}f}" for value in values]
