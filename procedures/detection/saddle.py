"""Checkerboard corners as saddle points of the grey values.

A quadratic is fitted by least squares to the Gaussian-blurred image on a square window around each corner, and
the window is moved to the quadratic's saddle until it stays. The window then lies symmetrically about the
corner, and so does the ideal corner's image: what the quadratic does not model cancels. Blurred values between
pixels are taken from the pixels directly with the shifted Gaussian, without interpolation, which would pull
corners towards the pixel grid (as it does in ``cv2.cornerSubPix``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from dualcal_hal.camera import Image
from dualcal_hal.transforms import Array

LARGEST_WINDOW = 7
SMALLEST_WINDOW = 2
BLUR_PER_WINDOW = 0.4
"""Sigma of the smoothing in half-windows: 2.8 px for the largest window."""
MAX_MOVE = 2.0
"""px from the start; a corner further away is another one."""
_SETTLED = 1e-3  # px; a tenth of what noise does
_MAX_ITERATIONS = 25


@dataclass(frozen=True, eq=False)
class Saddles:
    """points: (n, 2) px; found: (n,) whether a saddle was reached within ``MAX_MOVE`` of the start."""

    points: Array
    found: NDArray[np.bool_]


def half_window(spacing: float) -> int:
    """Half-window in px for corners at least ``spacing`` px apart: it must not reach into the next corner."""
    return int(np.clip(spacing / 2.5, SMALLEST_WINDOW, LARGEST_WINDOW))


def reach(half: int) -> int:
    """Pixels needed on each side of a start for a half-window of ``half`` px."""
    return half + math.ceil(4.0 * BLUR_PER_WINDOW * half + MAX_MOVE)


def fit_saddles(image: Image, start: Array, half: int) -> Saddles:
    """Saddle points near ``start`` (n, 2) px, each at least ``reach(half)`` px inside the image."""
    taps = np.arange(-reach(half), reach(half) + 1)
    base = np.rint(start).astype(int)
    rows, columns = base[:, 1, None, None] + taps[:, None], base[:, 0, None, None] + taps
    patches = image[rows, columns].astype(float)
    quadratic = _quadratic_fit(half)
    points, found = start.copy(), np.ones(len(start), dtype=bool)
    for _ in range(_MAX_ITERATIONS):
        step, is_saddle = _newton_step(patches, points - base, half, quadratic)
        points[found] += step[found]
        found &= is_saddle & (np.abs(points - start).max(axis=1) <= MAX_MOVE)
        settled = np.abs(step).max(axis=1) < _SETTLED
        if np.all(settled | ~found):
            break
    return Saddles(points, found & settled)


def _quadratic_fit(half: int) -> Array:
    """(6, (2 half + 1)^2): a window's values to the coefficients of 1, x, y, x^2, xy, y^2."""
    y, x = (part.ravel() for part in np.mgrid[-half : half + 1, -half : half + 1].astype(float))
    return np.linalg.pinv(np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1))


def _newton_step(patches: Array, centres: Array, half: int, quadratic: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Steps (n, 2) from the windows' centres (n, 2) to the fitted quadratics' stationary points, and whether
    these are saddles (n,)."""
    taps = patches.shape[-1]
    offsets = np.arange(taps + 2 * half) - (taps // 2 + half)
    gaussian = np.exp(-0.5 * ((offsets - centres[:, :, None]) / (BLUR_PER_WINDOW * half)) ** 2)
    gaussian /= gaussian.sum(axis=-1, keepdims=True)
    # Contiguous, for the products below take twice as long on views.
    kernels = np.ascontiguousarray(sliding_window_view(gaussian, taps, axis=-1)[:, :, ::-1])
    windows = kernels[:, 1] @ patches @ np.swapaxes(kernels[:, 0], 1, 2)
    _, gx, gy, xx, xy, yy = quadratic @ windows.reshape(len(centres), -1).T
    determinant = 4.0 * xx * yy - xy * xy
    is_saddle = determinant < 0
    divisor = np.where(is_saddle, determinant, -np.inf)
    step = np.stack([(xy * gy - 2.0 * yy * gx) / divisor, (xy * gx - 2.0 * xx * gy) / divisor], axis=1)
    return np.clip(step, -1.0, 1.0), is_saddle
