"""Tables of what came of pose triples: rich renderables of at most 80 columns, nothing is printed here."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from dualcal_hal.session.result import T_P_A_NAME
from dualcal_hal.session.triples_result import LETTERS, TripleResidual, TriplesResult
from dualcal_hal.transforms import Array, vector_from_rotation

MOST_SHOWN = 5
"""Triples that fit worst."""

_SHOWN = {**LETTERS, "T_P_A": T_P_A_NAME}
_STATED_IN = {"file": "from the file", "option": "from the command line"}
_LONGEST_NAME = 40

_NAMES = "\n".join(
    (
        *(f"{letter:6} {name}" for letter, name in _SHOWN.items()),
        "T_P_A is the inverse of Y. rx, ry, rz: rotation vector.",
        "sigma, and directions: along and about the axes of the outer frame.",
    )
)
_SQUARE = """\
square: in units of the stated noise, 6 or less on average.
off by: from the measured B to what A, C and the found transforms make of it."""


def triples_tables(result: TriplesResult) -> Group:
    """All there is to say about a result."""
    parts: list[RenderableType] = [
        _transforms(result),
        Text(_NAMES),
        "",
        _least_certain(result),
        Text(_observability(result)),
        "",
        _noise(result),
        "",
        _worst(result),
        Text(_SQUARE),
    ]
    if result.warnings:
        parts.append(Text("\n".join(("", *(f"warning: {warning}" for warning in result.warnings))), style="yellow"))
    return Group(*parts)


def _transforms(result: TriplesResult) -> Table:
    headers = ("x\nmm", "y\nmm", "z\nmm", "rx\ndeg", "ry\ndeg", "rz\ndeg")
    table = _table(f"AXB = YCZ from {len(result.residuals)} triples", *headers)
    for letter, name in _SHOWN.items():
        found = result.transforms[name]
        rotation = np.degrees(vector_from_rotation(found.T[:3, :3]))
        table.add_row(letter, *_cells(1e3 * found.T[:3, 3], 3), *_cells(rotation, 4), style="bold")
        sigmas = found.sigmas("position"), found.sigmas("rotation")
        table.add_row("sigma", *_cells(1e3 * sigmas[0], 3), *_cells(np.degrees(sigmas[1]), 4), end_section=True)
    return table


def _least_certain(result: TriplesResult) -> Table:
    table = _table("Least certain directions", "position\nmm", "\nalong x, y, z", "rotation\ndeg", "\nabout x, y, z")
    for letter, name in LETTERS.items():
        cells = []
        for of, in_unit, digits in (("position", 1e3, 3), ("rotation", np.degrees(1.0), 4)):
            sigma, direction = result.transforms[name].least_certain(of)
            cells += [f"{in_unit * sigma:.{digits}f}", "  ".join(f"{value:z5.2f}" for value in direction)]
        table.add_row(letter, *cells)
    return table


def _observability(result: TriplesResult) -> str:
    needed = f"{result.conditioning_needed:.0e}"
    return f"All 18 directions are determined: conditioning {result.conditioning:.2g} (needed: {needed})."


def _noise(result: TriplesResult) -> Group:
    table = _table("Noise as stated, sigma per axis", "mm", "deg", "")
    for name, stated in result.noise.items():
        where = _STATED_IN[stated.stated_in]
        table.add_row(name, f"{1e3 * stated.translation:.4g}", f"{np.degrees(stated.rotation):.4g}", where)
    found = f"Scale {result.scale:.3g}: the residuals are "
    if result.noise_fits:
        return Group(table, Text(f"{found}as large as the stated noise makes them."))
    if result.covariance_is_scaled:
        said = "too large for the stated noise; the sigmas of X, Y and Z are multiplied by it."
    else:
        said = "too small for the stated noise; the sigmas of X, Y and Z are those that it makes."
    return Group(table, Text(found + said, style="yellow"))


def _worst(result: TriplesResult) -> Table:
    shown = result.worst(MOST_SHOWN)
    title = "Triples that fit worst" if len(shown) < len(result.residuals) else "Triples, the worst first"
    table = _table(title, "square", "off by\nmm", "and by\ndeg")
    for row in map(_residual_row, shown):
        table.add_row(*row)
    return table


def _residual_row(residual: TripleResidual) -> Iterator[RenderableType]:
    name = residual.id if len(residual.id) <= _LONGEST_NAME else f"{residual.id[: _LONGEST_NAME - 3]}..."
    yield Text(name)
    yield f"{residual.square:.1f}"
    yield f"{1e3 * np.linalg.norm(residual.translation):.3f}"
    yield f"{np.degrees(np.linalg.norm(residual.rotation)):.4f}"


def _table(title: str, *headers: str) -> Table:
    table = Table(title=Text(title), box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
    table.add_column("")
    for header in headers:
        table.add_column(header, justify="right" if header else "left")
    return table


def _cells(values: Array, digits: int) -> list[str]:
    return [f"{value:z.{digits}f}" for value in values]
