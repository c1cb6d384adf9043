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
from procedures.report.style import BLUE, DARK, GREEN, ORANGE, RED, TEXT, head, host

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec
    from mpl_toolkits.mplot3d.axes3d import Axes3D

Positions = Mapping[tuple[str, int], Array]
"""Feature points (3,) in P, m, by constraint and number of the position."""

_BEYOND = 1.1  # how far an axis is drawn, of the distance to its farthest position
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
    axes = figure.add_axes(
        (box.x0 - 0.05, box.y0 - 0.06, box.width + 0.08, box.height + 0.09), projection="3d", zorder=-1
    )
    axes.patch.set_visible(False)

    reached = {(c.constraint, c.position): feature_point(cell, c.passive_joints) for c in captures}
    planned = {} if plan is None else _planned(cell, plan)
    _draw_arms(axes, cell, result, shown)
    _draw_axes(axes, cell, captures, result, reached)
    if planned:
        _draw_points(axes, planned, f"planned ({len(planned)})", "none", BLUE, 80)
    _draw_points(axes, reached, f"reached ({len(reached)}){_distance(planned, reached)}", RED, RED, 14)
    _finish(axes)
    for handle, words in zip(*axes.get_legend_handles_labels(), strict=True):
        handle.set_label(words)
    head(panel, "Cell in the passive base P, by the transforms found", *axes.get_legend_handles_labels())
