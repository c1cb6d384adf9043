"""Panels of the picture for a refined result: the predicted 3D error of a point, and how each capture fits."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import gammaincinv

from dualcal_hal.session.accuracy import Accuracy, Error3dRecord
from dualcal_hal.session.captures import CaptureRecord
from dualcal_hal.session.result import Result
from dualcal_hal.transforms import Array
from procedures.estimation.refined.uncertainty import spatial_error
from procedures.report.style import BLUE, DARK, GREEN, GREY, RED, TEXT, head, host, label

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

_FINE = 41  # places along each side of a slice
_AROUND = 30.0  # mm, shown about region and map
_BAND = (0.025, 0.975)
_LEAST_SHOWN = (0.4, 2.5)


@dataclass(frozen=True)
class Slice:
    """A level or upright cut through the shared workspace at the middle of the region.

    axes: of P, across and upwards in the picture; at: of the third one, mm; values (k, l): predicted 3D error (95 %)
    over x (l,) and y (k,), mm.
    """

    axes: tuple[int, int]
    at: float
    x: Array
    y: Array
    values: Array

    @classmethod
    def of(cls, T_P_A: Array, accuracy: Accuracy, axes: tuple[int, int]) -> Slice:
        space = accuracy.error_3d
        region = np.array([space.region.low_mm, space.region.high_mm])
        points = np.vstack([region, space.map.points_mm]) if space.map.points_mm else region
        low, high = points.min(axis=0) - _AROUND, points.max(axis=0) + _AROUND
        (hidden,) = {0, 1, 2} - {*axes}
        x, y = (np.linspace(low[axis], high[axis], _FINE) for axis in axes)
        places = np.empty((_FINE, _FINE, 3))
        places[..., axes[0]], places[..., axes[1]] = np.meshgrid(x, y)
        places[..., hidden] = at = float(region[:, hidden].mean())
        values = 1e3 * spatial_error(T_P_A, np.array(accuracy.covariance), places / 1e3).p95
        return cls(axes, at, x, y, values)


def draw_error_map(figure: Figure, place: SubplotSpec, result: Result, accuracy: Accuracy) -> None:
    """The predicted 3D error of a point over the shared workspace, in two slices through the middle of the region."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    panel = host(figure, place)
    parts = place.subgridspec(1, 4, width_ratios=(1, 1, 0.08, 0.08), wspace=0.55)
    slices = [Slice.of(result.T_P_A, accuracy, axes) for axes in ((0, 1), (0, 2))]
    least, most = min(cut.values.min() for cut in slices), max(cut.values.max() for cut in slices)
    scale, colours = Normalize(least, most), ListedColormap(colormaps["YlGnBu"](np.linspace(0.0, 0.6, 256)))
    for column, cut in enumerate(slices):
        axes = figure.add_subplot(parts[column])
        axes.pcolormesh(cut.x, cut.y, cut.values, shading="gouraud", cmap=colours, norm=scale)
        _draw_lines(axes, cut, accuracy.error_3d)
    beside = figure.add_subplot(parts[2])
    figure.colorbar(ScalarMappable(scale, colours), cax=beside)
    label(beside, "mm", "")
    required = accuracy.error_3d.required_mm
    where = "kept all over" if required >= most else "exceeded all over"
    if least < required < most:
        where = "the red line"
        beside.axhline(required, color=RED, linewidth=4)
    at_most = f"region: at most {accuracy.error_3d.p95_mm:.2g} mm"
    panel.plot([], [], "--", color=DARK, linewidth=2, label=at_most)
    panel.plot([], [], color=RED, linewidth=3, label=f"required: {required:g} mm, {where}")
    panel.plot([], [], color=DARK, linewidth=0.9, label="error, mm")
    head(panel, "Predicted 3D error of a point (95 %)")


def _draw_lines(axes: Axes, cut: Slice, space: Error3dRecord) -> None:
    from matplotlib.patches import Rectangle
    from matplotlib.ticker import MaxNLocator

    least, most = float(cut.values.min()), float(cut.values.max())
    levels = [level for level in MaxNLocator(5).tick_values(least, most) if least < level < most]
    if levels:
        lines = axes.contour(cut.x, cut.y, cut.values, levels, colors=DARK, linewidths=0.9)
        axes.clabel(lines, fontsize=TEXT - 1, fmt="%.3g")
    if least < space.required_mm < most:
        axes.contour(cut.x, cut.y, cut.values, [space.required_mm], colors=RED, linewidths=3)
    (left, bottom), (right, top) = (
        np.array(corner)[[*cut.axes]] for corner in (space.region.low_mm, space.region.high_mm)
    )
    region = Rectangle((left, bottom), right - left, top - bottom, fill=False, edgecolor=DARK, linestyle="--")
    region.set_linewidth(2)
    axes.add_patch(region)
    axes.locator_params(nbins=5)
    across, up = ("xyz"[axis] for axis in cut.axes)
    (hidden,) = {*"xyz"} - {across, up}
    label(axes, f"{across}, mm   (at {hidden} = {cut.at:.0f} mm)", f"{up}, mm")


def draw_fit(axes: Axes, captures: Sequence[CaptureRecord], result: Result, accuracy: Accuracy) -> None:
    """Of each capture how far off it is, in units of what is expected, beside the band of 95 %."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

    number = {capture.id: index for index, capture in enumerate(captures, start=1)}
    seen = result.verification
    verified, fits = ((), False) if seen is None else (seen.captures, seen.probability >= seen.least_probability)
    for words, records, all_fit, colour, marker in (
        ("calibration", accuracy.captures, accuracy.fit.scale == 1, BLUE, "o"),
        ("verification", verified, fits, GREEN, "s"),
    ):
        if not records:
            continue
        x = np.array([number[record.id] for record in records])
        freedom = np.array([record.degrees_of_freedom for record in records])
        ratio = np.sqrt(np.array([record.chi_square for record in records]) / freedom)
        axes.semilogy(
            x, ratio, marker, color=colour, markersize=6, label=f"{words}: {'fit' if all_fit else 'do not fit'}"
        )
        low, high = (np.sqrt(2 * gammaincinv(freedom / 2, share) / freedom) for share in _BAND)
        band = "95 % of captures" if words == "calibration" else None
        axes.fill_between(x, low, high, color=GREY, alpha=0.3, linewidth=0, label=band)
    dropped = [number[rejected.id] for rejected in result.captures_rejected if rejected.id in number]
    if dropped:
        top = np.full(len(dropped), 0.97)
        words = f"left out: {len(dropped)}"
        axes.plot(dropped, top, "x", color=RED, markersize=9, transform=axes.get_xaxis_transform(), label=words)
    for before, after in itertools.pairwise(captures):
        if before.constraint != after.constraint:
            axes.axvline(number[after.id] - 0.5, color=GREY, linewidth=0.5)
    axes.axhline(1.0, color=DARK, linewidth=1)
    axes.margins(y=0.15)
    low_end, high_end = axes.get_ylim()
    axes.set_ylim(min(low_end, _LEAST_SHOWN[0]), max(high_end, _LEAST_SHOWN[1]))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.spines[["top", "right"]].set_visible(False)
    label(axes, "capture (a line between constraints)", "off by / expected (rms)")
    head(axes, "How each capture fits")
