"""Belief from what has been seen so far: all corners of all views, with the nominal as prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dualcal_hal.geometry import Placement
from dualcal_hal.robot import Joints
from dualcal_hal.transforms import Array, rotation_angle
from procedures.detection import board_poses
from procedures.estimation.corner_fit import Prior, fit_corners
from procedures.planning.belief import LEAST_ERROR, Belief
from procedures.planning.model import CellModel

WORST_FIT = 3.0
"""px rms above which the views do not belong to one cell: the board, its mount or the arms are not as told."""

LEAST_VIEWS = 3
"""Below so many views a fit may be in a wrong minimum, and what is kept clear of is the nominal's error."""

_DETECTION_SIGMA = 0.02  # px; far below what the joints' noise does in the image


@dataclass(frozen=True, eq=False)
class View:
    """A board seen: both arms' joint angles (rad) and the corners (n, 2) in px, NaN for one that was not seen."""

    active: Joints
    passive: Joints
    corners: Array


def refine(model: CellModel, views: Sequence[View]) -> tuple[Belief, float]:
    """The belief that explains the views, and its rms in px per axis.

    Clear is kept of the fitted placement by the fit's error. Of the nominal one by its own instead while there are too
    few views, and while the fit says less than the nominal does and nothing against it. ValueError if nothing near the
    nominal explains the views.
    """
    corners = np.stack([view.corners for view in views])
    # Only few views need starts of their own; with many the nominal has been left behind long ago.
    starts = [np.stack([T for T, _ in board_poses(view.corners, model.board, model.intrinsics)]) for view in views[:5]]
    fit = fit_corners(
        model.active.chain.forward([view.active for view in views]),
        model.target_in_passive([view.passive for view in views]),
        model.board.corners,
        corners,
        model.intrinsics.matrix,
        model.intrinsics.distortion,
        Prior(model.nominal.T_P_A, model.nominal.T_H_E, tuple(np.sqrt(np.diag(model.nominal.covariance)[::3]))),
        float(np.hypot(_DETECTION_SIGMA, arrival_scatter(model))),
        [*starts, *([None] * (len(views) - len(starts)))],
    )
    belief = Belief.fitted(fit.T_P_A, fit.T_H_E, fit.covariance, f"{len(views)} views")
    nominal = model.nominal.placement
    if len(views) < LEAST_VIEWS:
        return replace(belief, placement=nominal), fit.rms
    if nominal.translation < LEAST_ERROR[0] or nominal.rotation < LEAST_ERROR[1]:
        # Not even a tape measure is trusted further than a fit.
        errors = max(nominal.translation, LEAST_ERROR[0]), max(nominal.rotation, LEAST_ERROR[1])
        nominal = Placement(nominal.T_P_A, *errors)
    says_less = _error_at_a_metre(belief.placement) > _error_at_a_metre(nominal)
    if says_less and nominal_excess(model, belief) is None:
        belief = replace(belief, placement=nominal)
    return belief, fit.rms


def nominal_excess(model: CellModel, belief: Belief) -> tuple[float, float] | None:
    """How far (m, rad) a fitted belief has the active base from its nominal place, if that is more than the cell file
    allows and the fit may be wrong by; None if it is not."""
    nominal, fitted = (
        model.nominal.placement,
        Belief.fitted(belief.T_P_A, belief.T_H_E, belief.covariance, "").placement,
    )
    translation = float(np.linalg.norm(belief.T_P_A[:3, 3] - nominal.T_P_A[:3, 3]))
    rotation = float(rotation_angle(belief.T_P_A[:3, :3], nominal.T_P_A[:3, :3]))
    allowed = nominal.translation + fitted.translation, nominal.rotation + fitted.rotation
    return (translation, rotation) if translation > allowed[0] or rotation > allowed[1] else None


def _error_at_a_metre(placement: Placement) -> float:
    """How far a point that far from the pivot may be off, m."""
    return placement.translation + placement.rotation


def arrival_scatter(model: CellModel) -> float:
    """How far the feature lands from where it was sent, px per axis, 1 sigma, by the passive arm's joint noise.

    The motion of the target across the view by each joint's error, seen from the middle distance, over random
    postures that reach out (the farther half of them), as they do towards the other arm.
    """
    arm = model.passive
    rng = np.random.default_rng(0)
    q = rng.uniform(arm.lower, arm.upper, (400, arm.chain.joints))
    flange = arm.chain.forward(q)
    reach = np.linalg.norm(flange[:, :3, 3], axis=1)
    outer = reach >= np.median(reach)
    J, flange = arm.chain.jacobian(q[outer]), flange[outer]
    lever = flange[:, :3, :3] @ model.T_F_T[:3, 3]
    at_target = J[:, :3] + np.cross(J[:, 3:], lever[:, :, None], axis=1)
    per_axis = np.sqrt(np.mean(np.sum(at_target**2, axis=2)))
    focal = float(np.sqrt(model.intrinsics.matrix[0, 0] * model.intrinsics.matrix[1, 1]))
    return float(focal / np.mean(model.distance) * arm.joint_sigma * per_axis)
