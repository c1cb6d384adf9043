"""The panel with both arms, the optical axes, and the planned and reached positions (Figs. 3 and 6)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.config import CellConfig
from dualcal_hal.kinematics import Chain
from dualcal_hal.robot import Joints
from dualcal_hal.session.captures import CaptureRecord
from dualcal_hal.session.result import Result
from dualcal_hal.transforms import Array, apply
from procedures.planning.plan import Plan
from procedures.report.kept import Kept
from procedures.report.style import BLUE, DARK, GREEN, ORANGE, RED, TEXT, head, host

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec
    from mpl_toolkits.mplot3d.axes3d import Axes3D  # type: ignore[import-untyped]

Positions = Mapping[tuple[str, int], Array]
"""Feature points (3,) in P, m, by constraint and number of the position."""

_BEYOND = 1.1  # how far an axis is drawn, of the distance to its farthest position
_NARROW = 0.4  # of the picture's width: in such a place the labels need what the projection leaves empty
_FRUSTUM = 0.07  # m, how far the camera's field of view is drawn


def draw_scene(
    figure: Figure,
    place: SubplotSpec,
    cell: CellConfig,
    plan: Plan | None,
    captures: Sequence[CaptureRecord],
    result: Result,
    shown: CaptureRecord,
) -> None:
    """Everything in the passive base, mm, placed by the transforms found; the arms as at the capture ``shown``."""
    panel = host(figure, place)
    # The projection leaves its corners empty, so it may be larger than its place.
    box = place.get_position(figure)
    narrow = box.width < _NARROW
    right = 0.0 if narrow else 0.03
    axes = figure.add_axes(
        (box.x0 - 0.05, box.y0 - 0.06, box.width + 0.05 + right, box.height + 0.09), projection="3d", zorder=-1
    )
    axes.patch.set_visible(False)

    reached = {(c.constraint, c.position): feature_point(cell, c.passive_joints) for c in captures}
    planned = {} if plan is None else _planned(cell, plan)
    _draw_arms(axes, cell, result, shown)
    _draw_axes(axes, cell, captures, result, reached)
    if planned:
        _draw_points(axes, planned, f"planned: {len(planned)}", "none", BLUE, 80)
    _draw_points(axes, reached, f"reached: {len(reached)}", RED, RED, 14)
    _finish(axes, zoom=1.0 if narrow else 1.15)
    head(panel, _title(planned, reached), axes)


def feature_point(cell: CellConfig, joints: Joints) -> Array:
    """(3,) m in P at the passive arm's joint angles (rad)."""
    passive = cell.passive
    return np.asarray((passive.chain.forward(joints) @ passive.target_mount_transform)[:3, 3])


def _planned(cell: CellConfig, plan: Plan) -> Positions:
    return {
        (constraint.name, number): feature_point(cell, position.passive)
        for constraint in plan.constraints
        for number, position in enumerate(constraint.positions)
    }


def _title(planned: Positions, reached: Positions) -> str:
    title = "Cell in P"
    both = planned.keys() & reached.keys()
    if not both:
        return title
    off = np.mean([np.linalg.norm(planned[key] - reached[key]) for key in both])
    return f"{title}: reached {1e3 * off:.1f} mm from planned"


def _draw_points(axes: Axes3D, points: Positions, words: str, face: str, edge: str, size: float) -> None:
    x, y, z = _mm(list(points.values())).T
    axes.scatter(x, y, z, s=size, facecolors=face, edgecolors=edge, linewidths=1.6, depthshade=False, label=words)


def _draw_axes(
    axes: Axes3D, cell: CellConfig, captures: Sequence[CaptureRecord], result: Result, reached: Positions
) -> None:
    """The optical axis of each constraint, from the camera to a little beyond the farthest feature point."""
    first = {capture.constraint: capture for capture in reversed(captures)}
    for number, (constraint, capture) in enumerate(first.items()):
        T_P_E = result.T_P_A @ cell.active.chain.forward(capture.active_joints) @ result.T_H_E
        camera, axis = T_P_E[:3, 3], T_P_E[:3, 2]
        farthest = max((point - camera) @ axis for (name, _), point in reached.items() if name == constraint)
        x, y, z = _mm([camera, camera + _BEYOND * farthest * axis]).T
        words = "optical axes" if number == 0 else None
        axes.plot(x, y, z, color=GREEN, linewidth=1.4, marker="s", markersize=4, markevery=[0], label=words)


def _draw_arms(axes: Axes3D, cell: CellConfig, result: Result, shown: CaptureRecord) -> None:
    """Both arms with what they carry, as at a capture: the camera with its field of view, the target's outline."""
    T_P_E = result.T_P_A @ cell.active.chain.forward(shown.active_joints) @ result.T_H_E
    T_P_T = cell.passive.chain.forward(shown.passive_joints) @ cell.passive.target_mount_transform
    active = apply(result.T_P_A, arm_course(cell.active.chain, shown.active_joints))
    passive = arm_course(cell.passive.chain, shown.passive_joints)
    camera = np.vstack([active[-1], apply(T_P_E, field_of_view(cell))])
    target = apply(T_P_T, cell.target.board.outline[[0, 1, 2, 3, 0]])
    kept = Kept.of(result).words
    nominal = f"camera, its {kept} nominal" if kept else None
    for base, words, course, tool, beside, colour in (
        ("A", f"active arm ({cell.active_name})", active, camera, nominal, ORANGE),
        ("P", f"passive arm ({cell.passive_name})", passive, target, None, DARK),
    ):
        x, y, z = _mm(course).T
        axes.plot(x, y, z, color=colour, linewidth=4, marker="o", markersize=5, label=words)
        axes.text(x[0], y[0], z[0] - 90, base, fontsize=TEXT + 1, weight="bold", color=colour, ha="center")
        x, y, z = _mm(tool).T
        axes.plot(x, y, z, color=colour, linewidth=2, label=beside)


def arm_course(chain: Chain, q: Joints) -> Array:
    """Corners (k, 3) of the arm in its base, m: along each joint's axis by d, then to the next frame's origin."""
    frames = chain.frames(q)
    points = [frames[0, :3, 3]]
    for row, before, after in zip(chain.rows, frames[:-1], frames[1:], strict=True):
        points += [before[:3, 3] + row.d * before[:3, 2], after[:3, 3]]
    return np.array(points)


def field_of_view(cell: CellConfig) -> Array:
    """A line (k, 3) in E, m, about the pyramid that the camera sees."""
    width, height = cell.camera.size_px
    pixels = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]])
    rays = _FRUSTUM * pixels @ np.linalg.inv(cell.camera.intrinsics.matrix).T
    eye = np.zeros(3)
    return np.array([eye, rays[0], rays[1], eye, rays[2], rays[3], eye, rays[3], rays[0], rays[1], rays[2]])


def _mm(points: ArrayLike) -> Array:
    return np.asarray(1e3 * np.asarray(points))


def _finish(axes: Axes3D, zoom: float) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.set_aspect("equal")
    axes.set_box_aspect([np.ptp(limits) for limits in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())], zoom=zoom)
    axes.view_init(elev=22, azim=-72)
    axes.set_xlabel("x, mm", fontsize=TEXT, labelpad=10)
    axes.set_ylabel("y, mm", fontsize=TEXT, labelpad=6)
    axes.set_zlabel("z, mm", fontsize=TEXT)
    axes.tick_params(labelsize=TEXT - 2)
