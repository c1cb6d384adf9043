"""``plan.png``: the arms where they begin, among what stands about them, the planned axes and positions.

From the side and from above. With one arm what the other would carry stands by itself.
"""

from __future__ import annotations

import io
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dualcal_hal.config import CellConfig, RobotConfig
from dualcal_hal.geometry import Block, Cylinder, HalfSpace, Mesh, Solid
from dualcal_hal.session.files import write_atomically
from dualcal_hal.transforms import Array, apply
from procedures.planning.model import Posture
from procedures.planning.plan import Plan, PlannedConstraint
from procedures.report.scene import arm_course, feature_point, field_of_view
from procedures.report.style import BLUE, DARK, GREEN, GREY, ORANGE, TEXT, head, label

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIZE_PX = (1600, 900)
_DPI = 100
_BEYOND = 1.08  # how far an axis is drawn, of the distance to its farthest position
_BEHIND = 0.03  # m behind a camera where the number of its axis is
_BESIDE = np.array([0.0, 0.02, 0.02])  # m beside a position where its number is
_PLANE = 0.4  # m to each side of a plane's origin that is drawn, and of a base's on the floor
_ROUND = np.linspace(0.0, 2 * np.pi, 33)
_USES = {"calibration": (BLUE, "o"), "verification": (GREEN, "s")}


def draw_plan(path: Path, cell: CellConfig, arms: Posture, plan: Plan | None) -> None:
    """Write the picture as a PNG of ``SIZE_PX``, all of it or nothing; everything is placed by the nominal transforms.

    arms: where the arms are drawn; plan: None where there is none.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    png = io.BytesIO()
    FigureCanvasAgg(plan_figure(cell, arms, plan)).print_png(png)  # type: ignore[no-untyped-call]
    write_atomically(path, png.getvalue())


def plan_figure(cell: CellConfig, arms: Posture, plan: Plan | None) -> Figure:
    """The figure that :func:`draw_plan` writes, from the same parameters."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(SIZE_PX[0] / _DPI, SIZE_PX[1] / _DPI), dpi=_DPI, facecolor="white")
    along, across = _level_directions(cell)
    up = np.array([0.0, 0.0, 1.0])
    panels = figure.subplots(
        1, 2, gridspec_kw={"left": 0.06, "right": 0.985, "bottom": 0.08, "top": 0.76, "wspace": 0.16}
    )
    for axes, title, view, vertical in (
        (panels[0], "From the side", np.array([along, up]), "height, mm"),
        (panels[1], "From above", np.array([along, across]), "to the side, mm"),
    ):
        _draw_surroundings(axes, cell, view)
        _draw_arms(axes, cell, arms, view)
        for constraint in () if plan is None else plan.constraints:
            _draw_constraint(axes, cell, constraint, view)
        _finish(axes, _along(cell), vertical)
        head(axes, title)
    _write_head(figure, cell, plan)
    return figure


def _level_directions(cell: CellConfig) -> tuple[Array, Array]:
    """Level directions (3,) in P: towards the active base, and to the left of that."""
    toward = cell.nominal.T_P_A[:3, 3] * [1.0, 1.0, 0.0]
    along = toward / np.linalg.norm(toward) if np.any(np.abs(toward) > 1e-6) else np.array([1.0, 0.0, 0.0])
    return along, np.cross([0.0, 0.0, 1.0], along)


def _along(cell: CellConfig) -> str:
    if _stands(cell.passive):
        return f"ahead of '{cell.active_name}', mm"
    return f"from '{cell.passive_name}' towards {'the camera' if _stands(cell.active) else repr(cell.active_name)}, mm"


def _stands(robot: RobotConfig) -> bool:
    """Whether there is no such arm, and what it would carry stands."""
    return robot.chain.joints == 0


def _draw_surroundings(axes: Axes, cell: CellConfig, view: Array) -> None:
    """Fixtures as the outlines of their convex hulls, with their names, and from the side the floor under each arm."""
    bases = {"passive_base": np.eye(4), "active_base": cell.nominal.T_P_A}
    if cell.floor is not None and view[1, 2]:
        for T_P_base in _bases_of_arms(cell):
            floor = _outline(1e3 * apply(T_P_base, _points_of(HalfSpace()) + [0.0, 0.0, cell.floor]) @ view.T)
            axes.plot(*floor.T, color=GREY, linewidth=1.5, linestyle="--")
            x, y = floor[np.argmax(floor[:, 0])]
            axes.text(x, y, "floor", fontsize=TEXT - 1, color=GREY, ha="right", va="top")
    for name, fixture in cell.fixtures.items():
        outline = _outline(1e3 * apply(bases[fixture.base] @ fixture.T, _points_of(fixture.solid)) @ view.T)
        axes.fill(*outline.T, facecolor=GREY, edgecolor=DARK, alpha=0.35, linewidth=1.5)
        x, y = (outline.min(axis=0) + outline.max(axis=0)) / 2
        axes.text(x, y, name, fontsize=TEXT - 1, color=DARK, ha="center", va="center", parse_math=False)


def _bases_of_arms(cell: CellConfig) -> list[Array]:
    """(4, 4) each, in P."""
    bases = ((cell.passive, np.eye(4)), (cell.active, cell.nominal.T_P_A))
    return [T_P_base for robot, T_P_base in bases if not _stands(robot)]


def _points_of(solid: Solid) -> Array:
    """Points (k, 3) in the solid's frame, m, of which its convex hull is drawn; of a plane a part about its origin."""
    if isinstance(solid, Mesh):
        return np.reshape(solid.corners, (-1, 3))
    if isinstance(solid, Cylinder):
        circle = solid.radius * np.stack([np.cos(_ROUND), np.sin(_ROUND), np.zeros_like(_ROUND)], axis=1)
        return np.concatenate([circle + [0.0, 0.0, z] for z in (-solid.length / 2, solid.length / 2)])
    half = solid.sizes / 2 if isinstance(solid, Block) else np.array([_PLANE, _PLANE, 0.0])
    return np.asarray(half * list(itertools.product([-1.0, 1.0], repeat=3)))


def _outline(points: Array) -> Array:
    """The convex hull (m, 2) of points (k, 2), its first point again at the end; of points on a line its two ends."""
    from scipy.spatial import ConvexHull

    from_middle = points - points.mean(axis=0)
    _, size, axes = np.linalg.svd(from_middle, full_matrices=False)
    if size[1] < 1e-6 * size[0]:
        along = from_middle @ axes[0]
        return np.asarray(points[[np.argmin(along), np.argmax(along)]])
    corners = ConvexHull(points).vertices
    return np.asarray(points[[*corners, corners[0]]])


def _draw_arms(axes: Axes, cell: CellConfig, arms: Posture, view: Array) -> None:
    T_P_A = cell.nominal.T_P_A
    T_P_E = T_P_A @ cell.active.chain.forward(arms.active) @ cell.nominal.T_H_E
    T_P_T = cell.passive.chain.forward(arms.passive) @ cell.passive.target_mount_transform
    active = apply(T_P_A, arm_course(cell.active.chain, arms.active))
    passive = arm_course(cell.passive.chain, arms.passive)
    camera = apply(T_P_E, field_of_view(cell))
    target = apply(T_P_T, cell.target.board.outline[[0, 1, 2, 3, 0]])
    for robot, name, course, what, tool, colour in (
        (cell.active, cell.active_name, active, "camera", camera, ORANGE),
        (cell.passive, cell.passive_name, passive, "target", target, DARK),
    ):
        if _stands(robot):
            _line(axes, tool, view, color=colour, linewidth=2, label=f"the {what}, which stands")
            continue
        words = f"'{name}' with the {what}"
        _line(axes, course, view, color=colour, linewidth=6, alpha=0.85, solid_joinstyle="round", label=words)
        _line(axes, np.vstack([course[-1], tool]), view, color=colour, linewidth=2)


def _draw_constraint(axes: Axes, cell: CellConfig, constraint: PlannedConstraint, view: Array) -> None:
    colour, marker = _USES[constraint.use]
    T_P_E = cell.nominal.T_P_A @ cell.active.chain.forward(constraint.active) @ cell.nominal.T_H_E
    camera, axis = T_P_E[:3, 3], T_P_E[:3, 2]
    farthest = _BEYOND * max(position.distance for position in constraint.positions)
    points = np.array([feature_point(cell, position.passive) for position in constraint.positions])
    first = constraint.name.endswith("/00")
    words = f"{constraint.use}: axis from the camera, positions" if first else None
    _line(axes, np.array([camera, camera + farthest * axis]), view, color=colour, linewidth=1.3)
    _line(axes, points, view, color=colour, linestyle="none", marker=marker, markersize=5, label=words)
    _line(axes, camera[None], view, color=colour, linestyle="none", marker="x", markersize=8, markeredgewidth=2)
    number = constraint.name.rpartition("/")[2].lstrip("0") or "0"
    # A camera that stands sees all positions from one place: there they tell one from the other.
    x, y = 1e3 * view @ (points[0] + _BESIDE if _stands(cell.active) else camera - _BEHIND * axis)
    axes.text(x, y, number, fontsize=TEXT - 1, color=colour, weight="bold", ha="center", va="center")


def _line(axes: Axes, points: Array, view: Array, **style: object) -> None:
    axes.plot(*(1e3 * view @ points.T), **style)  # type: ignore[arg-type]


def _finish(axes: Axes, horizontal: str, vertical: str) -> None:
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.06)
    axes.grid(True, color=GREY, alpha=0.25, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    label(axes, horizontal, vertical)


def _write_head(figure: Figure, cell: CellConfig, plan: Plan | None) -> None:
    title = f"{cell.name}  |  " + (_title(cell, plan))
    figure.text(0.02, 0.955, title, fontsize=18, weight="bold", color=DARK, va="center", parse_math=False)


def _title(cell: CellConfig, plan: Plan | None) -> str:
    of_one_arm = _stands(cell.active) or _stands(cell.passive)
    if plan is None:
        return f"{'home' if of_one_arm else 'stand-off'}, no provisional plan"
    parts: Sequence[str] = [
        "provisional plan" if plan.provisional else "plan",
        f"{len(plan.constraints)} {'views' if of_one_arm else 'constraints'}",
        f"about {plan.seconds:.0f} s",
    ]
    spread = [] if plan.axis_spread is None else [f"axes spread {plan.axis_spread:.3f}"]
    return ", ".join([*parts, *spread])
