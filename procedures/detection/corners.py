"""What the corners of every kind of target have in common: refined as saddles, in one plane, sharp."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dualcal_hal.camera import Image
from dualcal_hal.transforms import Array
from procedures.detection.appearance import edge_blur
from procedures.detection.outcome import Miss, Refused
from procedures.detection.saddle import Saddles, fit_saddles, reach

BLUR_LIMIT = 3.0
"""px: images with wider edges (Gaussian sigma) are refused."""
CONTRAST_LIMIT = 20.0
"""Grey levels between the black and white squares at every corner."""
PLANE_LIMIT = 0.3
"""px by which a corner may be off the homography of all, if the lens had no distortion ..."""
DISTORTION_ALLOWANCE = 0.01
"""... and how much more in parts of the pattern's diagonal."""


def lattice_points(columns: range | tuple[int, ...], rows: range | tuple[int, ...]) -> Array:
    """(n, 2): (column, row), row by row."""
    return np.array([(column, row) for row in rows for column in columns], dtype=float)


def spacing(grid: Array) -> float:
    """Least distance in px between neighbours in a row, a column or a diagonal of ``grid`` (rows, columns, 2).

    Corners that are NaN are passed over; NaN if no two neighbours are seen.
    """
    neighbours = (
        grid[:, 1:] - grid[:, :-1],
        grid[1:] - grid[:-1],
        grid[1:, 1:] - grid[:-1, :-1],
        grid[1:, :-1] - grid[:-1, 1:],
    )
    lengths = np.linalg.norm(np.concatenate([difference.reshape(-1, 2) for difference in neighbours]), axis=1)
    lengths = lengths[np.isfinite(lengths)]
    return float(lengths.min()) if len(lengths) else float("nan")


def inside(pixels: Array, size: tuple[int, int], margin: float) -> NDArray[np.bool_]:
    """(...) which of ``pixels`` (..., 2) are at least ``margin`` px within an image of (width, height) ``size``."""
    return np.asarray(np.all((pixels >= margin) & (pixels <= np.array(size) - 1 - margin), axis=-1))


def refined(image: Image, start: Array, half: int) -> Saddles:
    """Saddles near ``start`` (n, 2) px, all at least ``reach(half)`` px inside the image, or not found."""
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 0.01)
    moved = cv2.cornerSubPix(image, start.astype(np.float32).reshape(-1, 1, 2), (half, half), (-1, -1), criteria)
    near = np.asarray(moved, dtype=float).reshape(-1, 2)
    size = (image.shape[1], image.shape[0])
    # A corner that went astray stays where it was, and will be no saddle there.
    usable = inside(near, size, reach(half)) & np.all(np.abs(near - start) <= half, axis=1)
    return fit_saddles(image, np.where(usable[:, None], near, start), half)


def homography(lattice: Array, corners: Array) -> Array:
    """(3, 3): lattice coordinates (n, 2) to px (n, 2), by least squares; Refused if they span no plane."""
    found, _ = cv2.findHomography(lattice, corners, method=0)
    if found is None:
        raise Refused(Miss.NOT_FOUND, "the candidate's corners do not span a plane")
    return np.asarray(found, dtype=float)


def mapped(transformation: Array, points: Array) -> Array:
    """``points`` (n, 2) under a homography (3, 3)."""
    return np.asarray(cv2.perspectiveTransform(points.reshape(-1, 1, 2), transformation), dtype=float).reshape(-1, 2)


def off_plane(plane: Array, lattice: Array, corners: Array) -> Array:
    """(n,) px by which each corner is off the ``plane``, the homography of all, beyond what the lens may do."""
    off = np.linalg.norm(mapped(plane, lattice) - corners, axis=1)
    diagonal = float(np.linalg.norm(np.ptp(corners, axis=0)))
    return np.asarray(off - PLANE_LIMIT - DISTORTION_ALLOWANCE * diagonal)


def checked_blur(image: Image, grid: Array, reach_px: float) -> float:
    """Sigma in px of the edges between the corners ``grid`` (rows, columns, 2); Refused if they are too wide."""
    blur = edge_blur(image, grid, reach_px)
    if blur > BLUR_LIMIT:
        raise Refused(
            Miss.BLURRED,
            f"the edges are {blur:.1f} px wide (sigma), {BLUR_LIMIT:g} at most; focus the camera,"
            " or let the arms settle for longer",
        )
    return blur
