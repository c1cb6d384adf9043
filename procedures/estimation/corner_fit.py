"""Both transforms from all corners of a few views, with the nominal values as prior.

Serves planning and the start of the servo. The result of a calibration never comes from here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
    then of T_H_E, in m and rad; rms: px per axis over all corners; view_rms (k,): the same of each view, NaN
    for a view without corners.
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
    view, (4, 4) or its candidates (c, 4, 4) since a plane has two, or None. Raises ValueError if from no
    start all corners lie in front of the camera.
    """
    views = _Views(
        T_A_H=np.asarray(T_A_H, dtype=float),
        points=apply(T_P_T, corners),
        observed=np.asarray(observed, dtype=float),
        matrix=np.asarray(matrix, dtype=float),
        distortion=np.asarray(distortion, dtype=float),
        sigma=pixel_sigma,
        prior=prior,
    )
    starts = np.stack([prior.T_P_A, *_starts(views.T_A_H, np.asarray(T_P_T, dtype=float), board_poses, prior.T_H_E)])
    costs = views.cost(starts, prior.T_H_E)
    promising = [i for i in np.argsort(costs, kind="stable")[:_STARTS] if np.isfinite(costs[i])]
    if not promising:
        raise ValueError("from no start do all observed corners lie in front of the camera")
    # A few steps tell the minima apart; only the best one is worth the rest.
    coarse = [_minimise(views, starts[i], prior.T_H_E, _COARSE_STEPS) for i in promising]
    _, *best = min(coarse, key=lambda fit: fit[0])
    _, T_P_A, T_H_E = _minimise(views, best[0], best[1], _MOST_STEPS)
    normal, _ = views.normal_equations(T_P_A, T_H_E)
    squares = views.squared_residuals(T_P_A, T_H_E)
    with np.errstate(invalid="ignore"):
        view_rms = np.sqrt(squares.sum(axis=1) / (2 * views.seen.sum(axis=1)))
    return CornerFit(
        T_P_A=T_P_A,
        T_H_E=T_H_E,
        covariance=np.asarray(np.linalg.inv(normal), dtype=float),
        rms=float(np.sqrt(squares.sum() / max(2 * views.seen.sum(), 1))),
        view_rms=view_rms,
    )


@dataclass(frozen=True)
class _Views:
    """The data of one fit; ``points`` are the corners in P (k, n, 3)."""

    T_A_H: Array
    points: Array
    observed: Array
    matrix: Array
    distortion: Array
    sigma: float
    prior: Prior

    @property
    def seen(self) -> NDArray[np.bool_]:
        return np.asarray(np.isfinite(self.observed).all(axis=-1))

    def squared_residuals(self, T_P_A: Array, T_H_E: Array) -> Array:
        """(..., k, n) squared distances in px, 0 for missing corners, inf for those not in front of the camera."""
        pixels = project(self._in_camera(T_P_A, T_H_E)[1], self.matrix, self.distortion)
        squares = np.sum((pixels - self.observed) ** 2, axis=-1)
        return np.where(self.seen, np.nan_to_num(squares, nan=np.inf), 0.0)

    def cost(self, T_P_A: Array, T_H_E: Array) -> Array:
        """(...) for (..., 4, 4): squared residuals and deviation from the nominal in units of sigma."""
        misfit = np.sum(self.squared_residuals(T_P_A, T_H_E), axis=(-2, -1)) / self.sigma**2
        return np.asarray(misfit + np.sum(self._deviation(T_P_A, T_H_E) ** 2, axis=-1))

    def normal_equations(self, T_P_A: Array, T_H_E: Array) -> tuple[Array, Array]:
        """J^T J (12, 12) and J^T r (12,) of the whitened residuals, prior included."""
        in_active, in_camera = self._in_camera(T_P_A, T_H_E)
        pixels, J_pixel = project_with_jacobian(in_camera, self.matrix, self.distortion)
        # A right perturbation (v, w) of a frame moves a point's coordinates p in it by -v + p x w.
        J_active = J_pixel @ np.swapaxes(self.T_A_H[:, :3, :3] @ T_H_E[:3, :3], 1, 2)[:, None]
        J = np.concatenate([-J_active, J_active @ skew(in_active), -J_pixel, J_pixel @ skew(in_camera)], axis=-1)
        J = J[self.seen].reshape(-1, 12) / self.sigma
        r = (pixels - self.observed)[self.seen].ravel() / self.sigma
        deviation = self._deviation(T_P_A, T_H_E)
        J_prior = self._deviation_jacobian(T_P_A, T_H_E, deviation)
        normal = J.T @ J + J_prior.T @ J_prior
        return normal, J.T @ r + J_prior.T @ deviation

    def _in_camera(self, T_P_A: Array, T_H_E: Array) -> tuple[Array, Array]:
        in_active = apply(inverse(T_P_A)[..., None, :, :], self.points)
        return in_active, apply(inverse(self.T_A_H @ T_H_E[..., None, :, :]), in_active)

    def _deviation(self, T_P_A: Array, T_H_E: Array) -> Array:
        """(..., 12) deviation from the nominal in the nominal child frames, in units of the prior's sigma."""
        relative = inverse(self._nominal) @ np.stack(np.broadcast_arrays(T_P_A, T_H_E), axis=-3)
        parts = np.concatenate([relative[..., :3, 3], vector_from_rotation(relative[..., :3, :3])], axis=-1)
        return parts.reshape(*parts.shape[:-2], 12) / self._sigmas

    def _deviation_jacobian(self, T_P_A: Array, T_H_E: Array, deviation: Array) -> Array:
        J = np.zeros((12, 12))
        turned = (deviation * self._sigmas).reshape(2, 6)[:, 3:]
        for at, nominal, T, vector in zip((0, 6), self._nominal, (T_P_A, T_H_E), turned, strict=True):
            J[at : at + 3, at : at + 3] = nominal[:3, :3].T @ T[:3, :3]
            J[at + 3 : at + 6, at + 3 : at + 6] = _log_jacobian(vector)
        return J / self._sigmas[:, None]

    @property
    def _nominal(self) -> Array:
        return np.stack([self.prior.T_P_A, self.prior.T_H_E])

    @property
    def _sigmas(self) -> Array:
        return np.repeat(np.asarray(self.prior.sigmas, dtype=float), 3)


def _starts(
    T_A_H: Array, T_P_T: Array, board_poses: Sequence[ArrayLike | None] | Array | None, T_H_E: Array
) -> Iterator[Array]:
    # The hand-eye is the better known of the two: from its nominal, each seen board gives the bases.
    for flange, target, poses in zip(T_A_H, T_P_T, [] if board_poses is None else board_poses, strict=False):
        if poses is None:
            continue
        for T_E_T in np.asarray(poses, dtype=float).reshape(-1, 4, 4):
            yield target @ inverse(flange @ T_H_E @ T_E_T)


def _minimise(views: _Views, T_P_A: Array, T_H_E: Array, steps: int) -> tuple[float, Array, Array]:
    cost, damping = float(views.cost(T_P_A, T_H_E)), 1e-3
    normal, gradient = views.normal_equations(T_P_A, T_H_E)
    for _ in range(steps):
        step = np.asarray(np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -gradient), dtype=float)
        moved = T_P_A @ _exponential(step[:6]), T_H_E @ _exponential(step[6:])
        moved_cost = float(views.cost(*moved))
        if not moved_cost < cost:
            damping *= 10
            if damping > _MOST_DAMPING:
                break
            continue
        gain, cost = cost - moved_cost, moved_cost
        (T_P_A, T_H_E), damping = moved, damping / 10
        if gain < _SMALLEST_GAIN:
            break
        normal, gradient = views.normal_equations(T_P_A, T_H_E)
    return cost, T_P_A, T_H_E


def _exponential(step: Array) -> Array:
    return transform(rotation_from_vector(step[3:]), step[:3])


def _log_jacobian(vector: Array) -> Array:
    """d log(exp(vector) exp(w)) / d w at w = 0, (3, 3): the inverse right Jacobian of SO(3)
    (Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", eq. 144).
    """
    angle = float(np.linalg.norm(vector))
    S = skew(vector)
    if angle < 1e-4:
        return np.asarray(np.eye(3) + S / 2 + S @ S / 12)
    factor = 1 / angle**2 - (1 + np.cos(angle)) / (2 * angle * np.sin(angle))
    return np.asarray(np.eye(3) + S / 2 + factor * S @ S)
