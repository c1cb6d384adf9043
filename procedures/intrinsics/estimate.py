"""Camera matrix and distortion from views of a plane (Z. Zhang, A Flexible New Technique for Camera Calibration, 2000).

The arms' joint angles are no part of it: errors of their kinematics shall not become errors of the lens.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from dualcal_hal.camera import Intrinsics
from dualcal_hal.errors import DegenerateCaptures
from dualcal_hal.target import Target
from dualcal_hal.transforms import Array, rotation_from_vector, transform, vector_from_rotation
from procedures.detection import board_poses
from procedures.intrinsics.adjustment import Adjusted, SeenCorners, adjust, information, project_with_jacobian

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

_RADIAL: tuple[tuple[str, ...], ...] = ((), ("k3",), ("k2", "k3"), ("k1", "k2", "k3"))
_TANGENTIAL: tuple[tuple[str, ...], ...] = ((), ("p1", "p2"))
_FIXABLE = [pair for pair in itertools.product(_RADIAL, _TANGENTIAL) if any(pair)]
_TURNS = 3
"""Times that views are looked at for whether the target leans the other way, which from afar looks nearly the same."""
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


def information_of(T_E_T: Array, points: Array, intrinsics: Intrinsics) -> Array:
    """(9, 9): what the corners at ``points`` (n, 3) in T say of the parameters, for a sigma of 1 px per axis."""
    return information(project_with_jacobian(points, _pose_of(T_E_T), parameters(intrinsics))[1])


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
        free = np.array([name not in fixed for name in NAMES])
        views = [self._seen(int(i)) for i in chosen]
        found = Adjusted(np.where(free, parameters(start), 0.0), self._poses(chosen, start))
        for _ in range(_TURNS):
            found = adjust(views, found, free)
            turned = self._poses(chosen, self._intrinsics(found.parameters))
            better = (
                self._squares(views, found.parameters, turned)
                < self._squares(views, found.parameters, found.poses) * _TURNED
            )
            if not np.any(better):
                break
            found = Adjusted(found.parameters, np.where(better[:, None], turned, found.poses))
        every = np.full((len(used), _POSE_NUMBERS), np.nan)
        every[chosen] = found.poses
        return self._judged(self._intrinsics(found.parameters), every, used, fixed)

    def _seen(self, i: int) -> SeenCorners:
        return SeenCorners(self.board.corners[self.seen[i]], self.corners[i][self.seen[i]])

    def _poses(self, chosen: NDArray[np.intp], camera: Intrinsics) -> Array:
        """(k, 6) of the better of the poses that each view has for itself."""
        return np.array([_pose_of(board_poses(self.corners[i], self.board, camera)[0][0]) for i in chosen])

    def _squares(self, views: Sequence[SeenCorners], camera: Array, poses: Array) -> Array:
        return np.array([np.sum(_residuals(view, pose, camera) ** 2) for view, pose in zip(views, poses, strict=True)])

    def _intrinsics(self, values: Array) -> Intrinsics:
        fx, fy, cx, cy = values[:4]
        return Intrinsics(np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), values[4:].copy(), self.size)

    def _judged(
        self, intrinsics: Intrinsics, poses: Array, used: NDArray[np.bool_], fixed: tuple[str, ...]
    ) -> Estimate:
        camera = parameters(intrinsics)
        residuals, total = np.full_like(self.corners, np.nan), np.zeros((len(NAMES), len(NAMES)))
        view_rms = np.full(len(used), np.nan)
        for i in np.flatnonzero(self.seen.sum(axis=1) >= LEAST_CORNERS):
            view = self._seen(int(i))
            if used[i]:
                total += information(project_with_jacobian(view.points, poses[i], camera)[1])
            pose = poses[i] if used[i] else self._poses(np.array([i]), intrinsics)[0]
            left = _residuals(view, pose, camera)
            residuals[i][self.seen[i]] = left
            view_rms[i] = np.sqrt(np.mean(left**2))
        squares = float(np.nansum(residuals[used] ** 2))
        measured = 2 * int(self.seen[used].sum())
        free = np.array([name not in fixed for name in NAMES])
        unknowns = _POSE_NUMBERS * int(used.sum()) + int(free.sum())
        if measured <= unknowns:
            raise DegenerateCaptures(f"intrinsics: {measured} coordinates of corners for {unknowns} unknowns")
        covariance = np.zeros_like(total)
        covariance[np.ix_(free, free)] = squares / (measured - unknowns) * _inverted(total[np.ix_(free, free)])
        T_E_T = np.full((len(used), 4, 4), np.nan)
        T_E_T[used] = transform(rotation_from_vector(poses[used, :3]), poses[used, 3:])
        rms = float(np.sqrt(squares / measured))
        return Estimate(intrinsics, covariance, fixed, T_E_T, residuals, rms, view_rms, used)


_POSE_NUMBERS = 6
_TURNED = 0.9
"""Of its squares, that a view must come to by leaning the other way."""


def _residuals(view: SeenCorners, pose: Array, camera: Array) -> Array:
    """(n, 2) px, seen less explained."""
    return np.asarray(view.pixels - project_with_jacobian(view.points, pose, camera)[0])


def _pose_of(T_E_T: Array) -> Array:
    """(6,) rotation vector and translation."""
    return np.concatenate([vector_from_rotation(T_E_T[:3, :3]), T_E_T[:3, 3]])


def _inverted(total: Array) -> Array:
    """The inverse of an information matrix; DegenerateCaptures where it has none."""
    scale = np.sqrt(np.diag(total))
    if not np.all(scale > 0):
        raise DegenerateCaptures("intrinsics: the views say nothing of some parameter; show the target tilted")
    scaled = total / np.outer(scale, scale)
    if np.linalg.cond(scaled) > _NOT_INVERTIBLE:
        raise DegenerateCaptures("intrinsics: the views do not tell the parameters apart; show the target tilted")
    return np.asarray(np.linalg.inv(scaled) / np.outer(scale, scale))
