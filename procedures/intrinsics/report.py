"""Tables and the picture of a run for the camera."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from dualcal_hal.session.files import write_atomically
from procedures.intrinsics.coverage import GRID, LEAST_SHARE, LEAST_TILT
from procedures.intrinsics.estimate import NAMES, parameters
from procedures.intrinsics.result import IntrinsicsResult
from procedures.report.style import BLUE, DARK, GREEN, GREY, ORANGE, RED, TEXT, head, label

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIZE_PX = (1600, 1000)
_DPI = 100
_ARROW = 0.022  # of the image's width, that an arrow of the rms is long


def intrinsics_tables(result: IntrinsicsResult) -> Group:
    """All there is to say: the parameters, the coverage, and what was left out or is missing."""
    parts: list[RenderableType] = [_parameter_table(result), _coverage_text(result), _outcome(result)]
    return Group(*parts)


def _parameter_table(result: IntrinsicsResult) -> Table:
    found = result.estimate
    table = Table(
        title=Text("Camera"), box=box.SIMPLE_HEAD, title_justify="left", caption_justify="left", pad_edge=False
    )
    for number, header in enumerate(("", "unit", "cell file", "found", "sigma")):
        table.add_column(header, justify="left" if number < 2 else "right")
    before, after = parameters(result.before), parameters(found.intrinsics)
    for i, name in enumerate(NAMES):
        digits = 2 if i < 4 else 5
        value = "0 (not told)" if name in found.fixed else f"{after[i]:z.{digits}f}"
        sigma = f"{found.sigma[i]:.{digits}f}"
        table.add_row(name, "px" if i < 4 else "", f"{before[i]:z.{digits}f}", value, sigma)
    if found.fixed:
        table.caption = Text("not told: within its sigma nothing tells it from zero, at which it is held.")
    return table


def _coverage_text(result: IntrinsicsResult) -> Text:
    found, coverage = result.estimate, result.coverage
    worst = int(np.nanargmax(np.where(found.used, found.view_rms, np.nan)))
    about_x, about_y = coverage.tilted
    names = [name for name, reached in zip(("left", "right", "top", "bottom"), coverage.edges, strict=True) if reached]
    return Text(
        f"{int(found.used.sum())} views, {found.rms:.4f} px rms per axis, the worst view {result.names[worst]} "
        f"{found.view_rms[worst]:.4f} px\n"
        f"corners in {coverage.share:.0%} of {GRID[0]} x {GRID[1]} cells, in the outer tenth at: "
        f"{', '.join(names) or 'none of the edges'}; out to {coverage.radius:.0%} of the farthest pixel\n"
        f"tilted by {np.rad2deg(LEAST_TILT):.0f} deg or more: {about_x} views about the image's horizontal axis, "
        f"{about_y} about the vertical"
    )


def _outcome(result: IntrinsicsResult) -> Text:
    style = "bold red" if result.reasons else "bold green"
    text = Text.assemble("Verdict: ", (result.verdict, style))
    for reason in result.reasons:
        text.append(f"\n  {reason}")
    for name, used, rms in zip(result.names, result.estimate.used, result.estimate.view_rms, strict=True):
        if not used:
            why = f"{rms:.2f} px rms" if np.isfinite(rms) else "too few corners"
            text.append(f"\n  left out {name}: {why}")
    return text


# -- picture -----------------------------------------------------------------------------------------------------------


def draw_intrinsics(path: Path, name: str, result: IntrinsicsResult) -> None:
    """Write the picture of a run for the cell ``name`` as a PNG of ``SIZE_PX``, all of it or nothing."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    png = io.BytesIO()
    FigureCanvasAgg(intrinsics_figure(name, result)).print_png(png)  # type: ignore[no-untyped-call]
    write_atomically(path, png.getvalue())


def intrinsics_figure(name: str, result: IntrinsicsResult) -> Figure:
    """Coverage of the image with the residuals, the residuals of each view, and by their distance from the centre."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(SIZE_PX[0] / _DPI, SIZE_PX[1] / _DPI), dpi=_DPI, facecolor="white")
    grid = figure.add_gridspec(
        2, 2, left=0.05, right=0.985, bottom=0.065, top=0.845, wspace=0.14, hspace=0.5, width_ratios=[1.65, 1]
    )
    colour = RED if result.reasons else GREEN
    large: dict[str, Any] = {"fontsize": 20, "weight": "bold", "va": "center", "parse_math": False}
    text = figure.text(0.02, 0.96, f"{name}  |  intrinsics  |  verdict", color=DARK, **large)
    right = text.get_window_extent().x1 / SIZE_PX[0]
    patch = {"boxstyle": "round,pad=0.3", "facecolor": colour, "edgecolor": "none"}
    figure.text(right + 0.015, 0.96, result.verdict, color="white", bbox=patch, **large)
    _draw_image(figure.add_subplot(grid[:, 0]), result)
    _draw_views(figure.add_subplot(grid[0, 1]), result)
    _draw_radii(figure.add_subplot(grid[1, 1]), result)
    return figure


def _draw_image(axes: Axes, result: IntrinsicsResult) -> None:
    from matplotlib.patches import Rectangle

    found, coverage = result.estimate, result.coverage
    width, height = found.intrinsics.size
    step_u, step_v = width / GRID[0], height / GRID[1]
    for (row, column), count in np.ndenumerate(coverage.cells):
        corner = column * step_u - 0.5, row * step_v - 0.5
        face = "#F3D9D0" if count == 0 else "#EEF2F6"
        axes.add_patch(Rectangle(corner, step_u, step_v, facecolor=face, edgecolor="#C9CED6", linewidth=0.8))
        axes.text(corner[0] + 6, corner[1] + 8, str(count), fontsize=TEXT - 2, color=GREY, va="top")
    pixels = result.corners[found.used].reshape(-1, 2)
    residuals = found.residuals[found.used].reshape(-1, 2)
    seen = np.isfinite(residuals[:, 0])
    scale = _ARROW * width / found.rms
    u, v = pixels[seen].T
    du, dv = scale * residuals[seen].T
    axes.plot(u, v, ".", color=BLUE, markersize=3, label="corners")
    axes.quiver(
        u, v, du, dv, angles="xy", scale_units="xy", scale=1.0, color=ORANGE, width=0.0016, headwidth=3.5, headlength=4
    )
    axes.plot([], [], "-", color=ORANGE, label=f"residuals, x {scale:.0f}")
    for centre, marker, colour, words in (
        (result.before.principal_point, "x", RED, "principal point of the cell file"),
        (found.intrinsics.principal_point, "+", GREEN, "as found"),
    ):
        axes.plot(*centre, marker, color=colour, markersize=14, markeredgewidth=3, label=words)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    label(axes, "u, px", "v, px")
    share = f"{coverage.share:.0%} of the cells hold corners, {LEAST_SHARE:.0%} are needed"
    head(axes, f"Coverage: {share}")


def _draw_views(axes: Axes, result: IntrinsicsResult) -> None:
    found = result.estimate
    number = np.arange(1, len(result.names) + 1)
    rms = np.nan_to_num(found.view_rms)
    axes.bar(number[found.used], rms[found.used], color=BLUE, label="used")
    if not np.all(found.used):
        axes.bar(number[~found.used], rms[~found.used], color=RED, label="left out")
    axes.axhline(found.rms, color=DARK, linestyle="--", linewidth=1.5, label=f"all used: {found.rms:.4f} px")
    axes.spines[["top", "right"]].set_visible(False)
    label(axes, "view", "rms per axis, px")
    head(axes, "Residuals of each view")


def _draw_radii(axes: Axes, result: IntrinsicsResult) -> None:
    """Outwards from the principal point: what a wrong model of the lens leaves has a shape there."""
    found = result.estimate
    pixels = result.corners[found.used].reshape(-1, 2)
    residuals = found.residuals[found.used].reshape(-1, 2)
    seen = np.isfinite(residuals[:, 0])
    from_centre = pixels[seen] - found.intrinsics.principal_point
    radius = np.linalg.norm(from_centre, axis=1)
    outwards = np.sum(residuals[seen] * from_centre, axis=1) / np.maximum(radius, 1e-9)
    axes.plot(radius, outwards, ".", color=BLUE, markersize=4, label="corners")
    edges = np.linspace(0.0, radius.max() + 1e-9, 11)
    which = np.digitize(radius, edges) - 1
    filled = [i for i in range(10) if np.sum(which == i) >= 5]
    middles = [(edges[i] + edges[i + 1]) / 2 for i in filled]
    axes.plot(middles, [outwards[which == i].mean() for i in filled], "o-", color=RED, label="means of tenths")
    axes.axhline(0.0, color=GREY, linewidth=1)
    axes.spines[["top", "right"]].set_visible(False)
    label(axes, "distance from the principal point, px", "residual outwards, px")
    head(axes, "Residuals along the radius")
