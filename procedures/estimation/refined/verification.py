"""Whether captures that were not estimated from are where the estimate puts them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from dualcal_hal.transforms import Array, Mask
from procedures.estimation.refined.data import CaptureArrays
from procedures.estimation.refined.estimate import Refined
from procedures.estimation.refined.inexact import by_inexact
from procedures.estimation.refined.model import Linearised, Model

LEAST_PROBABILITY = 1e-3
"""Of residuals as large as those found, or larger, were all as reckoned with; below it they do not fit."""

_MOST_LOST = 1.62  # sigmas, where x^2 times what a normal number loses of its variance within +-x is largest
_RANK = 1e-9  # of the largest eigenvalue of a capture's information


@dataclass(frozen=True)
class Consistency:
    """Of verification captures: captures (k,), squared distance of each from its prediction in units of all
    uncertainty, with freedoms (k,) degrees of freedom; residuals (k, n, 2): px, predicted minus measured, arms as they
    were read, NaN for corners not seen.

    poses and pose_freedom: the part of all together in which the boards are elsewhere than predicted; corners and
    corner_freedom: how far the corners are from one board each, wherever that is. Both parts are independent, and
    either may give the others away: corners better than stated must not hide boards that are elsewhere.

    hidden: by how much ``statistic`` is smaller on average, at most, since captures were accepted within a tolerance.
    """

    captures: Array
    freedoms: Array
    residuals: Array
    poses: float
    pose_freedom: int
    corners: float
    corner_freedom: int
    hidden: float = 0.0

    @property
    def statistic(self) -> float:
        return self.poses + self.corners

    @property
    def freedom(self) -> int:
        return self.pose_freedom + self.corner_freedom

    @property
    def probability(self) -> float:
        """That either part is as large or larger by chance (one-sided; Bonferroni's for two)."""
        parts = ((self.poses, self.pose_freedom), (self.corners, self.corner_freedom))
        chances = [float(stats.chi2.sf(value, freedom)) for value, freedom in parts if freedom]
        return min(1.0, len(chances) * min(chances)) if chances else 1.0

    @property
    def fits(self) -> bool:
        return self.probability >= LEAST_PROBABILITY


def verify(result: Refined, captures: CaptureArrays, aligned: tuple[int, float] | None = None) -> Consistency:
    """By a chi-square with the full covariance: noise of pixels, of the passive arm at each capture, of the active arm
    at each arrival, and of the estimate with its inexact knowns.

    aligned: the feature point's corner, and the tolerance (px per axis) within which of the principal point it was
    measured in captures that were accepted for that. What was measured there is where the alignment left the point, a,
    plus what pixels and arms did by chance, b; of all b those are kept with |a + b| within the tolerance. a and b being
    normal and centred, every sum of squares of residuals is then at most as likely to exceed a limit as without the
    choice (Gaussian correlation inequality; Royen, Far East J. Theor. Stat. 48, 2014). So the test is one-sided, and
    the choice never gives a false alarm. What it costs: ``hidden``, at most two of a board's six numbers, and at most
    0.26 each at a tolerance of two sigmas of b. It costs nothing of what is wrong with the estimate: the
    alignment brings the measured point to the principal point whatever the estimate says of it.
    """
    captures = in_order(result, captures)
    model = Model(captures, result.knowns, result.noise)
    residuals, seen = model.residuals(model.state(result.T_P_A, result.T_H_E)), model.seen
    shown = np.where(seen[..., None], residuals * result.noise.pixel, np.nan)
    behind = ~np.isfinite(residuals).all(axis=(1, 2))
    if behind.any():
        # Nothing is as far off as a board that should be behind the camera.
        far = np.where(behind, np.inf, np.nan)
        return Consistency(far, model.freedom, shown, np.inf, 6 * len(captures), np.inf, int(model.freedom.sum()))
    parts = _Parts.of(result, captures, model)
    corners, ranks = parts.corners()
    corner_freedom = int(model.freedom.sum() - ranks.sum())
    return Consistency(
        captures=parts.alone(),
        freedoms=model.freedom,
        residuals=shown,
        poses=max(parts.together() - corners, 0.0),
        pose_freedom=int(ranks.sum()),
        corners=max(corners, 0.0) if corner_freedom else 0.0,
        corner_freedom=corner_freedom,
        hidden=0.0 if aligned is None else parts.hidden(aligned[0], aligned[1] / result.noise.pixel),
    )


@dataclass(frozen=True)
class _Parts:
    """Of the captures' corners, in units of the pixel sigma: residuals (k, 2n); how motions of the camera move them
    (k, 2n, 6); how one sigma does of the estimate (k, 2n, 12 + m), of the active arm and of the passive one (k, 2n, .).
    """

    residuals: Array
    of_pose: Array
    of_estimate: Array
    of_active: Array
    of_passive: Array
    outside: Array  # of_estimate as far as it moves corners by more than their board
    model: Model

    @classmethod
    def of(cls, result: Refined, captures: CaptureArrays, model: Model) -> _Parts:
        state = model.state(result.T_P_A, result.T_H_E)
        at, J = model.linearised(state), model.jacobian(state)
        of_knowns = by_inexact(captures, result.knowns, result.noise, result.inexact, state)
        root = _root(result.joint_covariance)
        of_cell = J @ at.towards_cell[model.arrival]
        return cls(
            residuals=model.residuals(state).reshape(model.captures, -1),
            of_pose=J,
            of_estimate=np.concatenate([of_cell, of_knowns], axis=2) @ root,
            of_active=J @ at.towards_active[model.arrival],
            of_passive=J @ at.towards_passive,
            outside=of_knowns @ root[12:],
            model=model,
        )

    def _columns(self) -> list[Array]:
        return [self.residuals[..., None], self.of_estimate, self.of_active, self.of_passive]

    def together(self) -> float:
        """Squares of all residuals with their full covariance."""
        columns = np.concatenate(self._columns(), axis=2)
        estimate, active = self.of_estimate.shape[2], self.of_active.shape[2]
        captures = _without(np.swapaxes(columns, 1, 2) @ columns, 1 + estimate + active)
        arrivals = np.zeros((self.model.arrivals, *captures.shape[1:]))
        np.add.at(arrivals, self.model.arrival, captures)
        return float(_without(_without(arrivals, 1 + estimate).sum(axis=0), 1)[0, 0])

    def alone(self) -> Array:
        """(k,): of each capture by itself."""
        columns = np.concatenate(self._columns(), axis=2)
        return _without(np.swapaxes(columns, 1, 2) @ columns, 1)[:, 0, 0]

    def corners(self) -> tuple[float, Array]:
        """Squares of what is left with each board where it fits its corners best, and how many numbers (k,) that
        takes.
        """
        columns = np.concatenate([self.residuals[..., None], self.outside], axis=2)
        values, axes = np.linalg.eigh(np.swapaxes(self.of_pose, 1, 2) @ self.of_pose)
        known = values > _RANK * values[:, -1:]
        scale = np.where(known, 1 / np.sqrt(np.where(known, values, 1.0)), 0.0)
        along = np.swapaxes(self.of_pose @ (axes * scale[:, None]), 1, 2) @ columns
        left = np.swapaxes(columns, 1, 2) @ columns - np.swapaxes(along, 1, 2) @ along
        return float(_without(left.sum(axis=0), 1)[0, 0]), known.sum(axis=1)

    def hidden(self, feature: int, tolerance: float) -> float:
        """Sum over both axes of what b loses of its variance where a + b is kept within the tolerance."""
        rows = slice(2 * feature, 2 * feature + 2)
        chance = [np.sum(part[:, rows] ** 2, axis=2) for part in (self.of_active, self.of_passive)]
        ratio = tolerance / np.sqrt(1.0 + chance[0] + chance[1])
        # With r^2 the part of b in the variance of a + b: r^2 lost(r ratio), at the r for which that is largest.
        within = np.minimum(ratio, _MOST_LOST)
        lost = 2 * within * stats.norm.pdf(within) / (1 - 2 * stats.norm.sf(within)) * (within / ratio) ** 2
        return float(np.sum(lost[self.model.seen[:, feature]]))


def _without(gram: Array, kept: int) -> Array:
    """Products (..., c, c) of columns with each other, of which all but the first are what errors of unit sigma do:
    the products of the first ``kept`` in the metric of white noise and the other columns' errors.
    """
    mixed = gram[..., kept:, :kept]
    inner = np.eye(gram.shape[-1] - kept) + gram[..., kept:, kept:]
    return np.asarray(gram[..., :kept, :kept] - np.swapaxes(mixed, -1, -2) @ np.linalg.solve(inner, mixed))


def in_order(result: Refined, captures: CaptureArrays) -> CaptureArrays:
    """Captures with the corners of those of unknown order listed from the end from which they fit better."""
    turned: Mask = ~captures.order
    if not turned.any():
        return captures
    squares = []
    for data in (captures, captures.turned(turned)):
        model = Model(data, result.knowns, result.noise)
        residuals = model.residuals(model.state(result.T_P_A, result.T_H_E))
        squares.append(np.sum(np.where(np.isfinite(residuals), residuals, 0.0) ** 2, axis=(1, 2)))
    return captures.turned(turned & (squares[1] < squares[0]))


def _root(covariance: Array) -> Array:
    """S with S S^T the covariance, its numbers being of different size."""
    size = np.sqrt(np.diag(covariance))
    values, axes = np.linalg.eigh(covariance / np.outer(size, size))
    return np.asarray(size[:, None] * axes * np.sqrt(np.maximum(values, 0.0)))


def corner_squares(at: Linearised) -> tuple[Array, Array]:
    """(k,): squares that are left with each board where it fits its corners best; and how many numbers that takes."""
    values, axes = np.linalg.eigh(at.pixel_normal)
    along = np.einsum("kij,ki->kj", axes, at.pixel_gradient)
    known = values > _RANK * values[:, -1:]
    explained = np.sum(np.where(known, along**2 / np.where(known, values, 1.0), 0.0), axis=1)
    return at.squares - explained, known.sum(axis=1)
