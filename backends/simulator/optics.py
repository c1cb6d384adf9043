"""How the lens bends rays."""

from __future__ import annotations

import cv2
import numpy as np

from dualcal_hal.camera import Intrinsics
from dualcal_hal.errors import UsageError
from dualcal_hal.transforms import Array


def undistorted_rays(intrinsics: Intrinsics) -> Array:
    """(height, width, 2): the undistorted normalised coordinates of each pixel's centre, exact to 1e-9 px.

    OpenCV stops at its count of iterations without a word, so the result is checked, and iterated on.
    Raises UsageError if the distortion cannot be undone in some pixel.
    """
    width, height = intrinsics.size
    focal = np.diag(intrinsics.matrix)[:2]
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2).astype(float)
    seen = (pixels - intrinsics.principal_point) / focal
    if not intrinsics.distortion.any():
        return seen.reshape(height, width, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    ideal = cv2.undistortImagePoints(pixels, intrinsics.matrix, intrinsics.distortion, None, criteria)
    rays = (np.asarray(ideal, dtype=float).reshape(-1, 2) - intrinsics.principal_point) / focal
    worst = np.inf
    while True:
        missing = seen - _distorted(rays, intrinsics.distortion)
        previous, worst = worst, float(np.abs(missing * focal).max())
        if worst < 1e-9:
            return rays.reshape(height, width, 2)
        if not worst < 0.9 * previous:
            break
        rays += missing
    raise UsageError("camera.distortion: cannot be undone everywhere in the image; check its coefficients")


def _distorted(rays: Array, distortion: Array) -> Array:
    """Normalised image coordinates (n, 2) as the lens bends them, by OpenCV's k1, k2, p1, p2, k3."""
    k1, k2, p1, p2, k3 = distortion
    x, y = rays[:, 0], rays[:, 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xy = 2.0 * x * y
    return np.stack(
        [x * radial + p1 * xy + p2 * (r2 + 2.0 * x * x), y * radial + p1 * (r2 + 2.0 * y * y) + p2 * xy], axis=-1
    )
