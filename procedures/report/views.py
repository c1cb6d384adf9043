"""Pictures of what came of photographs with flange poses: where corners are off, and in which views."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dualcal_hal.camera import Image
from dualcal_hal.session.files import write_atomically
from dualcal_hal.session.views_result import ViewResult, ViewsResult
from dualcal_hal.transforms import Array
from procedures.report.style import BLUE, DARK, GREEN, GREY, ORANGE, RED, TEXT, head, label

if TYPE_CHECKING:  # matplotlib takes a good part of a second to import
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIZE_PX = (1600, 1200)
MOST_SHOWN = 20
"""Views of which the image is drawn: the worst."""

_DPI = 100
_VERDICT = {"ok": GREEN, "fail": RED}
_ARROW = 0.04  # of an image's width, for a typical residual
_STEPS = (
    ("given", "as given"),
    ("lens_free", "lens left to\nthe images"),
    ("poses_free", "and the arm's\nposes"),
    ("corners_free", "and the places\nof corners"),
)


def draw_residuals(path: Path, result: ViewsResult) -> None:
    """Write the residuals of all views as a PNG of ``SIZE_PX``, all of it or nothing."""
    _write(path, residuals_figure(result))


def draw_views(path: Path, result: ViewsResult, images: Sequence[Image]) -> None:
    """Write the images (height, width) of the views, in their order, with their residuals, likewise."""
    _write(path, views_figure(result, images))


def _write(path: Path, figure: Figure) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    png = io.BytesIO()
    FigureCanvasAgg(figure).print_png(png)  # type: ignore[no-untyped-call]
    write_atomically(path, png.getvalue())


def _figure(result: ViewsResult, words: str) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(SIZE_PX[0] / _DPI, SIZE_PX[1] / _DPI), dpi=_DPI, facecolor="white")
    # A dollar sign in a name begins no formula.
    large: dict[str, Any] = {"fontsize": 20, "weight": "bold", "va": "center", "parse_math": False}
    camera, target = result.transforms
    text = figure.text(0.02, 0.965, f"{camera}, {target}  |  verdict", color=DARK, **large)
    right = text.get_window_extent().x1 / SIZE_PX[0]
    patch = {"boxstyle": "round,pad=0.3", "facecolor": _VERDICT.get(result.verdict, ORANGE), "edgecolor": "none"}
    figure.text(right + 0.015, 0.965, result.verdict, color="white", bbox=patch, **large)
    filled = textwrap.fill(textwrap.shorten(words, 640, placeholder=" ..."), 165)
    figure.text(0.02, 0.937, filled, fontsize=TEXT, color=DARK, va="top", parse_math=False)
    return figure


# -- residuals ---------------------------------------------------------------------------------------------------------


def residuals_figure(result: ViewsResult) -> Figure:
    """The figure that :func:`draw_residuals` writes."""
    figure = _figure(result, "; ".join(result.reasons))
    grid = figure.add_gridspec(2, 2, left=0.055, right=0.985, bottom=0.085, top=0.79, wspace=0.15, hspace=0.52)
    _draw_over_image(figure.add_subplot(grid[0, 0]), result)
    _draw_cloud(figure.add_subplot(grid[0, 1]), result)
    _draw_by_view(figure.add_subplot(grid[1, 0]), result)
    _draw_breakdown(figure.add_subplot(grid[1, 1]), result)
    return figure


def _draw_over_image(axes: Axes, result: ViewsResult) -> None:
    width, height = result.intrinsics.size
    times = _magnified(result)
    for view in result.used:
        _arrows(axes, view, times, BLUE, 0.0035)
    axes.plot(*result.intrinsics.principal_point, "+", color=RED, markersize=14, markeredgewidth=2)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    axes.plot([], [], "-", color=BLUE, linewidth=2, label=f"from a corner to where the estimate puts it, {times:g} x")
    axes.plot([], [], "+", color=RED, markersize=11, markeredgewidth=2, linestyle="none", label="principal point")
    label(axes, "u, px", "v, px")
    head(axes, "Residuals over the image, all views")


def _draw_cloud(axes: Axes, result: ViewsResult) -> None:
    from matplotlib.patches import Circle

    residuals = np.concatenate([view.residuals[np.isfinite(view.residuals[:, 0])] for view in result.used])
    half = 1.15 * float(np.abs(residuals).max())
    axes.plot(*residuals.T, ".", color=BLUE, markersize=5, label=f"{len(residuals)} corners")
    axes.add_patch(Circle((0, 0), result.rms, fill=False, edgecolor=ORANGE, linewidth=2.5))
    axes.plot([], [], "-", color=ORANGE, linewidth=2.5, label=f"rms per axis {result.rms:.2g} px")
    noise = result.residue.corners_free
    if noise is not None:
        axes.add_patch(Circle((0, 0), noise, fill=False, edgecolor=RED, linewidth=2.5))
        axes.plot([], [], "-", color=RED, linewidth=2.5, label=f"the corners' own noise {noise:.2g} px")
    axes.set(xlim=(-half, half), ylim=(half, -half), aspect="equal")
    axes.grid(True, color="#E3E5E8", linewidth=0.8)
    axes.set_axisbelow(True)
    label(axes, "u, px", "v, px")
    head(axes, "Residuals of all corners")


def _draw_by_view(axes: Axes, result: ViewsResult) -> None:
    shown = [view for view in result.views if view.seen]
    number = np.arange(len(shown))
    attempt = result.attempts[result.poses]
    at_foot = axes.get_xaxis_transform()
    for offset, values, colour, words in (
        (-0.2, [view.rms for view in shown], BLUE, f"residual, {attempt.rms:.2g} px rms over all"),
        (0.2, [view.left_out_px for view in shown], ORANGE, f"left out, {attempt.left_out_px:.2g} px"),
    ):
        axes.bar(number + offset, values, 0.38, color=colour, label=words)
    for k, view in enumerate(shown):
        if len(shown) <= MOST_SHOWN:
            axes.annotate(
                f"{1e3 * view.left_out:.3g}", (k + 0.2, view.left_out_px), ha="center", va="bottom", fontsize=9
            )
        if not view.used:
            axes.plot(k, 0, "x", color=RED, markersize=10, markeredgewidth=2.5, clip_on=False, transform=at_foot)
    if len(shown) <= MOST_SHOWN:
        axes.plot([], [], " ", label="numbers: left out, mm at the target")
    if any(not view.used for view in shown):
        axes.plot([], [], "x", color=RED, markeredgewidth=2.5, linestyle="none", label="not used")
        axes.set_yscale("log")
    step = max(1, len(shown) // MOST_SHOWN)
    axes.set_xticks(number[::step], [_tick(view.name) for view in shown[::step]], rotation=45, ha="right")
    axes.spines[["top", "right"]].set_visible(False)
    label(axes, "", "px, rms per axis")
    head(axes, "Views: residual, and predicted without the view")


def _tick(name: str) -> str:
    short = Path(name).stem
    return (short if len(short) <= 12 else f"...{short[-10:]}").replace("$", r"\$")


def _draw_breakdown(axes: Axes, result: ViewsResult) -> None:
    steps = [(words, getattr(result.residue, name)) for name, words in _STEPS]
    told = [(words, value) for words, value in steps if value is not None]
    number = np.arange(len(told))
    axes.bar(number, [value for _, value in told], 0.6, color=[GREY] * (len(told) - 1) + [GREEN])
    for k, (_, value) in enumerate(told):
        axes.annotate(f"{value:.2g} px", (k, value), ha="center", va="bottom", fontsize=TEXT)
    axes.set_xticks(number, [words for words, _ in told])
    axes.margins(y=0.12)
    axes.spines[["top", "right"]].set_visible(False)
    label(axes, "", "sigma of a corner, px per axis")
    axes.set_title("Where residuals come from", loc="left", fontsize=TEXT + 3, weight="bold", color=DARK, pad=46)
    note = "what goes from bar to bar is what lens, arm and board add (in squares)"
    axes.text(0.0, 1.02, note, transform=axes.transAxes, fontsize=TEXT - 0.5, color=DARK)


# -- views -------------------------------------------------------------------------------------------------------------


def views_figure(result: ViewsResult, images: Sequence[Image]) -> Figure:
    """The figure that :func:`draw_views` writes."""
    times = _magnified(result)
    pairs = sorted(zip(result.views, images, strict=True), key=lambda pair: -_badness(pair[0]))[:MOST_SHOWN]
    chosen = {view.name for view, _ in pairs}
    shown = [pair for pair in zip(result.views, images, strict=True) if pair[0].name in chosen]
    some = f", the {MOST_SHOWN} worst of {len(result.views)}" if len(result.views) > MOST_SHOWN else ""
    figure = _figure(
        result,
        f"Views{some}: from each corner (dot) to where the estimate puts it, {times:g} times as long as it is."
        + (" In orange: views that were not used." if any(not view.used for view, _ in shown) else ""),
    )
    columns = int(np.ceil(np.sqrt(len(shown) * 1.05)))
    rows = int(np.ceil(len(shown) / columns))
    grid = figure.add_gridspec(rows, columns, left=0.015, right=0.985, bottom=0.015, top=0.885, wspace=0.04, hspace=0.1)
    for place, (view, image) in enumerate(shown):
        _draw_view(figure.add_subplot(grid[place // columns, place % columns]), view, image, times)
    return figure


def _badness(view: ViewResult) -> float:
    return view.rms if view.seen else np.inf


def _draw_view(axes: Axes, view: ViewResult, image: Image, times: float) -> None:
    colour = GREEN if view.used else ORANGE
    axes.imshow(image, cmap="gray", vmin=0, vmax=255)
    if view.seen:
        _arrows(axes, view, times, colour, 0.007)
        axes.plot(*view.corners.T, ".", color=colour, markersize=3)
        left, top, right, bottom = _around(view.corners, image.shape)
        axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.set_xticks([])
    axes.set_yticks([])
    said = f"{view.rms:.2f} px" if view.used else "not used"
    axes.set_title(
        f"{_tick(view.name)}  {said}", loc="left", fontsize=TEXT - 1, color=DARK if view.used else RED, pad=3
    )


def _around(corners: Array, shape: tuple[int, ...]) -> tuple[float, float, float, float]:
    """The part of the image with the corners in its middle, of the image's shape: left, top, right, bottom, px."""
    height, width = shape[:2]
    low, high = np.nanmin(corners, axis=0), np.nanmax(corners, axis=0)
    part = min(1.0, 1.7 * float(max((high[0] - low[0]) / width, (high[1] - low[1]) / height)))
    size = part * np.array([width, height])
    start = np.clip((low + high - size) / 2, -0.5, np.array([width, height]) - 0.5 - size)
    return float(start[0]), float(start[1]), float(start[0] + size[0]), float(start[1] + size[1])


def _arrows(axes: Axes, view: ViewResult, times: float, colour: str, width: float) -> None:
    """width: of an arrow, in parts of the panel's."""
    seen = np.isfinite(view.residuals[:, 0]) & np.isfinite(view.corners[:, 0])
    (u, v), (du, dv) = view.corners[seen].T, times * view.residuals[seen].T
    axes.quiver(u, v, du, dv, angles="xy", scale_units="xy", scale=1, color=colour, width=width, headwidth=3.5)


def _magnified(result: ViewsResult) -> float:
    """A round number that makes typical residuals visible."""
    wanted = _ARROW * result.intrinsics.size[0] / max(result.rms, 1e-6)
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(max(1.0, power * max(step for step in (1, 2, 5) if step * power <= wanted)))
