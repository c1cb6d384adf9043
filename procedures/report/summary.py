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
from procedures.planning.plan import Plan
from procedures.report.nominal_errors import PAPER_MISMATCH_MM, PAPER_UPDATE, is_papers_cell
from procedures.report.palette import BLUE, DARK, GREEN, GREY, ORANGE, RED

if TYPE_CHECKING:  # matplotlib takes a good part of a second to import
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIZE_PX = (1600, 1200)
_DPI = 100
_TEXT = 12.0
_BELOW_TITLE = {"loc": "lower left", "bbox_to_anchor": (-0.01, 1.0), "frameon": False, "borderaxespad": 0.2}


def draw_summary(
    path: Path,
    *,
    cell: CellConfig,
    plan: Plan | None,
    captures: Captures,
    result: Mapping[str, Any],
    image: Image,
    feature_px: Sequence[float],
) -> None:
    """Write the picture of a run as PNG of ``SIZE_PX``, all of it or nothing.

    plan: None where there was none, as for captures from elsewhere; result: the content of ``result.json``;
    image: (height, width), what the camera saw at one of the captures; feature_px: (2,) where that capture has
    its feature point, px.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = summary_figure(
        cell=cell, plan=plan, captures=captures, result=result, image=image, feature_px=feature_px
    )
    png = io.BytesIO()
    FigureCanvasAgg(figure).print_png(png, metadata={"Software": None})
    write_atomically(path, png.getvalue())


def summary_figure(
    *,
    cell: CellConfig,
    plan: Plan | None,
    captures: Captures,
    result: Mapping[str, Any],
    image: Image,
    feature_px: Sequence[float],
) -> Figure:
    """The figure that :func:`draw_summary` writes; its parameters are the same."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(SIZE_PX[0] / _DPI, SIZE_PX[1] / _DPI), dpi=_DPI, facecolor="white")
    grid = figure.add_gridspec(2, 2, left=0.055, right=0.985, bottom=0.055, top=0.825, wspace=0.15, hspace=0.40)
    left = grid[0, 0].subgridspec(1, 2, width_ratios=[1.3, 1], wspace=0.22)
    shown = min(captures.captures, key=lambda capture: float(np.linalg.norm(np.subtract(capture.feature, feature_px))))
    _write_head(figure, cell, result)
    _draw_frame(figure.add_subplot(left[0]), cell, image, np.asarray(feature_px), shown)
    _draw_centre(figure.add_subplot(left[1]), cell, image, np.asarray(feature_px))
    _draw_convergence(figure.add_subplot(grid[0, 1]), result["iterations"])
    _draw_mismatch(figure.add_subplot(grid[1, 0]), cell, captures.captures, result)
    draw_scene(figure.add_subplot(grid[1, 1], projection="3d"), cell, plan, captures.captures, result, shown)
    return figure


def _write_head(figure: Figure, cell: CellConfig, result: Mapping[str, Any]) -> None:
    # A dollar sign in a name or reason is no formula.
    title = f"{cell.name}   |   method {result['method']}   |   verdict "
    verdict = result["verdict"]
    text = figure.text(0.02, 0.965, title, fontsize=20, weight="bold", color=DARK, va="center", parse_math=False)
    right = text.get_window_extent().x1 / SIZE_PX[0]
    chip = {"boxstyle": "round,pad=0.3", "facecolor": _VERDICT.get(verdict, ORANGE), "edgecolor": "none"}
    figure.text(right + 0.012, 0.965, verdict, fontsize=20, weight="bold", color="white", va="center", bbox=chip)
    reasons = textwrap.fill(textwrap.shorten("; ".join(result["reasons"]), 300, placeholder=" ..."), 160)
    figure.text(0.02, 0.938, reasons, fontsize=_TEXT, color=DARK, va="top", parse_math=False)


# -- the camera's frame (Fig. 5) -----------------------------------------------------------------------------------------


def _draw_frame(axes: Axes, cell: CellConfig, image: Image, feature: Array, shown: CaptureRecord) -> None:
    """The board with the two circles, in px from the principal point."""
    centre = cell.camera.intrinsics.principal_point
    corners = np.array(shown.corners if shown.corners is not None else [feature]) - centre
    middle = (corners.max(axis=0) + corners.min(axis=0)) / 2
    half = 1.1 * max(np.ptp(corners, axis=0).max(), 100.0)
