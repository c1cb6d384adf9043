"""The panel with the camera's frame and the two circles (Fig. 5), and the offsets of all captures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from dualcal_hal.camera import Image
from dualcal_hal.config import CellConfig
from dualcal_hal.session.captures import CaptureRecord
from dualcal_hal.transforms import Array
from procedures.report.style import BLUE, GREEN, GREY, RED, head, host, label

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

_SMALLEST_VIEW = 60.0  # px to each side of the optical axis
_AROUND_CORNERS = 2.3  # with the squares around the inner corners of a small board
_CIRCLES = (("optical axis", RED, 0.2), ("feature point", GREEN, 0.12))  # radii differ: the two should coincide


def draw_frame(
    figure: Figure,
    place: SubplotSpec,
    cell: CellConfig,
    captures: Sequence[CaptureRecord],
    image: Image | None,
    shown: CaptureRecord,
) -> None:
    """The frame of the capture ``shown`` about the optical axis, and beside it how far each capture is from it."""
    panel = host(figure, place)
    halves = place.subgridspec(1, 2, wspace=0.28)
    centre = cell.camera.intrinsics.principal_point
    _draw_board(figure.add_subplot(halves[0]), image, shown, centre)
    _draw_offsets(figure.add_subplot(halves[1]), cell, captures, shown, centre)
    for name, colour, _ in _CIRCLES:
        panel.plot([], [], "o", color=colour, fillstyle="none", markersize=11, markeredgewidth=2.5, label=name)
    panel.plot([], [], ".", color=BLUE, markersize=8, label="corners")
    panel.plot([], [], "x", color=GREY, label=f"offsets of all {len(captures)} captures")
    if cell.procedure.tolerance_px != "auto":
        panel.plot([], [], "--", color=BLUE, label=f"tolerance {cell.procedure.tolerance_px:g} px")
    du, dv = shown.feature - centre
    head(panel, f"Camera frame: offset ({du:+.3f}, {dv:+.3f}) px")


def _draw_board(axes: Axes, image: Image | None, shown: CaptureRecord, centre: Array) -> None:
    corners = np.array([corner for corner in shown.corners or () if corner] or [shown.feature]) - centre
    half = max(_SMALLEST_VIEW, _AROUND_CORNERS * float(np.abs(corners).max()))
    if image is not None:
        height, width = image.shape
        left, top = -0.5 - centre
        axes.imshow(image, cmap="gray", vmin=0, vmax=255, extent=(left, left + width, top + height, top))
    axes.plot(*corners.T, ".", color=BLUE, markersize=6)
    _draw_circles(axes, shown.feature - centre, half)
    label(axes, f"u, px   (capture {shown.id})", "v, px")


def _draw_offsets(
    axes: Axes, cell: CellConfig, captures: Sequence[CaptureRecord], shown: CaptureRecord, centre: Array
) -> None:
    from matplotlib.patches import Rectangle

    offsets = np.array([capture.feature for capture in captures]) - centre
    half = 1.3 * float(np.abs(offsets).max())
    tolerance = cell.procedure.tolerance_px
    if tolerance != "auto":
        half = max(half, 1.5 * tolerance)
        side = 2 * tolerance
        axes.add_patch(Rectangle((-tolerance, -tolerance), side, side, fill=False, edgecolor=BLUE, linestyle="--"))
    axes.plot(*offsets.T, "x", color=GREY, markersize=6)
    _draw_circles(axes, shown.feature - centre, max(half, 1e-3))
    label(axes, "u, px", "v, px")


def _draw_circles(axes: Axes, offset: Array, half: float) -> None:
    """Red about the optical axis, green about the feature point, in a view of ``half`` to each side of the axis."""
    from matplotlib.patches import Circle

    for (_, colour, radius), middle in zip(_CIRCLES, (np.zeros(2), offset), strict=True):
        u, v = middle
        circle = Circle((u, v), radius * half, fill=False, edgecolor=colour, linewidth=2.5)
        axes.add_patch(circle)
        axes.plot(u, v, "+", color=colour, markersize=9, markeredgewidth=1.8)
    axes.set(xlim=(-half, half), ylim=(half, -half), aspect="equal")
    axes.set_facecolor("#F4F5F6")
