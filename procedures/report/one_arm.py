"""``summary.png`` of a cell with one arm: what the camera saw, how far views are off, and where all of it is."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dualcal_hal.camera import Image
from dualcal_hal.config import OneArmConfig
from dualcal_hal.session.captures import CaptureRecord
from dualcal_hal.session.files import write_atomically
from dualcal_hal.session.one_arm_result import OneArmResult, VerifiedViewRecord
from dualcal_hal.transforms import apply, inverse
from procedures.report.scene import arm_course
from procedures.report.style import BLUE, DARK, GREEN, ORANGE, RED, TEXT, head, host, label

if TYPE_CHECKING:  # matplotlib takes a good part of a second to import
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

SIZE_PX = (1600, 1200)
_DPI = 100
_VERDICT = {"ok": GREEN, "fail": RED}
_ARROW_PX = 40.0  # that the largest residual is drawn as
_AXIS = 0.06  # m, of a frame


def draw_one_arm(
    path: Path, config: OneArmConfig, captures: Sequence[CaptureRecord], result: OneArmResult, image: Image | None
) -> None:
    """Write the picture of a run as a PNG of ``SIZE_PX``, all of it or nothing.

    image: (height, width), what the camera saw at the first of the captures, None where that is lost.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    png = io.BytesIO()
    FigureCanvasAgg(one_arm_figure(config, captures, result, image)).print_png(png)  # type: ignore[no-untyped-call]
    write_atomically(path, png.getvalue())


def one_arm_figure(
    config: OneArmConfig, captures: Sequence[CaptureRecord], result: OneArmResult, image: Image | None
) -> Figure:
    """The figure that :func:`draw_one_arm` writes, from the same parameters."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(SIZE_PX[0] / _DPI, SIZE_PX[1] / _DPI), dpi=_DPI, facecolor="white")
    grid = figure.add_gridspec(2, 2, left=0.06, right=0.985, bottom=0.06, top=0.825, wspace=0.16, hspace=0.40)
    _write_head(figure, config, result)
    _draw_image(figure.add_subplot(grid[0, 0]), config, captures[0], image)
    _draw_residuals(figure.add_subplot(grid[0, 1]), config, captures, result)
    _draw_errors(figure.add_subplot(grid[1, 0]), result)
    _draw_scene(figure, grid[1, 1], config, captures, result)
    return figure


def _write_head(figure: Figure, config: OneArmConfig, result: OneArmResult) -> None:
    # A dollar sign in a name or a reason begins no formula.
    large: dict[str, Any] = {"fontsize": 20, "weight": "bold", "va": "center", "parse_math": False}
    text = figure.text(0.02, 0.965, f"{config.name}  |  {result.placement}  |  verdict", color=DARK, **large)
    right = text.get_window_extent().x1 / SIZE_PX[0]
    patch = {"boxstyle": "round,pad=0.3", "facecolor": _VERDICT.get(result.verdict, ORANGE), "edgecolor": "none"}
    figure.text(right + 0.015, 0.965, result.verdict, color="white", bbox=patch, **large)
    reasons = textwrap.fill(textwrap.shorten("; ".join(result.reasons), 420, placeholder=" ..."), 160)
    figure.text(0.02, 0.940, reasons, fontsize=TEXT, color=DARK, va="top", parse_math=False)


def _draw_image(axes: Axes, config: OneArmConfig, shown: CaptureRecord, image: Image | None) -> None:
    width, height = config.camera.size_px
    if image is not None:
        axes.imshow(image, cmap="gray", vmin=0, vmax=255)
    corners = np.array([corner for corner in shown.corners or () if corner])
    axes.plot(*corners.T, ".", color=BLUE, markersize=5, label="corners")
    axes.plot(
        *shown.feature, "o", color=GREEN, fillstyle="none", markersize=12, markeredgewidth=2, label="feature point"
    )
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    label(axes, f"u, px   (view {shown.id})", "v, px")
    head(axes, "What the camera saw")


def _draw_residuals(axes: Axes, config: OneArmConfig, captures: Sequence[CaptureRecord], result: OneArmResult) -> None:
    """All corners where they were seen, with what is between them and the estimate, many times as large."""
    width, height = config.camera.size_px
    seen = {capture.id: capture.corners or () for capture in captures}
    residuals: dict[str, Sequence[tuple[float, float] | None]] = {
        "estimated from": [r for view in result.views if view.used for r in view.residuals_px],
        "verified": [r for view in _proved(result) for r in view.residuals_px],
    }
    places = {
        "estimated from": [c for view in result.views if view.used for c in seen[view.id]],
        "verified": [c for view in _proved(result) for c in seen[view.id]],
    }
    largest = max((float(np.hypot(*r)) for each in residuals.values() for r in each if r is not None), default=1.0)
    scale = _ARROW_PX / max(largest, 1e-9)
    for words, colour in (("estimated from", BLUE), ("verified", ORANGE)):
        pairs = [(c, r) for c, r in zip(places[words], residuals[words], strict=True) if c and r]
        if pairs:
            at, off = np.array([c for c, _ in pairs]), np.array([r for _, r in pairs])
            axes.quiver(
                *at.T, *(scale * off).T, color=colour, angles="xy", scale_units="xy", scale=1, width=0.002, label=words
            )
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal")
    axes.set_facecolor("#F4F5F6")
    label(axes, f"u, px   (arrows {scale:.0f} times as long)", "v, px")
    head(axes, f"Residuals: at most {largest:.3f} px")


def _proved(result: OneArmResult) -> Sequence[VerifiedViewRecord]:
    return () if result.verification is None else result.verification.views


def _draw_errors(axes: Axes, result: OneArmResult) -> None:
    from matplotlib.ticker import MaxNLocator

    used = [view for view in result.views if view.used]
    dropped = [view for view in result.views if not view.used]
    numbers = iter(range(1, 1 + len(result.views) + len(_proved(result))))
    for words, offs, marker, colour in (
        ("by the others, estimated from", [view.left_out for view in used], "o", BLUE),
        ("by the others, dropped", [view.left_out for view in dropped], "x", RED),
        ("verified", [view.off for view in _proved(result)], "s", ORANGE),
    ):
        if offs:
            # A view whose target should be behind the camera is as far off as none can be shown.
            values = [np.nan if off is None else off.rms_mm for off in offs]
            axes.semilogy([next(numbers) for _ in values], values, marker, color=colour, markersize=8, label=words)
    required = result.predicted_error.required_mm
    axes.axhline(required, color=RED, linewidth=2, label=f"accuracy required: {required:g} mm")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(True, which="major", color="#E3E5E8", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    label(axes, "view", "corners from their prediction, mm rms")
    head(axes, "Each view, predicted without itself")


def _draw_scene(
    figure: Figure,
    place: SubplotSpec,
    config: OneArmConfig,
    captures: Sequence[CaptureRecord],
    result: OneArmResult,
) -> None:
    """Everything in the arm's base, mm, placed by the transforms found; the arm as at the first capture."""
    panel = host(figure, place)
    box = place.get_position(figure)
    axes: Any = figure.add_axes(
        (box.x0 - 0.05, box.y0 - 0.06, box.width + 0.08, box.height + 0.09), projection="3d", zorder=-1
    )
    axes.patch.set_visible(False)
    camera, target = (found.T for found in result.transforms.values())
    joints = [capture.active_joints or capture.passive_joints for capture in captures]
    flanges = config.arm.chain.forward(np.array(joints))
    cameras = flanges @ camera if config.camera_on_arm else camera[None]
    targets = target[None] if config.camera_on_arm else flanges @ target
    x, y, z = 1e3 * arm_course(config.arm.chain, joints[0]).T
    axes.plot(x, y, z, color=DARK, linewidth=4, marker="o", markersize=5, label=f"'{config.arm_name}'")
    outline = config.target.board.outline[[0, 1, 2, 3, 0]]
    for number, T in enumerate(targets):
        x, y, z = 1e3 * apply(T, outline).T
        axes.plot(x, y, z, color=BLUE, linewidth=1.5, label="target" if number == 0 else None)
    for number, T in enumerate(cameras):
        x, y, z = 1e3 * apply(T, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, _AXIS]])).T
        axes.plot(x, y, z, color=ORANGE, linewidth=2, marker="s", markersize=4, markevery=[0], label=_first(number))
    middle = (inverse(cameras) @ targets)[:, :3, 3]
    sight = apply(cameras[0], middle[:1])[0], cameras[0][:3, 3]
    x, y, z = 1e3 * np.array(sight).T
    axes.plot(x, y, z, color=GREEN, linewidth=1.2, label="line of sight of the first")
    axes.set_aspect("equal")
    axes.view_init(elev=22, azim=-72)
    head(panel, "Cell in the arm's base, mm", axes)


def _first(number: int) -> str | None:
    return "camera, along its axis" if number == 0 else None
