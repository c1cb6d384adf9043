"""Where the residuals of views come from: what is left of them as one thing after the other is left to the images.

Each step fits the corners by least squares: with all as it was given; with the lens free; with the arm's pose of each
view free, so that the arm says nothing; with the places of the corners on the board free too. What remains then is what
the corners themselves scatter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dualcal_hal.transforms import Array, Mask, inverse
from procedures.estimation.degenerate import Degenerate
from procedures.estimation.refined.data import Knowns, Noise
from procedures.estimation.refined.inexact import Inexact, free_intrinsics
from procedures.estimation.refined.model import CELL, Model
from procedures.estimation.refined.one_arm import OneArm, Views
from procedures.estimation.refined.refit import Refit, refit

FREE_LENS = (free_intrinsics(),)

_FREE_POSE = 0.05  # rad: far more than any arm is off
_PIXEL = 0.1  # px
_OFF_PLACE = 0.03  # squares by which a corner may be off its place, 1 sigma: far more than on any board of use
_LENS, _POSE, _RIGID = 9, 6, 7  # unknowns; of the corners' places those of a rigid motion and a scale are none
_ENOUGH = 1.5  # numbers measured for each unknown


@dataclass(frozen=True)
class Breakdown:
    """Sigma of the corners, px per axis, with all given, then with lens, poses and corners left to the images one after
    the other; None from where on the views are too few for it. off_places, m: by how much the corners then lie off
    where the board should have them, rms, along the board's x and y together, and along z.
    """

    given: float
    lens_free: float | None = None
    poses_free: float | None = None
    corners_free: float | None = None
    off_places: tuple[float, float] | None = None


def break_down(views: Views, result: OneArm) -> Breakdown:
    """Of the views that a result used, from there."""
    used, arm = result.used, Noise(_PIXEL, 0.0, 0.0)
    numbers = 2 * int(views.seen[used].sum())
    poses = _POSE * int(used.sum()) + _LENS
    corners = 3 * int(np.any(views.seen[used], axis=0).sum()) - _RIGID
    free = Noise(_PIXEL, _FREE_POSE, _FREE_POSE)
    as_given = replace(result, matrix=views.matrix, distortion=views.distortion)
    steps = [_sigma(refit(views, as_given, used, arm, ()), arm, CELL)]
    off_places = None
    everything = (*FREE_LENS, _corner_places(views))
    try:
        for unknowns, noise, inexact in (
            (CELL + _LENS, arm, FREE_LENS),
            (poses, free, FREE_LENS),
            (poses + corners, free, everything),
        ):
            if numbers < _ENOUGH * unknowns:
                break
            fitted = refit(views, result, used, noise, inexact)
            steps.append(_sigma(fitted, noise, unknowns))
            # The next step begins where this one ended: far from a lens that bends no board.
            views, result = _continued(views, result, fitted)
            if inexact is everything:
                off_places = _off_places(fitted, views.corners, np.any(views.seen[used], axis=0))
    except Degenerate:
        pass  # what cannot be seen is not told
    every: list[float | None] = [*steps, None, None, None]
    return Breakdown(steps[0], every[1], every[2], every[3], off_places)


def _continued(views: Views, result: OneArm, fitted: Refit) -> tuple[Views, OneArm]:
    matrix, distortion = fitted.knowns.matrix, fitted.knowns.distortion
    camera, target = fitted.state.T_H_E, inverse(fitted.state.T_P_A)
    result = replace(result, camera=camera, target=target, matrix=matrix, distortion=distortion)
    return replace(views, matrix=matrix, distortion=distortion), result


def _sigma(fitted: Refit, noise: Noise, unknowns: int) -> float:
    model = Model(fitted.captures, fitted.knowns, noise)
    squares = float(np.sum((model.residuals(fitted.state) * noise.pixel) ** 2))
    return float(np.sqrt(squares / max(model.measurements - unknowns, 1)))


def _corner_places(views: Views) -> Inexact:
    count = len(views.corners)

    def shifted(knowns: Knowns, by: Array) -> Knowns:
        return replace(knowns, corners=knowns.corners + by.reshape(-1, 3))

    apart = np.linalg.norm(views.corners[:, None] - views.corners, axis=2)
    square = float(apart[apart > 0].min())
    names = tuple(f"corner {i} along {axis}" for i in range(count) for axis in "xyz")
    units = ("m",) * (3 * count)
    return Inexact("corners", names, units, np.full(3 * count, _OFF_PLACE * square), np.ones(3 * count), shifted)


def _off_places(fitted: Refit, corners: Array, seen: Mask) -> tuple[float, float]:
    off = (fitted.knowns.corners - corners)[seen]
    return float(np.sqrt(2 * np.mean(off[:, :2] ** 2))), float(np.sqrt(np.mean(off[:, 2] ** 2)))
