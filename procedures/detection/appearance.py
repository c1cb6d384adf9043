"""What a checkerboard looks like: black and white in turn, with edges of some sharpness."""

from __future__ import annotations

import statistics

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from dualcal_hal.camera import Image
from dualcal_hal.transforms import Array

TO_QUADRANT = 0.3
"""Squares from a corner, in each direction, to where its four squares are looked at."""

_NEAR_ENDS = np.array([0.25, 0.75])
_BOTH_SIDES = np.array([-1.0, 1.0])


def sample(image: Image, pixels: Array) -> Array:
    """Grey values (...) at ``pixels`` (..., 2), bilinear; the image's edge goes on outside."""
    x, y = pixels[..., 0], pixels[..., 1]
    return np.asarray(map_coordinates(image, [y, x], order=1, mode="nearest", output=float))


def quadrants(apart: float = TO_QUADRANT) -> Array:
    """(4, 2): where from a corner its four squares are looked at, the two of one colour first."""
    return apart * np.array([[-1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [1.0, -1.0]])


def contrast(image: Image, homography: Array, lattice: Array, apart: float = TO_QUADRANT) -> Array:
    """White minus black around each lattice point, in grey levels (n,), looked at ``apart`` squares from it.

    homography: (3, 3) from lattice coordinates (column, row) to px; lattice: (n, 2). The contrast has one sign
    all over a checkerboard, halves at its rim and vanishes in expectation off it.
    """
    places = (lattice[:, None] + quadrants(apart)).reshape(-1, 1, 2)
    pixels = np.asarray(cv2.perspectiveTransform(places, homography), dtype=float)
    grey = sample(image, pixels.reshape(-1, 4, 2))
    parity = 1.0 - 2.0 * (np.rint(lattice).sum(axis=1) % 2)
    return np.asarray(parity * (grey @ np.array([0.5, 0.5, -0.5, -0.5])))


def gap(image: Image, grid: Array) -> float:
    """How far the lines between the corners ``grid`` (rows, columns, 2) px are from the middle grey, at worst.

    In parts of white minus black of the two squares beside the line: nothing where squares share an edge, a
    half where dark spots with gaps between them pass for squares.
    """
    lines = [_inner_lines(grid), _inner_lines(np.swapaxes(grid, 0, 1))]
    start, along, across = (np.concatenate(parts)[:, None] for parts in zip(*lines, strict=True))
    on_edge = start + _NEAR_ENDS[:, None] * along
    beside = start + 0.5 * along + _BOTH_SIDES[:, None] * across
    grey = sample(image, np.stack([on_edge, beside]))
    sides = grey[1]
    off = np.abs(grey[0] - sides.mean(axis=-1, keepdims=True))
    height = np.maximum(np.ptp(sides, axis=-1, keepdims=True), 1.0)
    return float((off / height).max())


def _inner_lines(grid: Array) -> tuple[Array, Array, Array]:
    """The lines along the rows but the outer ones: their starts, where they lead and how far to look beside (m, 2)."""
    start, along = grid[1:-1, :-1], grid[1:-1, 1:] - grid[1:-1, :-1]
    across = 0.5 * TO_QUADRANT * (grid[2:, :-1] - grid[:-2, :-1])
    return start.reshape(-1, 2), along.reshape(-1, 2), across.reshape(-1, 2)


def edge_blur(image: Image, grid: Array, reach: float) -> float:
    """Gaussian sigma in px that makes edges as wide as those between the corners ``grid`` (rows, columns, 2).

    From height and steepest slope of the mean profile across each edge, over ``reach`` px to both sides; the median
    of the edges of one direction, for the direction that is blurred more (motion blurs one). It includes about 0.5 px
    of the pixels themselves; blur beyond about 0.8 of ``reach`` is underestimated. Corners that are NaN are passed
    over; NaN if no two neighbours are seen.
    """
    starts = [grid[:, :-1].reshape(-1, 2), grid[:-1].reshape(-1, 2)]
    ends = [grid[:, 1:].reshape(-1, 2), grid[1:].reshape(-1, 2)]
    widths = _edge_widths(image, np.concatenate(starts), np.concatenate(ends), reach)
    along_rows, along_columns = widths[: len(starts[0])], widths[len(starts[0]) :]
    seen = [along[np.isfinite(along)] for along in (along_rows, along_columns)]
    return max((statistics.median(widths.tolist()) for widths in seen if len(widths)), default=float("nan"))


def _edge_widths(image: Image, start: Array, end: Array, reach: float) -> Array:
    """Gaussian sigma (n,) px across the straight edges from ``start`` to ``end`` (n, 2) px, NaN where one is NaN."""
    half = np.clip(np.floor(reach), 2.0, 10.0)
    across = np.arange(-half, half + 1.0)
    along = np.linspace(0.3, 0.7, 9)
    widths = np.full(len(start), np.nan)
    seen = np.isfinite(start[:, 0] + end[:, 0])
    start, edge = start[seen], (end - start)[seen]
    normal = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    on_edge = start[:, None] + along[:, None] * edge[:, None]
    profile = sample(image, on_edge[:, :, None] + across[:, None] * normal[:, None, None]).mean(axis=1)
    height = np.abs(profile[:, -1] - profile[:, 0])
    slope = np.abs(np.diff(profile, axis=1)).max(axis=1)
    widths[seen] = height / (np.sqrt(2.0 * np.pi) * np.maximum(slope, np.finfo(float).tiny))
    return widths
