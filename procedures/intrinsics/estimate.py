"""Camera matrix and distortion from views of a plane (Z. Zhang, A Flexible New Technique for Camera Calibration, 2000).

OpenCV finds the least-squares solution; sigmas are worked out here, as its own do not count each corner as two
measurements in all versions, nor say how the parameters go together. The arms' joint angles are no part of it: errors
of their kinematics shall not become errors of the lens.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray
from scipy.special import chdtrc

from dualcal_hal.camera import Intrinsics
from dualcal_hal.errors import DegenerateCaptures
from dualcal_hal.target import Target
from dualcal_hal.transforms import Array, transform

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""The parameters in the order of arrays of them; the first four in px."""

SIGNIFICANT = 2.0
"""A coefficient of the lens below so many of its sigmas cannot be told from zero; several by the same chance."""

LEAST_VIEWS = 6
"""Views below which nothing is estimated."""

LEAST_CORNERS = 6
"""Corners that a view must show: four more numbers than its pose takes, as the lens is sought too."""

_STRAY = 4.0
"""A view counts as gone astray when its rms is above so many times the median of all ..."""
_STRAY_PX = 0.1
"""... and above this."""
_MOST_STRAY = 0.2
"""Share of the views that may go astray; more are not left out, and the rms tells."""

_MATRIX, _COEFFICIENTS = slice(0, 4), slice(4, 9)
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
_RADIAL: tuple[tuple[str, ...], ...] = ((), ("k3",), ("k2", "k3"), ("k1", "k2", "k3"))
_TANGENTIAL: tuple[tuple[str, ...], ...] = ((), ("p1", "p2"))
_FIXABLE = [pair for pair in itertools.product(_RADIAL, _TANGENTIAL) if any(pair)]
_FLAGS = {"k1": cv2.CALIB_FIX_K1, "k2": cv2.CALIB_FIX_K2, "k3": cv2.CALIB_FIX_K3, "p1": cv2.CALIB_FIX_TANGENT_DIST}
_NOT_INVERTIBLE = 1e12


@dataclass(frozen=True, eq=False)
class Estimate:
    """What the views say.

    covariance: (9, 9) of the parameters in the order of NAMES with all of them free, from the residuals' own scatter;
    fixed: names of those coefficients that are zero because nothing tells them from it; poses: (k, 4, 4) ``T_E_T``, NaN
    for a view that was left out; residuals: (k, n, 2) px, seen less explained, NaN for a corner that was not seen; rms:
    px per axis over the views used; view_rms: (k,) px per axis, of the views left out too; used: (k,).
    """

    intrinsics: Intrinsics
    covariance: Array
    fixed: tuple[str, ...]
    poses: Array
    residuals: Array
    rms: float
    view_rms: Array
    used: NDArray[np.bool_]

    @property
    def sigma(self) -> Array:
        """(9,) of the parameters in the order of NAMES; of one that is fixed, how far from zero it may yet be."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def estimate(corners: Sequence[Array], board: Target, start: Intrinsics) -> Estimate:
    """Intrinsics that explain the corners (n, 2) px of each view, NaN where one was not seen.

    ``start`` may be off by several per cent and without distortion. What cannot be told from zero is fixed there: of
    k1, k2, k3 from the last on, and p1 with p2. Views far worse than the rest are left out, at most a fifth of them.
    Raises DegenerateCaptures for too few views, or views that determine no camera.
    """
    seen = np.array([np.isfinite(view).all(axis=1) for view in corners]).reshape(len(corners), len(board.corners))
    used = seen.sum(axis=1) >= LEAST_CORNERS
    if used.sum() < LEAST_VIEWS:
        raise DegenerateCaptures(
            f"intrinsics: {used.sum()} of {len(corners)} views show {LEAST_CORNERS} corners or more,"
            f" {LEAST_VIEWS} such views are needed"
        )
    views = _Views(np.stack(corners), seen, board, start.size)
    full = views.solve(used, start, ())
    while (stray := _stray(full, used)) is not None:
        used = used & (np.arange(len(used)) != stray)
        full = views.solve(used, start, ())
    fixed = _not_to_be_told(full)
    if not fixed:
        return full
    # What is zero for want of knowledge is not known to be zero: the others may be wrong by what it may be.
    return replace(views.solve(used, full.intrinsics, fixed), covariance=full.covariance)


def _stray(solution: Estimate, used: NDArray[np.bool_]) -> int | None:
    """The worst view, if it is far worse than the rest and not too many have been left out."""
    rms = np.where(used, solution.view_rms, 0.0)
    limit = max(_STRAY_PX, _STRAY * float(np.median(solution.view_rms[used])))
    may_go = used.sum() - 1 >= max(LEAST_VIEWS, (1 - _MOST_STRAY) * len(used))
    return int(np.argmax(rms)) if may_go and rms.max() > limit else None


def _not_to_be_told(full: Estimate) -> tuple[str, ...]:
    """The most coefficients that may all be zero together: of the radial ones the higher powers first, as they mean
    little without the lower, and the tangential ones together (Wald's test)."""
    value = parameters(full.intrinsics)
    for radial, tangential in sorted(_FIXABLE, key=lambda pair: -len(pair[0]) - len(pair[1])):
        names = (*radial, *tangential)
        i = [NAMES.index(name) for name in names]
        square = value[i] @ np.linalg.solve(full.covariance[np.ix_(i, i)], value[i])
        if chdtrc(len(i), square) > chdtrc(1, SIGNIFICANT**2):
            return names
    return ()


def parameters(intrinsics: Intrinsics) -> Array:
    """(9,) in the order of NAMES."""
    matrix = intrinsics.matrix
    return np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *intrinsics.distortion])


def information(T_E_T: Array, points: Array, intrinsics: Intrinsics) -> Array:
    """(9, 9): what the corners at ``points`` (n, 3) in T say of the parameters, for a sigma of 1 px per axis.

    Their pose is not known and found from the same corners (Schur's complement takes it out).
    """
    rotation, _ = cv2.Rodrigues(T_E_T[:3, :3])
    return _information(_jacobian(rotation, T_E_T[:3, 3], points, intrinsics))


def _jacobian(rotation: MatLike, translation: MatLike, points: Array, intrinsics: Intrinsics) -> Array:
    """(2n, 15): of the pixels, by the pose (6), then by the parameters in the order of NAMES."""
    _, J = cv2.projectPoints(points, rotation, translation, intrinsics.matrix, intrinsics.distortion)
    return np.asarray(J[:, :15], dtype=float)


def _information(J: Array) -> Array:
    pose, of_camera = J[:, :6], J[:, 6:]
    across = pose.T @ of_camera
    return np.asarray(of_camera.T @ of_camera - across.T @ np.linalg.pinv(pose.T @ pose) @ across)


@dataclass(frozen=True, eq=False)
class _Views:
    """corners: (k, n, 2) px; seen: (k, n)."""

    corners: Array
    seen: NDArray[np.bool_]
    board: Target
    size: tuple[int, int]

    def solve(self, used: NDArray[np.bool_], start: Intrinsics, fixed: tuple[str, ...]) -> Estimate:
        """Of the ``used`` views (k,)."""
        chosen = np.flatnonzero(used)
        flags = cv2.CALIB_USE_INTRINSIC_GUESS | sum(_FLAGS.get(name, 0) for name in fixed)
        distortion = np.where(np.isin(NAMES[_COEFFICIENTS], fixed), 0.0, start.distortion)
        objects = [self.board.corners[self.seen[i]].astype(np.float32) for i in chosen]
        pixels = [self.corners[i][self.seen[i]].astype(np.float32) for i in chosen]
        try:
            _, matrix, distortion, rotations, translations = cv2.calibrateCamera(
                objects, pixels, self.size, start.matrix.copy(), distortion, flags=flags, criteria=_CRITERIA
            )
        except cv2.error as error:
            raise DegenerateCaptures(f"intrinsics: the views determine no camera: {error.err}") from error
        intrinsics = Intrinsics(np.asarray(matrix, dtype=float), np.ravel(distortion)[:5].astype(float), self.size)
        if not all(np.all(np.isfinite(values)) for values in (matrix, distortion, rotations, translations)):
            raise DegenerateCaptures("intrinsics: the views determine no camera")
        poses = np.full((len(used), 4, 4), np.nan)
        for i, rotation, translation in zip(chosen, rotations, translations, strict=True):
            poses[i] = transform(cv2.Rodrigues(rotation)[0], np.ravel(translation))
        return self._judged(intrinsics, poses, used, fixed)

    def _judged(
        self, intrinsics: Intrinsics, poses: Array, used: NDArray[np.bool_], fixed: tuple[str, ...]
    ) -> Estimate:
        residuals = np.full_like(self.corners, np.nan)
        total = np.zeros((len(NAMES), len(NAMES)))
        for i in np.flatnonzero(self.seen.sum(axis=1) >= 4):
            points, pixels = self.board.corners[self.seen[i]], self.corners[i][self.seen[i]]
            if used[i]:
                rotation, translation = cv2.Rodrigues(poses[i, :3, :3])[0], poses[i, :3, 3]
                total += _information(_jacobian(rotation, translation, points, intrinsics))
            else:
                rotation, translation = _pose(points, pixels, intrinsics)
            explained, _ = cv2.projectPoints(points, rotation, translation, intrinsics.matrix, intrinsics.distortion)
            residuals[i][self.seen[i]] = pixels - explained.reshape(-1, 2)
        squares = np.nansum(residuals[used] ** 2)
        measured = 2 * int(self.seen[used].sum())
        free = np.array([name not in fixed for name in NAMES])
        unknowns = 6 * int(used.sum()) + int(free.sum())
        if measured <= unknowns:
            raise DegenerateCaptures(f"intrinsics: {measured} coordinates of corners for {unknowns} unknowns")
        covariance = np.zeros_like(total)
        covariance[np.ix_(free, free)] = squares / (measured - unknowns) * _inverted(total[np.ix_(free, free)])
        view_rms = np.sqrt(np.nanmean(residuals**2, axis=(1, 2), where=self.seen[..., None]))
        return Estimate(
            intrinsics, covariance, fixed, poses, residuals, float(np.sqrt(squares / measured)), view_rms, used
        )


def _pose(points: Array, pixels: Array, intrinsics: Intrinsics) -> tuple[Array, Array]:
    _, rotation, translation = cv2.solvePnP(
        points, pixels, intrinsics.matrix, intrinsics.distortion, flags=cv2.SOLVEPNP_IPPE
    )
    return np.asarray(rotation), np.asarray(translation)


def _inverted(total: Array) -> Array:
    """The inverse of an information matrix; DegenerateCaptures where it has none."""
    scale = np.sqrt(np.diag(total))
    if not np.all(scale > 0):
        raise DegenerateCaptures("intrinsics: the views say nothing of some parameter; show the target tilted")
    scaled = total / np.outer(scale, scale)
    if np.linalg.cond(scaled) > _NOT_INVERTIBLE:
        raise DegenerateCaptures("intrinsics: the views do not tell the parameters apart; show the target tilted")
    return np.asarray(np.linalg.inv(scaled) / np.outer(scale, scale))
