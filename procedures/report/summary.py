"""``summary.png``: what the camera saw, how the estimate settled, what it is worth, and where all of it is."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dualcal_hal.camera import Image
from dualcal_hal.config import CellConfig
from dualcal_hal.session.captures import CaptureRecord, Captures
from dualcal_hal.session.files import write_atomically
from dualcal_hal.session.result import Mismatch, Result
from procedures.planning.plan import Plan
from procedures.report.accuracy_pictures import draw_error_map, draw_fit
from procedures.report.expected_mismatch import expected_mismatch
from procedures.report.frame import draw_frame
from procedures.report.nominal_errors import PAPER_MISMATCH_MM, PAPER_UPDATE, is_papers_cell
from procedures.report.scene import draw_scene
from procedures.report.style import BLUE, DARK, GREEN, GREY, ORANGE, RED, TEXT, head, label

if TYPE_CHECKING:  # matplotlib takes a good part of a second to import
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIZE_PX = (1600, 1200)
_DPI = 100
_VERDICT = {"ok": GREEN, "fail": RED}


def draw_summary(
    path: Path,
    *,
    cell: CellConfig,
    plan: Plan | None,
    captures: Captures,
    result: Result,
    image: Image | None,
    feature_px: Sequence[float],
) -> None:
    """Write the picture of a run as a PNG of ``SIZE_PX``, all of it or nothing.

    plan: None where there was none, as for captures from elsewhere; image: (height, width), what the camera saw at
    one of the captures, None where that is lost; feature_px: (2,) where that capture has its feature point, px.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = summary_figure(cell=cell, plan=plan, captures=captures, result=result, image=image, feature_px=feature_px)
    png = io.BytesIO()
    FigureCanvasAgg(figure).print_png(png)  # type: ignore[no-untyped-call]
    write_atomically(path, png.getvalue())


def summary_figure(
    *,
    cell: CellConfig,
    plan: Plan | None,
    captures: Captures,
    result: Result,
    image: Image | None,
    feature_px: Sequence[float],
) -> Figure:
    """The figure that :func:`draw_summary` writes, from the same parameters."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(SIZE_PX[0] / _DPI, SIZE_PX[1] / _DPI), dpi=_DPI, facecolor="white")
    shown = min(captures.captures, key=lambda capture: float(np.linalg.norm(np.subtract(feature_px, capture.feature))))
    _write_head(figure, cell, result)
    edges = {"left": 0.055, "right": 0.985, "bottom": 0.055, "top": 0.825, "hspace": 0.40}
    above = figure.add_gridspec(2, 2, wspace=0.15, **edges)
    draw_frame(figure, above[0, 0], cell, captures.captures, image, shown)
    if result.accuracy is None:
        _draw_convergence(figure.add_subplot(above[0, 1]), result.iterations)
        below = [above[1, 0], above[1, 1]]
    else:
        draw_error_map(figure, above[0, 1], result, result.accuracy)
        thirds = figure.add_gridspec(2, 3, wspace=0.2, width_ratios=(1, 1, 1.3), **edges)
        draw_fit(figure.add_subplot(thirds[1, 0]), captures.captures, result, result.accuracy)
        below = [thirds[1, 1], thirds[1, 2]]
    _draw_mismatch(figure.add_subplot(below[0]), cell, captures.captures, result)
    draw_scene(figure, below[1], cell, plan, captures.captures, result, shown)
    return figure


def _write_head(figure: Figure, cell: CellConfig, result: Result) -> None:
    # A dollar sign in a name or a reason begins no formula.
    large: dict[str, Any] = {"fontsize": 20, "weight": "bold", "va": "center", "parse_math": False}
    text = figure.text(0.02, 0.965, f"{cell.name}  |  method {result.method}  |  verdict", color=DARK, **large)
    right = text.get_window_extent().x1 / SIZE_PX[0]
    patch = {"boxstyle": "round,pad=0.3", "facecolor": _VERDICT.get(result.verdict, ORANGE), "edgecolor": "none"}
    figure.text(right + 0.015, 0.965, result.verdict, color="white", bbox=patch, **large)
    reasons = textwrap.fill(textwrap.shorten("; ".join(result.reasons), 300, placeholder=" ..."), 160)
    figure.text(0.02, 0.940, reasons, fontsize=TEXT, color=DARK, va="top", parse_math=False)


# -- convergence (Fig. 7) ----------------------------------------------------------------------------------------------


def _draw_convergence(axes: Axes, iterations: Sequence[Mapping[str, Any]]) -> None:
    number = np.arange(1, len(iterations) + 1)
    for key, words, marker, colour in (
        ("rotation_update", "rotation update", "o", BLUE),
        ("axis_update", "optical axis update", "s", ORANGE),
    ):
        updates = [iteration[key] for iteration in iterations if key in iteration]
        if updates:
            axes.semilogy(number, updates, marker=marker, color=colour, markersize=5, label=words)
    axes.axhline(PAPER_UPDATE, color=GREY, linestyle=":", linewidth=2, label=f"{PAPER_UPDATE:g}: where the paper stops")
    label(axes, "iteration", "norm of the update")
    _tidy(axes)
    head(axes, f"Convergence: {len(iterations)} iterations")


# -- mismatch (Fig. 8) -------------------------------------------------------------------------------------------------


def _draw_mismatch(axes: Axes, cell: CellConfig, captures: Sequence[CaptureRecord], result: Result) -> None:
    from matplotlib.ticker import FuncFormatter

    if result.mismatch_before is None or result.mismatch_after is None:
        head(axes, "Mismatch: not verified")
        note = "no verification captures:\nthe mismatch on other constraints\nis not known"
        axes.text(0.5, 0.5, note, ha="center", va="center", fontsize=TEXT + 2, transform=axes.transAxes)
        axes.set_axis_off()
        return
    narrow = result.accuracy is not None
    for words, mismatch, marker, colour in (
        ("before", result.mismatch_before, "s", ORANGE),
        ("after", result.mismatch_after, "o", BLUE),
    ):
        largest = "" if narrow else f", max {1e3 * mismatch.max:.3g} mm"
        _draw_values(axes, f"{words}: mean {1e3 * mismatch.mean:.3g} mm{largest}", mismatch, marker, colour)
    verified = _verified(captures, result)
    if result.accuracy is None:
        limit = cell.procedure.verification.limit_mm
        axes.axhline(limit, color=RED, linewidth=2, label=f"limit on the mean: {limit:g} mm")
    elif not result.accuracy.knowns:
        expected = 1e3 * expected_mismatch(cell, verified, result, result.accuracy)
        number = np.arange(1, len(expected) + 1)
        axes.plot(number, expected, "_", color=DARK, markersize=12, markeredgewidth=2, label="predicted (rms)")
    if is_papers_cell(cell):
        before, after = PAPER_MISMATCH_MM["mean"]
        words, joined = ("paper:", ", ") if narrow else ("paper's means:", " and ")
        axes.axhline(before, color=GREY, linestyle=":", label=f"{words} {before:g}{joined}{after:g} mm")
        axes.axhline(after, color=GREY, linestyle=":")
    _separate_constraints(axes, [capture.constraint for capture in verified])
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.margins(y=0.1)
    across = "a line between constraints" if not narrow else "lines: constraints"
    label(axes, f"verification capture ({across})", "feature point to optical axis, mm")
    _tidy(axes)
    head(axes, "Mismatch, verification" if narrow else "Mismatch on the verification captures")


def _draw_values(axes: Axes, words: str, mismatch: Mismatch, marker: str, colour: str) -> None:
    number = np.arange(1, len(mismatch.values) + 1)
    axes.semilogy(number, 1e3 * np.array(mismatch.values), marker, color=colour, markersize=8, label=words)
    axes.axhline(1e3 * mismatch.mean, color=colour, linestyle="--", linewidth=1.5)


def _verified(captures: Sequence[CaptureRecord], result: Result) -> list[CaptureRecord]:
    """The captures that the values of the mismatch belong to, in their order."""
    rejected = {rejection.id for rejection in result.captures_rejected}
    return [capture for capture in captures if capture.use == "verification" and capture.id not in rejected]


def _separate_constraints(axes: Axes, constraints: Sequence[str]) -> None:
    for number in range(1, len(constraints)):
        if constraints[number] != constraints[number - 1]:
            axes.axvline(number + 0.5, color=GREY, linewidth=0.8)


def _tidy(axes: Axes) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(True, which="major", color="#E3E5E8", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
