"""Finding a ChArUco board: its markers tell where its corners are, whichever of them are in view."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from dualcal_hal.camera import Image
from dualcal_hal.target import Charuco
from dualcal_hal.transforms import Array
from procedures.detection.appearance import TO_QUADRANT, contrast
from procedures.detection.corners import (
    CONTRAST_LIMIT,
    checked_blur,
    homography,
    inside,
    lattice_points,
    mapped,
    off_plane,
    refined,
    spacing,
)
from procedures.detection.exposure import around, raise_light_problem
from procedures.detection.outcome import Detection, Miss, Refused, Region
from procedures.detection.saddle import LARGEST_WINDOW, SMALLEST_WINDOW, reach

FEWEST_CORNERS = 4
"""Corners that make a pose of the board."""
SMALLEST_BIT = 4.0
"""px of a marker's bit below which a blur of 1.5 px hides some; in sharp images 2 px are enough."""
_NEAREST = 4  # markers from which a corner's place is told; a lens bends the rest of the plane too much
_ADJACENT = 1.0  # squares from a marker's middle, within which a corner counts as told by it
_MARKER_OFF = 0.1  # squares by which a marker's corner may be off the plane of the others
_WINDOW = 0.4  # half-window of the saddle fit in parts of the way to the markers' bits, which disturb it


class CharucoFinder:
    """Finds one board, in part or whole."""

    def __init__(self, board: Charuco) -> None:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        self._markers = cv2.aruco.ArucoDetector(dictionary)
        self._board = board
        self._lattice = lattice_points(range(board.columns), range(board.rows))
        # In squares from the first inner corner, like the lattice: the markers' corners clockwise from the top left.
        half = 0.5 * board.marker / board.square
        ends = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        self._middles = board.marker_squares - 0.5
        self._marker_corners = self._middles[:, None] + ends
        self._gap = 0.5 - half
        self._bits = dictionary.markerSize + 2
        self._to_bits = self._gap + board.marker / board.square / self._bits
        self._sign = 1.0 if board.white_first else -1.0

    def searches(self, size: tuple[int, int], near: Region | None, step: float) -> Iterator[tuple[Region, int]]:
        """Regions to search, each with the scale for it, the quickest first."""
        if near is not None:
            yield near, 1
        yield (0, 0, *size), 1

    def find(self, image: Image, region: Region, scale: int, predicted: Array | None) -> Detection:
        """What is seen of the board within the region; raises Refused if too little, or nothing that is usable."""
        ids, pixels = self._find_markers(image, region)
        told = self._told(ids, pixels)
        size = (image.shape[1], image.shape[0])
        half = self._half_window(told)
        usable = np.where(inside(told, size, reach(half))[:, None], told, np.nan)
        corners, weakest = self._checked(image, self._refined(image, usable, half))
        if not self._are_enough(corners):
            bit = float(np.linalg.norm(pixels - np.roll(pixels, 1, axis=1), axis=2).min()) / self._bits
            raise _too_few(image, told, _count(usable) < _count(told), _count(corners), bit)
        grid = self._as_grid(corners)
        blur = checked_blur(image, grid, min(0.4, self._gap) * spacing(grid))
        return Detection(corners, True, blur, weakest, self._board.feature)

    def _find_markers(self, image: Image, region: Region) -> tuple[NDArray[np.intp], Array]:
        """Ids (m,) of the board's markers in the region, and their corners (m, 4, 2) px, that lie in one plane."""
        x0, y0, x1, y1 = region
        found, ids, _ = self._markers.detectMarkers(image[y0:y1, x0:x1])
        if ids is None:
            raise Refused(Miss.NOT_FOUND, "none of the board's markers")
        numbers = np.asarray(ids, dtype=np.intp).ravel()
        pixels = np.asarray(found, dtype=float).reshape(-1, 4, 2) + np.array([x0, y0], dtype=float)
        known = numbers < len(self._middles)
        numbers, pixels = numbers[known], pixels[known]
        if len(numbers) > 1:
            side = float(np.median(np.linalg.norm(pixels[:, 1] - pixels[:, 0], axis=1)))
            squares = side * self._board.square / self._board.marker
            places = self._marker_corners[numbers].reshape(-1, 2)
            _, mask = cv2.findHomography(places, pixels.reshape(-1, 2), cv2.RANSAC, _MARKER_OFF * squares)
            in_plane = np.all(np.asarray(mask, dtype=bool).reshape(-1, 4), axis=1)
            numbers, pixels = numbers[in_plane], pixels[in_plane]
        if len(numbers) == 0:
            raise Refused(Miss.NOT_FOUND, "none of the board's markers")
        return numbers, pixels

    def _told(self, ids: NDArray[np.intp], pixels: Array) -> Array:
        """(n, 2) px where the corners beside the markers must be, NaN for the others."""
        told = np.full((len(self._lattice), 2), np.nan)
        distances = np.linalg.norm(self._lattice[:, None] - self._middles[ids], axis=2)
        for corner in np.flatnonzero(distances.min(axis=1) < _ADJACENT):
            nearest = np.argsort(distances[corner], kind="stable")[:_NEAREST]
            plane = homography(self._marker_corners[ids[nearest]].reshape(-1, 2), pixels[nearest].reshape(-1, 2))
            told[corner] = mapped(plane, self._lattice[corner])[0]
        return told

    def _half_window(self, told: Array) -> int:
        step = spacing(self._as_grid(told))
        if not np.isfinite(step):
            raise Refused(Miss.NOT_FOUND, "no two neighbouring corners")
        return int(np.clip(_WINDOW * self._to_bits * step, SMALLEST_WINDOW, LARGEST_WINDOW))

    def _refined(self, image: Image, told: Array, half: int) -> Array:
        """(n, 2) px: the saddles near what was told, NaN for those that have none."""
        corners, known = np.full_like(told, np.nan), np.isfinite(told[:, 0])
        if known.any():
            saddles = refined(image, told[known], half)
            corners[known] = np.where(saddles.found[:, None], saddles.points, np.nan)
        return corners

    def _checked(self, image: Image, corners: Array) -> tuple[Array, float]:
        """The corners between black and white squares that lie in one plane, and the weakest one's contrast."""
        corners = corners.copy()
        weakest = np.nan
        while self._are_enough(corners):
            seen = np.flatnonzero(np.isfinite(corners[:, 0]))
            lattice, plane = self._lattice[seen], homography(self._lattice[seen], corners[seen])
            off = off_plane(plane, lattice, corners[seen])
            grey = self._sign * contrast(image, plane, lattice, min(TO_QUADRANT, 0.5 * self._gap))
            weakest = float(grey.min())
            if off.max() <= 0 and weakest >= CONTRAST_LIMIT:
                break
            # One at a time: a corner that is wrong bends the plane of the others.
            corners[seen[int(np.argmax(off)) if off.max() > 0 else int(np.argmin(grey))]] = np.nan
        return corners, weakest

    def _are_enough(self, corners: Array) -> bool:
        """Whether the corners seen determine a plane's homography: not if all but one lie in one line."""
        seen = self._lattice[np.isfinite(corners[:, 0])]
        if len(seen) < FEWEST_CORNERS:
            return False
        ones, zeros = np.ones((len(seen), 1)), np.zeros((len(seen), 3))
        points = np.hstack([seen, ones])
        x, y = (seen[:, [axis]] * points for axis in (0, 1))
        equations = np.vstack([np.hstack([points, zeros, -x]), np.hstack([zeros, points, -y])])
        return bool(np.linalg.matrix_rank(equations) == 8)

    def _as_grid(self, corners: Array) -> Array:
        return corners.reshape(self._board.rows, self._board.columns, 2)


def _count(corners: Array) -> int:
    return int(np.isfinite(corners[:, 0]).sum())


def _too_few(image: Image, told: Array, cut: bool, seen: int, bit: float) -> Refused:
    """Why fewer corners than are needed were found, although markers were.

    ``cut``: whether some of them are too near to the image's edge, or beyond it; ``bit``: width of the least of the
    markers' bits, px.
    """
    said = f"{seen} corners beside the markers that were found, {FEWEST_CORNERS} in two rows are needed"
    if cut:
        return Refused(Miss.AT_BORDER, f"{said}; bring the target nearer to the middle of the image")
    raise_light_problem(around(image, told[np.isfinite(told[:, 0])], 5.0))
    if bit < SMALLEST_BIT:
        return Refused(
            Miss.NOT_FOUND,
            f"{said}; markers too small or image too noisy: a bit is {bit:.1f} px wide, below {SMALLEST_BIT:g} px blur"
            " and noise hide some; go nearer, focus or print larger markers",
        )
    return Refused(Miss.OCCLUDED, f"{said}; look what is in front of the rest")
