"""How the lens bends rays."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from dualcal_hal.camera import Intrinsics
from dualcal_hal.errors import UsageError
from dualcal_hal.transforms import Array

if TYPE_CHECKING:
    from dualcal_hal.config.image_errors import ImageErrorsConfig

_OF_THE_LENS = ("focal", "principal_point", "distortion_residual")


def true_intrinsics(intrinsics: Intrinsics, errors: ImageErrorsConfig) -> Intrinsics:
    """The camera as it is, of which the cell file says ``intrinsics``."""
    focal, centre = errors.focal, errors.principal_point
    matrix = intrinsics.matrix.copy()
    matrix[:2, :2] *= np.array([1.0 + focal.x_ppm * 1e-6, 1.0 + focal.y_ppm * 1e-6])
    matrix[:2, 2] += centre.right_px, centre.down_px
    distortion = intrinsics.distortion.copy()
    distortion[0] += _residual_k1(intrinsics, errors.distortion_residual.corner_px)
    return Intrinsics(matrix, distortion, intrinsics.size)


def _residual_k1(intrinsics: Intrinsics, displacement: float) -> float:
    """The change of k1 that moves what is seen in the farthest corner of the image outwards by so many px."""
    if displacement == 0.0:
        return 0.0
    width, height = intrinsics.size
    corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], dtype=float)
    rays = undistorted(corners, intrinsics)
    per_k1 = np.sum(rays**2, axis=1) * np.linalg.norm(rays * np.diag(intrinsics.matrix)[:2], axis=1)
    return displacement / float(per_k1.max())


def true_rays(intrinsics: Intrinsics, errors: ImageErrorsConfig) -> Array:
    """(height, width, 2): :func:`undistorted_rays` of the camera as it is, of which the cell file says ``intrinsics``.

    Raises UsageError that names the errors where it is they that bend rays too far.
    """
    try:
        return undistorted_rays(true_intrinsics(intrinsics, errors))
    except UsageError as error:
        undistorted_rays(intrinsics)
        named = " and ".join(f"simulation.errors.{name}" for name in _OF_THE_LENS if name in errors.model_fields_set)
        raise UsageError(f"{named}: distortion could not be undone everywhere in the image; make it smaller") from error


def undistorted_rays(intrinsics: Intrinsics) -> Array:
    """(height, width, 2): the undistorted normalised coordinates of each pixel's centre, as :func:`undistorted`."""
    width, height = intrinsics.size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2).astype(float)
    return undistorted(pixels, intrinsics).reshape(height, width, 2)


def undistorted(pixels: Array, intrinsics: Intrinsics) -> Array:
    """(n, 2): the undistorted normalised coordinates of ``pixels`` (n, 2), exact to 1e-9 px.

    OpenCV stops at its count of iterations without a word, so the result is checked, and iterated on.
    Raises UsageError if the distortion cannot be undone in some pixel.
    """
    focal = np.diag(intrinsics.matrix)[:2]
    seen = (pixels - intrinsics.principal_point) / focal
    if not intrinsics.distortion.any():
        return np.asarray(seen)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    ideal = cv2.undistortImagePoints(pixels, intrinsics.matrix, intrinsics.distortion, None, criteria)
    rays = (np.asarray(ideal, dtype=float).reshape(-1, 2) - intrinsics.principal_point) / focal
    worst = np.inf
    while True:
        missing = seen - _distorted(rays, intrinsics.distortion)
        previous, worst = worst, float(np.abs(missing * focal).max())
        if worst < 1e-9:
            return np.asarray(rays)
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
