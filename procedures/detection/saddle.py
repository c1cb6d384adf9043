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
    beyond = reach(half)
    base = np.rint(start).astype(int)
    corners = (base - beyond).tolist()
    patches = np.array([image[y : y + 2 * beyond + 1, x : x + 2 * beyond + 1] for x, y in corners], dtype=float)
    fit = _QuadraticFit(half)
    points, found = start.copy(), np.ones(len(start), dtype=bool)
    for _ in range(_MAX_ITERATIONS):
        step, is_saddle = fit.newton_step(patches, points - base)
        points[found] += step[found]
        found &= is_saddle & (np.abs(points - start).max(axis=1) <= MAX_MOVE)
        settled = np.abs(step).max(axis=1) < _SETTLED
        if np.all(settled | ~found):
            break
    return Saddles(points, found & settled)


class _QuadraticFit:
    """The least-squares quadratic to the blurred values on a window of ``half`` px about a point of a patch.

    On a symmetric window 1, x, y, xy and what x^2 and y^2 are beyond their mean are orthogonal, so that each
    coefficient is a sum over columns of a sum over rows; so is the blur, and both are summed at once.
    """

    def __init__(self, half: int) -> None:
        window, taps = np.arange(-half, half + 1), np.arange(-reach(half), reach(half) + 1)
        x = window.astype(float)
        powers = np.stack([np.ones_like(x), x, x * x - np.mean(x * x)], axis=1)
        norms = np.sum(powers**2, axis=0)
        self._norms = norms[:, None] * norms
        self._sigma = BLUR_PER_WINDOW * half
        # The blur's kernel depends on how far a pixel of the patch is from the place in the window. A matrix makes of
        # the kernel (so many distances) what each power takes from each pixel (3 times the patch's side).
        apart = taps[:, None] - window
        self._apart = np.arange(apart.min(), apart.max() + 1)
        shares = np.zeros((len(self._apart), 3, len(taps)))
        shares[apart - self._apart[0], :, np.arange(len(taps))[:, None]] = powers
        self._shares = shares.reshape(len(self._apart), -1)

    def newton_step(self, patches: Array, centres: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Steps (n, 2) from the windows' centres (n, 2), px from the patches' (n, k, k), to the quadratics'
        stationary points, and whether these are saddles (n,)."""
        gaussian = np.exp(-0.5 * ((self._apart - centres[:, :, None]) / self._sigma) ** 2)
        gaussian /= gaussian.sum(axis=-1, keepdims=True)
        kernels = (gaussian.reshape(-1, len(self._apart)) @ self._shares).reshape(len(centres), 2, 3, -1)
        coefficients = np.einsum("nip,njp->nij", kernels[:, 1] @ patches, kernels[:, 0]) / self._norms
        gx, gy, xy = coefficients[:, 0, 1], coefficients[:, 1, 0], coefficients[:, 1, 1]
        xx, yy = coefficients[:, 0, 2], coefficients[:, 2, 0]
        determinant = 4.0 * xx * yy - xy * xy
        is_saddle = determinant < 0
        divisor = np.where(is_saddle, determinant, -np.inf)
        step = np.stack([(xy * gy - 2.0 * yy * gx) / divisor, (xy * gx - 2.0 * xx * gy) / divisor], axis=1)
        return np.clip(step, -1.0, 1.0), is_saddle
