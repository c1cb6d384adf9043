"""Whether captures that were not estimated from are where the estimate puts them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from dualcal_hal.transforms import Array, Mask, inverse
from procedures.estimation.degenerate import Degenerate
from procedures.estimation.refined.again import fit_again
from procedures.estimation.refined.data import CaptureArrays
from procedures.estimation.refined.estimate import Refined
from procedures.estimation.refined.inexact import by_inexact
from procedures.estimation.refined.model import Model, Sight, State
from procedures.estimation.refined.motion import moved
from procedures.estimation.refined.outliers import distances

LEAST_PROBABILITY = 1e-3
"""Of residuals as large as those found, or larger, were all as reckoned with; below it they do not fit."""

_RANK = 1e-9  # of the largest eigenvalue of a capture's information
_MOST_STEPS = 30
_SMALLEST_GAIN = 1e-4  # in units of sigma squared


@dataclass(frozen=True)
class Part:
    """A sum of squares that is a chi-square of ``freedom`` degrees of freedom if all is as reckoned with."""

    squares: float
    freedom: int

    @property
    def probability(self) -> float:
        """Of as large a value or a larger one by chance."""
        return float(stats.chi2.sf(self.squares, self.freedom)) if self.freedom else 1.0


@dataclass(frozen=True)
class Consistency:
    """Of verification captures: captures (k,), squared distance of each from its prediction in units of all
    uncertainty, with freedoms (k,) degrees of freedom; residuals (k, n, 2): px, predicted minus measured, arms as they
    were read, NaN for corners not seen.

    poses: how far the boards of all together are from where they are predicted; corners: how far the corners are from
    one board each, wherever that is. Both parts are independent, and either may give the others away: corners better
    than stated must not hide boards that are elsewhere.
    """

    captures: Array
    freedoms: Array
    residuals: Array
    poses: Part
    corners: Part

    @property
    def statistic(self) -> float:
        return self.poses.squares + self.corners.squares

    @property
    def freedom(self) -> int:
        return self.poses.freedom + self.corners.freedom

    @property
    def probability(self) -> float:
        """That either part is as large or larger by chance (one-sided; Bonferroni's for two)."""
        chances = [part.probability for part in (self.poses, self.corners) if part.freedom]
        return min(1.0, len(chances) * min(chances)) if chances else 1.0

    @property
    def fits(self) -> bool:
        return self.probability >= LEAST_PROBABILITY


def verify(result: Refined, captures: CaptureArrays) -> Consistency:
    """By a chi-square with the full covariance: noise of pixels, of the passive arm at each capture, of the active arm
    at each arrival, and of the estimate with its inexact knowns.

    An uncertain estimate may be so far from the truth that predictions do not change in proportion to its error. So
    where captures do not fit the linear prediction, the likelihood ratio decides which that approximates: by how much
    the least squares of all captures exceed those of the captures that were estimated from. ``captures`` of the answer
    are then the distances of each from where all others put it.

    The test is one-sided, since captures are accepted when their feature point is measured within a tolerance of the
    principal point, which makes residuals smaller. What was measured there is where the alignment left the point, a,
    plus what pixels and arms did by chance, b; of all b those are kept with |a + b| within the tolerance. a and b being
    normal and centred, every sum of squares of residuals is then at most as likely to exceed a limit as without the
    choice (Gaussian correlation inequality; Royen, Far East J. Theor. Stat. 48, 2014), so the choice never gives a
    false alarm. It makes poses smaller on average, at most by two of a board's six numbers. It takes nothing from what
    is wrong with the estimate: the alignment brings the measured point to the principal point whatever the estimate
    says of it.
    """
    captures = in_order(result, captures)
    model = Model(captures, result.knowns, result.noise)
    state = model.state(result.T_P_A, result.T_H_E)
    residuals = model.residuals(state)
    shown = np.where(model.seen[..., None], residuals * result.noise.pixel, np.nan)
    behind = ~np.isfinite(residuals).all(axis=(1, 2))
    if behind.any():
        # Nothing is as far off as a board that should be behind the camera.
        far = np.where(behind, np.inf, np.nan)
        poses, corners = Part(np.inf, 6 * len(captures)), Part(np.inf, int(model.freedom.sum()))
        return Consistency(far, model.freedom, shown, poses, corners)
    parts = _Parts.of(result, captures, model, state)
    corners, boards = parts.corners(boards_alone(model, state))
    poses = Part(max(parts.together() - corners.squares, 0.0), boards)
    found = Consistency(parts.alone(), model.freedom, shown, poses, corners)
    return found if found.fits else _by_all(found, result, captures)


def _by_all(found: Consistency, result: Refined, captures: CaptureArrays) -> Consistency:
    """By the likelihood ratio, where that is smaller than its linear approximation."""
    try:
        before = fit_again(result, result.captures)
        after = fit_again(result, result.captures.followed_by(captures))
        alone = distances(after.model, after.fit).captures[-len(captures) :]
    except (Degenerate, np.linalg.LinAlgError):
        return found
    squares = max(after.cost - before.cost - found.corners.squares, 0.0)
    if not squares < found.poses.squares:
        return found
    return replace(found, captures=alone, poses=Part(squares, found.poses.freedom))


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
    def of(cls, result: Refined, captures: CaptureArrays, model: Model, state: State) -> _Parts:
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
            outside=_off_board(J, of_knowns @ root[12:])[0],
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

    def corners(self, boards: Sight) -> tuple[Part, int]:
        """What is left with each board where it fits its corners best, and how many numbers that takes of all."""
        columns = np.concatenate([boards.residuals[..., None], self.outside], axis=2)
        left, ranks = _off_board(boards.jacobian, columns)
        squares = float(_without(np.einsum("kri,krj->ij", left, left), 1)[0, 0])
        freedom = int(self.model.freedom.sum() - ranks.sum())
        return Part(max(squares, 0.0) if freedom else 0.0, freedom), int(ranks.sum())


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


def corner_squares(model: Model, state: State) -> tuple[Array, Array]:
    """(k,): squares that are left with each board where it fits its corners best; and how many numbers that takes."""
    boards = boards_alone(model, state)
    left, ranks = _off_board(boards.jacobian, boards.residuals[..., None])
    return np.sum(left**2, axis=(1, 2)), ranks


def boards_alone(model: Model, state: State) -> Sight:
    """Of each board where it fits its corners best, whatever the arms say, from where the state has it. By Gauss-Newton
    steps, shortened where they go too far.
    """
    T_P_E, _, _ = model.arrival_poses(state)
    T_E_T = inverse(T_P_E)[model.arrival] @ model.T_P_F @ model.knowns.T_F_T
    sight, length = model.sight(T_E_T), np.ones(model.captures)
    for _ in range(_MOST_STEPS):
        axes, along, _ = _scaled_axes(sight.normal)
        towards = np.einsum("kij,ki->kj", axes * along[:, None], sight.gradient)
        if np.sum(towards**2, axis=1).max(initial=0.0) < _SMALLEST_GAIN:
            break
        step = -np.einsum("kij,kj->ki", axes * along[:, None], towards)
        tried = inverse(moved(np.eye(4), length[:, None] * step)) @ T_E_T
        better = model.sight(tried).squares < sight.squares
        T_E_T = np.where(better[:, None, None], tried, T_E_T)
        length = np.where(better, np.minimum(2 * length, 1.0), length / 4)
        sight = model.sight(T_E_T)
    return sight


def _off_board(jacobian: Array, columns: Array) -> tuple[Array, Array]:
    """Columns (k, 2n, c) without what motions of the board, of this jacobian (k, 2n, 6), can do; and how many numbers
    (k,) that takes.
    """
    axes, along, ranks = _scaled_axes(np.swapaxes(jacobian, 1, 2) @ jacobian)
    across = jacobian @ (axes * along[:, None])
    return columns - across @ (np.swapaxes(across, 1, 2) @ columns), ranks


def _scaled_axes(normal: Array) -> tuple[Array, Array, Array]:
    """Eigenvectors (k, 6, 6) of information (k, 6, 6) and the inverse roots (k, 6) of its eigenvalues, 0 where it says
    nothing; and how many it knows (k,).
    """
    values, axes = np.linalg.eigh(normal)
    known = values > _RANK * values[:, -1:]
    return axes, np.where(known, 1 / np.sqrt(np.where(known, values, 1.0)), 0.0), known.sum(axis=1)
