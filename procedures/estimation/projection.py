"""A pinhole camera with OpenCV's five distortion coefficients (k1, k2, p1, p2, k3), in plain numpy.

``matrix`` is (3, 3) without skew, in px; pixel centres are integers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.transforms import Array

_PRECISION = 1e-12
_MOST_STEPS = 50


def project(points: ArrayLike, matrix: ArrayLike, distortion: ArrayLike) -> Array:
    """Points (..., 3) in the camera frame, m, to pixels (..., 2); NaN for points not in front of the camera."""
    return _pixels(distort(_normalised(points), distortion), np.asarray(matrix, dtype=float))


def project_with_jacobian(points: ArrayLike, matrix: ArrayLike, distortion: ArrayLike) -> tuple[Array, Array]:
    """As :func:`project`, with d pixel / d point (..., 2, 3) in px/m."""
    matrix = np.asarray(matrix, dtype=float)
    x = _normalised(points)
    depth = np.asarray(points, dtype=float)[..., 2]
    focal = np.array([matrix[0, 0], matrix[1, 1]])
    d_normalised = focal[:, None] * distortion_jacobian(x, distortion) / depth[..., None, None]
    towards_depth = -np.sum(d_normalised * x[..., None, :], axis=-1, keepdims=True)
    pixels = _pixels(distort(x, distortion), matrix)
    return pixels, np.concatenate([d_normalised, towards_depth], axis=-1)


def undistort(pixels: ArrayLike, matrix: ArrayLike, distortion: ArrayLike) -> Array:
    """Pixels (..., 2) of the distorted image to normalised undistorted coordinates (..., 2), to 1e-12.

    Newton's method from the distorted coordinates, which for a radial distortion runs monotonically to the
    solution next to the image centre. Raises ValueError for a pixel that no point is seen at.
    """
    matrix = np.asarray(matrix, dtype=float)
    focal, centre = np.array([matrix[0, 0], matrix[1, 1]]), matrix[:2, 2]
    goal: Array = (np.asarray(pixels, dtype=float) - centre) / focal
    x = goal.copy()
    with np.errstate(over="ignore", invalid="ignore"):  # where there is no solution, the steps run away
        for _ in range(_MOST_STEPS):
            slope = distortion_jacobian(x, distortion)
            step = np.linalg.solve(slope, (goal - distort(x, distortion))[..., None])[..., 0]
            x += step
            if np.all(np.abs(step) < _PRECISION) and np.all(np.linalg.det(slope) > 0):
                return x
    raise ValueError("a pixel lies outside the image of this distortion: no point is seen there")


def distort(x: ArrayLike, distortion: ArrayLike) -> Array:
    """Normalised coordinates (..., 2) to distorted ones."""
    x = np.asarray(x, dtype=float)
    k1, k2, p1, p2, k3 = np.asarray(distortion, dtype=float)
    u, v = x[..., 0], x[..., 1]
    r2 = u * u + v * v
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u),
            v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v,
        ],
        axis=-1,
    )


def distortion_jacobian(x: ArrayLike, distortion: ArrayLike) -> Array:
    """Derivative of :func:`distort` at normalised coordinates (..., 2), as (..., 2, 2)."""
    x = np.asarray(x, dtype=float)
    k1, k2, p1, p2, k3 = np.asarray(distortion, dtype=float)
    u, v = x[..., 0], x[..., 1]
    r2 = u * u + v * v
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
    J = np.empty((*r2.shape, 2, 2))
    J[..., 0, 0] = radial + u * u * slope + 2 * p1 * v + 6 * p2 * u
    J[..., 1, 1] = radial + v * v * slope + 6 * p1 * v + 2 * p2 * u
    J[..., 0, 1] = J[..., 1, 0] = u * v * slope + 2 * p1 * u + 2 * p2 * v
    return np.asarray(J)


def _normalised(points: ArrayLike) -> Array:
    points = np.asarray(points, dtype=float)
    depth = np.where(points[..., 2] > 0, points[..., 2], np.nan)
    return np.asarray(points[..., :2] / depth[..., None])


def _pixels(distorted: Array, matrix: Array) -> Array:
    return np.asarray(distorted * np.array([matrix[0, 0], matrix[1, 1]]) + matrix[:2, 2])
