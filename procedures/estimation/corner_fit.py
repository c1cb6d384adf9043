"""Both transforms from all corners of a few views, with the nominal values as prior.

Serves planning and the start of the servo. The result of a calibration never comes from here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualcal_hal.transforms import (
    Array,
    apply,
    inverse,
    rotation_from_vector,
    skew,
    transform,
    vector_from_rotation,
)
from procedures.estimation.projection import project, project_with_jacobian

_STARTS = 3
_COARSE_STEPS = 3
_MOST_STEPS = 50
_MOST_DAMPING = 1e8
_SMALLEST_GAIN = 1e-4  # of the cost, a sum of squares in units of sigma


@dataclass(frozen=True)
class Prior:
    """Nominal T_P_A and T_H_E (4, 4) with sigmas (4,): translation (m) and rotation (rad) of T_P_A, then of T_H_E."""

    T_P_A: Array
    T_H_E: Array
    sigmas: tuple[float, float, float, float]


@dataclass(frozen=True)
class CornerFit:
    """T_P_A, T_H_E (4, 4); covariance (12, 12) of their right perturbations [translation; rotation] of T_P_A,
    then of T_H_E, in m and rad, for pixel noise alone; rms: px per axis over all corners; view_rms (k,): the same
    of each view, NaN for a view without corners.
    """

    T_P_A: Array
    T_H_E: Array
    covariance: Array
    rms: float
    view_rms: Array


def fit_corners(
    T_A_H: ArrayLike,
    T_P_T: ArrayLike,
    corners: ArrayLike,
    observed: ArrayLike,
    matrix: ArrayLike,
    distortion: ArrayLike,
    prior: Prior,
    pixel_sigma: float,
    board_poses: Sequence[ArrayLike | None] | Array | None = None,
) -> CornerFit:
    """Maximum a posteriori fit by Levenberg-Marquardt from several starts; the lowest cost wins.

    T_A_H, T_P_T (k, 4, 4), m; corners in T (n, 3), m; observed (k, n, 2) px with NaN for a missing corner;
    matrix (3, 3) and distortion (5,) as in projection; pixel_sigma: px per axis. board_poses: T_E_T of each
    view, (4, 4) or its candidates (c, 4, 4) since a plane has two, or None; views beyond its end have none.
    Raises ValueError if from no start all corners lie in front of the camera.
    """
    T_A_H, T_P_T = np.asarray(T_A_H, dtype=float), np.asarray(T_P_T, dtype=float)
    views = _Views(
        T_A_H=T_A_H,
        points=apply(T_P_T, corners),
        observed=np.asarray(observed, dtype=float),
        matrix=np.asarray(matrix, dtype=float),
        distortion=np.asarray(distortion, dtype=float),
        sigma=pixel_sigma,
        prior=prior,
    )
    starts = _starts(T_A_H, T_P_T, [] if board_poses is None else board_poses, prior)
    costs = views.cost(starts)
    promising = [i for i in np.argsort(costs, kind="stable")[:_STARTS] if np.isfinite(costs[i])]
    if not promising:
        raise ValueError("from no start do all observed corners lie in front of the camera")
    # A few steps tell the minima apart; only the best one is worth the rest.
    coarse = [_minimise(views, starts[i], _COARSE_STEPS) for i in promising]
    return views.report(_minimise(views, min(coarse, key=views.cost), _MOST_STEPS))


@dataclass(frozen=True)
class _Views:
    """The data of one fit; ``points`` are the corners in P (k, n, 3).

    The unknown x (12,) is how far T_P_A, then T_H_E, is from its nominal value: translation (m) and rotation vector
    (rad) in the nominal child frame. So the prior is a sum of squares of x itself.
    """

    T_A_H: Array
    points: Array
    observed: Array
    matrix: Array
    distortion: Array
    sigma: float
    prior: Prior

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(k, n)"""
        return np.asarray(np.isfinite(self.observed).all(axis=-1))

    def transforms(self, x: Array) -> tuple[Array, Array]:
        """T_P_A and T_H_E (..., 4, 4) of x (..., 12)."""
        return self.prior.T_P_A @ _deviated(x[..., :6]), self.prior.T_H_E @ _deviated(x[..., 6:])

    def cost(self, x: Array) -> Array:
        """(...) of x (..., 12): squared residuals and deviations in units of sigma."""
        misfit = np.sum(self._squared_residuals(x), axis=(-2, -1)) / self.sigma**2
        return np.asarray(misfit + np.sum((x / self._sigmas) ** 2, axis=-1))

    def linearised(self, x: Array) -> tuple[float, Array, Array]:
        """The cost at x, J^T J (12, 12) and J^T r (12,) of the whitened residuals, prior included."""
        T_P_A, T_H_E = self.transforms(x)
        in_active, in_camera = self._in_camera(T_P_A, T_H_E)
        pixels, J_pixel = project_with_jacobian(in_camera, self.matrix, self.distortion)
        # A right perturbation (v, w) of a frame moves a point's coordinates p in it by -v + p x w.
        J_active = J_pixel @ np.swapaxes(self.T_A_H[:, :3, :3] @ T_H_E[:3, :3], 1, 2)[:, None]
        J = np.concatenate([-J_active, J_active @ skew(in_active), -J_pixel, J_pixel @ skew(in_camera)], axis=-1)
        J = J[self.seen].reshape(-1, 12) @ _right_perturbation(x) / self.sigma
        r = (pixels - self.observed)[self.seen].ravel() / self.sigma
        cost = r @ r + np.sum((x / self._sigmas) ** 2)
        precision = self._sigmas**-2
        return float(np.nan_to_num(cost, nan=np.inf)), J.T @ J + np.diag(precision), J.T @ r + precision * x

    def report(self, x: Array) -> CornerFit:
        T_P_A, T_H_E = self.transforms(x)
        _, normal, _ = self.linearised(x)
        A = _right_perturbation(x)
        squares, numbers = self._squared_residuals(x), 2 * self.seen
        with np.errstate(invalid="ignore"):
            view_rms = np.sqrt(squares.sum(axis=1) / numbers.sum(axis=1))
        return CornerFit(
            T_P_A=T_P_A,
            T_H_E=T_H_E,
            covariance=np.asarray(A @ np.linalg.solve(normal, A.T), dtype=float),
            rms=float(np.sqrt(squares.sum() / max(numbers.sum(), 1))),
            view_rms=view_rms,
        )

    def _squared_residuals(self, x: Array) -> Array:
        """(..., k, n) squared distances in px, 0 for missing corners, inf for those not in front of the camera."""
        pixels = project(self._in_camera(*self.transforms(x))[1], self.matrix, self.distortion)
        squares = np.sum((pixels - self.observed) ** 2, axis=-1)
        return np.where(self.seen, np.nan_to_num(squares, nan=np.inf), 0.0)

    def _in_camera(self, T_P_A: Array, T_H_E: Array) -> tuple[Array, Array]:
        in_active = apply(inverse(T_P_A)[..., None, :, :], self.points)
        return in_active, apply(inverse(self.T_A_H @ T_H_E[..., None, :, :]), in_active)

    @property
    def _sigmas(self) -> Array:
        return np.repeat(np.asarray(self.prior.sigmas, dtype=float), 3)


def _starts(T_A_H: Array, T_P_T: Array, board_poses: Sequence[ArrayLike | None] | Array, prior: Prior) -> Array:
    """(s, 12): the nominal, and the bases from each seen board by the nominal hand-eye, the better known one."""
    T_P_A = [prior.T_P_A]
    for flange, target, poses in zip(T_A_H, T_P_T, board_poses, strict=False):
        if poses is not None:
            T_E_T = np.asarray(poses, dtype=float).reshape(-1, 4, 4)
            T_P_A += [*(target @ inverse(flange @ prior.T_H_E @ T_E_T))]
    deviation = inverse(prior.T_P_A) @ np.stack(T_P_A)
    starts = np.zeros((len(deviation), 12))
    starts[:, :3], starts[:, 3:6] = deviation[:, :3, 3], vector_from_rotation(deviation[:, :3, :3])
    return starts


def _minimise(views: _Views, x: Array, steps: int) -> Array:
    damping = 1e-3
    cost, normal, gradient = views.linearised(x)
    for _ in range(steps):
        moved = x + np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -gradient)
        moved_cost, moved_normal, moved_gradient = views.linearised(moved)
        if moved_cost >= cost:
            damping *= 10
            if damping > _MOST_DAMPING:
                break
            continue
        gain = cost - moved_cost
        x, cost, normal, gradient, damping = moved, moved_cost, moved_normal, moved_gradient, damping / 10
        if gain < _SMALLEST_GAIN:
            break
    return x


def _deviated(x: Array) -> Array:
    return transform(rotation_from_vector(x[..., 3:]), x[..., :3])


def _right_perturbation(x: Array) -> Array:
    """(12, 12): what a change of x perturbs the two transforms by from the right, [translation; rotation] each."""
    A = np.zeros((12, 12))
    for at in (0, 6):
        vector = x[at + 3 : at + 6]
        A[at : at + 3, at : at + 3] = rotation_from_vector(-vector)
        A[at + 3 : at + 6, at + 3 : at + 6] = _right_jacobian(vector)
    return A


def _right_jacobian(vector: Array) -> Array:
    """Of SO(3), (3, 3): exp(vector + d) = exp(vector) exp(J d) to first order in d
    (Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", eq. 143).
    """
    angle = float(np.linalg.norm(vector))
    S = skew(vector)
    if angle < 1e-4:
        return np.asarray(np.eye(3) - S / 2 + S @ S / 6)
    c1, c2 = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) - c1 * S + c2 * S @ S)
