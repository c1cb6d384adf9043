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
from dualcal_hal.transforms import Array
from procedures.planning.plan import Plan
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
    image: Image,
    feature_px: Sequence[float],
) -> None:
    """Write the picture of a run as a PNG of ``SIZE_PX``, all of it or nothing.

    plan: None where there was none, as for captures from elsewhere; image: (height, width), what the camera saw at
    one of the captures; feature_px: (2,) where that capture has its feature point, px.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = summary_figure(cell=cell, plan=plan, captures=captures, result=result, image=image, feature_px=feature_px)
    png = io.BytesIO()
    FigureCanvasAgg(figure).print_png(png)
    write_atomically(path, png.getvalue())


def summary_figure(
    *,
    cell: CellConfig,
    plan: Plan | None,
    captures: Captures,
    result: Result,
    image: Image,
    feature_px: Sequence[float],
) -> Figure:
    """The figure that :func:`draw_summary` writes, from the same parameters."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(SIZE_PX[0] / _DPI, SIZE_PX[1] / _DPI), dpi=_DPI, facecolor="white")
    _write_head(figure, cell, result)
    grid = figure.add_gridspec(2, 2, left=0.055, right=0.985, bottom=0.055, top=0.825, wspace=0.15, hspace=0.40)
    feature = np.array(feature_px, dtype=float)
    draw_frame(figure, grid[0, 0], cell, captures.captures, image, feature)
    _draw_convergence(figure.add_subplot(grid[0, 1]), result.iterations)
    _draw_mismatch(figure.add_subplot(grid[1, 0]), cell, captures.captures, result)
    draw_scene(figure, grid[1, 1], cell, plan, captures.captures, result, feature)
    return figure


def _write_head(figure: Figure, cell: CellConfig, result: Result) -> None:
    # A dollar sign in a name or a reason begins no formula.
    large = {"fontsize": 20, "weight": "bold", "va": "center", "parse_math": False}
    text = figure.text(0.02, 0.965, f"{cell.name}  |  method {result.method}  |  verdict", color=DARK, **large)
    right = text.get_window_extent().x1 / SIZE_PX[0]
    patch = {"boxstyle": "round,pad=0.3", "facecolor": _VERDICT.get(result.verdict, ORANGE), "edgecolor": "none"}
    figure.text(right + 0.015, 0.965, result.verdict, color="white", bbox=patch, **large)
    reasons = textwrap.fill(textwrap.shorten("; ".join(result.reasons), 300, placeholder=" ..."), 160)
    figure.text(0.02, 0.940, reasons, fontsize=TEXT, color=DARK, va="top", parse_math=False)


# -- the camera's frame (Fig. 5) ---------------------------------------------------------------------------------------


def _draw_board(axes: Axes, cell: CellConfig, image: Image, feature: Array, shown: CaptureRecord) -> None:
    """The board with its corners and the two circles, in px from the principal point."""
    centre = cell.camera.intrinsics.principal_point
    corners = np.array(shown.corners or [feature]) - centre
    half = max(60.0, 1.6 * float(np.abs(corners).max()))
    _show_image(axes, image, centre, half)
    axes.plot(*corners.T, ".", color=BLUE, markersize=5, label="corners")
    _draw_circles(axes, feature - centre, half)
    du, dv = feature - centre
    title(axes, f"Camera frame: offset ({du:+.3f}, {dv:+.3f}) px")
    legend_below_title(axes, columns=3)
    axes.set_xlabel(f"px; capture {shown.id}", fontsize=TEXT, parse_math=False)


def _draw_centre(axes: Axes, cell: CellConfig, image: Image, feature: Array) -> None:
    """The same around the optical axis, so far enlarged that the offset shows."""
    from matplotlib.patches import Rectangle

    centre, tolerance = cell.camera.intrinsics.principal_point, cell.procedure.tolerance_px
    offset = feature - centre
    half = max(0.25, 2.5 * float(np.abs(offset).max()))
    if tolerance != "auto":
        half = max(half, 2.0 * tolerance)
        corner, side = (-tolerance, -tolerance), 2 * tolerance
        label = f"tolerance {tolerance:g} px"
        axes.add_patch(Rectangle(corner, side, side, fill=False, edgecolor=BLUE, linestyle="--", label=label))
    _show_image(axes, image, centre, half)
    _draw_circles(axes, offset, half)
    title(axes, "Enlarged")
    if tolerance != "auto":
        legend_below_title(axes, columns=1)
    axes.set_xlabel("px", fontsize=TEXT)


def _show_image(axes: Axes, image: Image, centre: Array, half: float) -> None:
    height, width = image.shape
    left, top = -0.5 - centre
    axes.imshow(image, cmap="gray", vmin=0, vmax=255, extent=(left, left + width, top + height, top))
    axes.set(xlim=(-half, half), ylim=(half, -half), facecolor=GREY)
    axes.tick_params(labelsize=TEXT - 2)


def _draw_circles(axes: Axes, offset: Array, half: float) -> None:
    """Red about the optical axis, green about the feature point; radii differ, since they should coincide."""
    from matplotlib.patches import Circle

    for label, centre, radius, colour in (
        ("optical axis", np.zeros(2), 0.20 * half, RED),
        ("feature point", offset, 0.12 * half, GREEN),
    ):
        axes.add_patch(Circle(tuple(centre), radius, fill=False, edgecolor=colour, linewidth=2.5, label=label))
        axes.plot(*centre, "+", color=colour, markersize=9, markeredgewidth=1.8)


# -- convergence (Fig. 7) ----------------------------------------------------------------------------------------------


def _draw_convergence(axes: Axes, iterations: Sequence[Mapping[str, Any]]) -> None:
    from matplotlib.ticker import MaxNLocator

    number = np.arange(1, len(iterations) + 1)
    for key, words, marker, colour in (
        ("rotation_update", "rotation update", "o", BLUE),
        ("axis_update", "optical axis update", "s", ORANGE),
    ):
        updates = [iteration[key] for iteration in iterations if key in iteration]
        if updates:
            axes.semilogy(number, updates, marker=marker, color=colour, markersize=5, label=words)
    axes.axhline(PAPER_UPDATE, color=GREY, linestyle=":", linewidth=2, label=f"{PAPER_UPDATE:g}: where the paper stops")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    title(axes, f"Convergence: {len(iterations)} iterations")
    legend_below_title(axes, columns=3)
    _label(axes, "iteration", "size of the update (norm)")


# -- mismatch (Fig. 8) -------------------------------------------------------------------------------------------------


def _draw_mismatch(axes: Axes, cell: CellConfig, captures: Sequence[CaptureRecord], result: Result) -> None:
    if result.mismatch_before is None or result.mismatch_after is None:
        title(axes, "Mismatch: not verified")
        note = "no verification captures:\nthe mismatch on other constraints is not known"
        axes.text(0.5, 0.5, note, ha="center", va="center", fontsize=TEXT + 2, transform=axes.transAxes)
        axes.set_axis_off()
        return
    for words, mismatch, marker, colour in (
        ("before", result.mismatch_before, "s", ORANGE),
        ("after", result.mismatch_after, "o", BLUE),
    ):
        _draw_values(axes, words, mismatch, marker, colour)
    limit = cell.procedure.verification.limit_mm
    axes.axhline(limit, color=RED, linewidth=2, label=f"limit {limit:g} mm on the mean")
    if is_papers_cell(cell):
        before, after = PAPER_MISMATCH_MM["mean"]
        for value, label in ((before, f"paper, mean {before:g} to {after:g} mm"), (after, "")):
            axes.axhline(value, color=GREY, linestyle=":", linewidth=2, label=label)
    _separate_constraints(axes, [capture.constraint for capture in _verified(captures, result)])
    title(axes, "Mismatch on the verification captures")
    legend_below_title(axes, columns=2)
    _label(axes, "verification capture (a line between constraints)", "feature point to optical axis, mm")
    _plain_numbers(axes)


def _draw_values(axes: Axes, words: str, mismatch: Mismatch, marker: str, colour: str) -> None:
    number = np.arange(1, len(mismatch.values) + 1)
    label = f"{words}: mean {1e3 * mismatch.mean:.3g} mm, max {1e3 * mismatch.max:.3g} mm"
    axes.semilogy(number, 1e3 * np.array(mismatch.values), marker, color=colour, markersize=8, label=label)
    axes.axhline(1e3 * mismatch.mean, color=colour, linestyle="--", linewidth=1.5)


def _verified(captures: Sequence[CaptureRecord], result: Result) -> list[CaptureRecord]:
    """The captures that the values of the mismatch belong to, in their order."""
    rejected = {rejection.id for rejection in result.captures_rejected}
    return [capture for capture in captures if capture.use == "verification" and capture.id not in rejected]


def _separate_constraints(axes: Axes, constraints: Sequence[str]) -> None:
    for number in range(1, len(constraints)):
        if constraints[number] != constraints[number - 1]:
            axes.axvline(number + 0.5, color=GREY, linewidth=0.8)


def _plain_numbers(axes: Axes) -> None:
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.margins(y=0.1)


def _label(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x, fontsize=TEXT)
    axes.set_ylabel(y, fontsize=TEXT)
    axes.tick_params(labelsize=TEXT - 1)
    axes.grid(True, which="major", color="#E3E5E8", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
