"""The checkerboard's corners in an image, in the board's order, or the reason why not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np

from dualcal_hal.camera import Image
from dualcal_hal.errors import UsageError
from dualcal_hal.target import Checkerboard
from dualcal_hal.transforms import Array
from procedures.detection.appearance import contrast, edge_blur, gap
from procedures.detection.saddle import MAX_MOVE, fit_saddles, half_window, reach

BLUR_LIMIT = 3.0
"""px: images with wider edges (Gaussian sigma) are refused."""
CONTRAST_LIMIT = 20.0
"""Grey levels between the black and white squares at every corner."""
PLANE_LIMIT = 0.3
"""px by which a corner may be off the homography of all, if the lens had no distortion ..."""
DISTORTION_ALLOWANCE = 0.01
"""... and how much more in parts of the pattern's diagonal."""
GAP_LIMIT = 0.4
"""How far an edge may be from the middle grey, in parts of its contrast: spots with gaps are a half away."""
GOES_ON_LIMIT = 0.75
"""Contrast one square outside the corners, in parts of that inside: a half at the rim of a pattern."""
ALIKE_LIMIT = 0.75
"""An order is known if its misfit to the prediction is below this part of the second best's (38 deg of roll)."""

Region = tuple[int, int, int, int]


class Miss(StrEnum):
    """Why there is no detection."""

    NOT_FOUND = "not found"
    AT_BORDER = "at the border"
    BLURRED = "blurred"


@dataclass(frozen=True)
class Missed:
    """An expected outcome: no usable corners in this image."""

    reason: Miss
    detail: str


class _Refused(Exception):
    """A candidate is not the board, or not usable."""

    def __init__(self, reason: Miss, detail: str) -> None:
        self.missed = Missed(reason, detail)


@dataclass(frozen=True, eq=False)
class Detection:
    """corners: (n, 2) px in the distorted image, in the board's order; order_known: whether a prediction told
    this order from the others in which a checkerboard looks alike; blur: Gaussian sigma of the edges, px;
    contrast: of the weakest corner, grey levels; feature_index: of the feature point."""

    corners: Array
    order_known: bool
    blur: float
    contrast: float
    feature_index: int

    @property
    def feature(self) -> Array:
        """(2,) px: the feature point."""
        return np.asarray(self.corners[self.feature_index])


class Detector:
    """Finds one board in images of one size, (width, height) px. It keeps nothing from image to image."""

    def __init__(self, board: Checkerboard, size: tuple[int, int]) -> None:
        if min(board.rows, board.columns) < 3:
            raise UsageError(
                f"a checkerboard of {board.rows} x {board.columns} inner corners cannot be detected:"
                " at least 3 x 3 are needed"
            )
        self.board = board
        self.size = size
        self._shape = (board.rows, board.columns)
        self._lattice = _lattice(range(board.columns), range(board.rows))
        self._ring = np.concatenate(
            [
                _lattice(range(board.columns), (-1, board.rows)),
                _lattice((-1, board.columns), range(board.rows)),
            ]
        )

    def detect(self, image: Image, predicted: Array | None = None) -> Detection | Missed:
        """The board's corners in a grey ``image`` (height, width).

        predicted: (n, 2) px where the corners are expected, in the board's order (a projection, or the corners
        of the frame before). The pattern is searched around it first, and its shape decides among the orders in
        which the pattern looks alike; its position may be off by any amount, its roll by up to about 35 deg.
        Raises UsageError for an image of another size or type, or a prediction of another shape.
        """
        self._check(image, predicted)
        missed = Missed(Miss.NOT_FOUND, f"no pattern of {self._shape[0]} x {self._shape[1]} corners")
        for region, thorough in self._searches(predicted):
            grid = self._search(image, region, thorough)
            if grid is None:
                continue
            try:
                return self._measure(image, grid, predicted)
            except _Refused as refused:
                missed = refused.missed
            if missed.reason is not Miss.NOT_FOUND:
                return missed
        if predicted is not None and not self._inside(predicted, self._outer_square(predicted)):
            return Missed(Miss.AT_BORDER, f"{missed.detail}, and part of it was expected outside the image")
        return missed

    def _check(self, image: Image, predicted: Array | None) -> None:
        if image.shape != self.size[::-1] or image.dtype != np.uint8:
            raise UsageError(
                f"expected a grey 8-bit image of {self.size[0]} x {self.size[1]} px,"
                f" got {image.dtype} of shape {image.shape}"
            )
        n = len(self._lattice)
        if predicted is not None and (predicted.shape != (n, 2) or not np.all(np.isfinite(predicted))):
            raise UsageError(f"expected finite predictions of {n} corners, got shape {predicted.shape}")

    def _searches(self, predicted: Array | None) -> Iterator[tuple[Region, bool]]:
        """Where to look and how, the quickest first."""
        width, height = self.size
        if predicted is not None:
            # The outer squares and some of the white around them belong to the pattern.
            margin = 2.5 * self._outer_square(predicted)
            x0, y0 = np.clip(predicted.min(axis=0) - margin, 0, self.size).astype(int)
            x1, y1 = np.clip(predicted.max(axis=0) + margin, 0, self.size).astype(int)
            if min(x1 - x0, y1 - y0) > 2 * reach(half_window(0.0)):
                yield (x0, y0, x1, y1), False
        yield (0, 0, width, height), False
        yield (0, 0, width, height), True

    def _outer_square(self, predicted: Array) -> float:
        """About how far, in px, the pattern goes on beyond its corners."""
        return _spacing(predicted.reshape(*self._shape, 2))

    def _search(self, image: Image, region: Region, thorough: bool) -> Array | None:
        """Corners (rows, columns, 2) px, good to a pixel or two, from any of the pattern's ends.

        The thorough search stands uneven light; it is slow, and slower by far without the smoothing, for the
        local threshold makes shapes of the noise.
        """
        x0, y0, x1, y1 = region
        part = cv2.GaussianBlur(image, (0, 0), 1.0) if thorough else image
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH if thorough else 0
        found, corners = cv2.findChessboardCorners(part[y0:y1, x0:x1], self._shape[::-1], flags=flags)
        if not found:
            return None
        grid: Array = np.asarray(corners, dtype=float).reshape(*self._shape, 2) + np.array([x0, y0], dtype=float)
        return grid

    def _measure(self, image: Image, grid: Array, predicted: Array | None) -> Detection:
        """Refine a candidate and see whether it is the board; raises _Refused if not, or not usable."""
        orders = _orders_from_the_front(grid)
        if not orders:
            raise _Refused(Miss.NOT_FOUND, "the candidate's corners do not lie like a board's")
        grid, order_known = _choose(orders, predicted)
        self._check_plane(grid, slack=MAX_MOVE)
        grid = self._refine(image, grid)
        self._check_plane(grid)
        weakest = self._weakest_contrast(image, grid)
        blur = edge_blur(image, grid, _spacing(grid))
        if blur > BLUR_LIMIT:
            raise _Refused(Miss.BLURRED, f"the edges are {blur:.1f} px wide (sigma), {BLUR_LIMIT:g} at most")
        return Detection(grid.reshape(-1, 2), order_known, blur, weakest, self.board.feature)

    def _refine(self, image: Image, grid: Array) -> Array:
        half = half_window(_spacing(grid))
        start = grid.reshape(-1, 2)
        if not self._inside(start, reach(half)):
            raise _Refused(Miss.AT_BORDER, f"a corner is within {reach(half)} px of the image's edge")
        start = _corner_subpix(image, start, half)
        if not self._inside(start, reach(half)):
            raise _Refused(Miss.NOT_FOUND, "a corner of the candidate has none near it")
        saddles = fit_saddles(image, start, half)
        if not np.all(saddles.found):
            raise _Refused(Miss.NOT_FOUND, "a corner of the candidate is no saddle of the grey values")
        return saddles.points.reshape(grid.shape)

    def _check_plane(self, grid: Array, slack: float = 0.0) -> None:
        """No corner may be off the homography of all by more than the limit and ``slack`` px."""
        corners = grid.reshape(-1, 2)
        fitted = cv2.perspectiveTransform(self._lattice[:, None], self._homography(corners)).reshape(-1, 2)
        off = float(np.linalg.norm(fitted - corners, axis=1).max())
        diagonal = float(np.linalg.norm(np.ptp(corners, axis=0)))
        if off > PLANE_LIMIT + DISTORTION_ALLOWANCE * diagonal + slack:
            raise _Refused(Miss.NOT_FOUND, f"a corner of the candidate is {off:.1f} px off the others' plane")

    def _homography(self, corners: Array) -> Array:
        """(3, 3): lattice coordinates (column, row) to px, by least squares."""
        homography, _ = cv2.findHomography(self._lattice, corners, method=0)
        if homography is None:
            raise _Refused(Miss.NOT_FOUND, "the candidate's corners do not span a plane")
        return np.asarray(homography, dtype=float)

    def _weakest_contrast(self, image: Image, grid: Array) -> float:
        """The contrast of the weakest corner, if black and white alternate over the pattern and no further."""
        homography = self._homography(grid.reshape(-1, 2))
        inside = contrast(image, homography, self._lattice)
        inside *= np.sign(np.median(inside))
        weakest = float(inside.min())
        if weakest < CONTRAST_LIMIT:
            raise _Refused(Miss.NOT_FOUND, "the candidate's squares are not black and white in turn")
        if gap(image, grid) > GAP_LIMIT:
            raise _Refused(Miss.NOT_FOUND, "the candidate's dark and bright parts do not meet like squares")
        outside = abs(float(np.median(contrast(image, homography, self._ring))))
        if outside > GOES_ON_LIMIT * float(np.median(inside)):
            raise _Refused(Miss.NOT_FOUND, "the checkerboard in the image has more corners than the target")
        return weakest

    def _inside(self, pixels: Array, margin: float) -> bool:
        """Whether all ``pixels`` (n, 2) are at least ``margin`` px within the image."""
        return bool(np.all(pixels >= margin) and np.all(pixels <= np.array(self.size) - 1 - margin))


def _lattice(columns: range | tuple[int, ...], rows: range | tuple[int, ...]) -> Array:
    """(n, 2): (column, row), row by row."""
    return np.array([(column, row) for row in rows for column in columns], dtype=float)


def _spacing(grid: Array) -> float:
    """Least distance in px between neighbours in a row, a column or a diagonal of ``grid`` (rows, columns, 2)."""
    neighbours = (
        grid[:, 1:] - grid[:, :-1],
        grid[1:] - grid[:-1],
        grid[1:, 1:] - grid[:-1, :-1],
        grid[1:, :-1] - grid[:-1, 1:],
    )
    return float(min(np.linalg.norm(difference, axis=2).min() for difference in neighbours))


def _corner_subpix(image: Image, start: Array, half: int) -> Array:
    """``start`` (n, 2) px brought close enough for the saddle fit."""
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 0.01)
    corners = start.astype(np.float32).reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(image, corners, (half, half), (-1, -1), criteria)
    return np.asarray(refined, dtype=float).reshape(-1, 2)


def _orders_from_the_front(grid: Array) -> list[Array]:
    """All ways to number ``grid`` (rows, columns, 2) as a board seen from the front: two, four for a square one.

    None if no numbering turns every square the same way round.
    """
    grids = [grid, np.swapaxes(grid, 0, 1)] if grid.shape[0] == grid.shape[1] else [grid]
    flipped = [g[::down, ::right] for g in grids for down in (1, -1) for right in (1, -1)]
    return [g for g in flipped if _is_from_the_front(g)]


def _is_from_the_front(grid: Array) -> bool:
    """Whether all squares keep their sense: rows to the right, columns down, in an image with y down."""
    right, down = grid[:-1, 1:] - grid[:-1, :-1], grid[1:, :-1] - grid[:-1, :-1]
    return bool(np.all(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0] > 0))


def _choose(orders: list[Array], predicted: Array | None) -> tuple[Array, bool]:
    """The order closest in shape to the prediction, and whether it clearly is; without one, the order that
    reads most nearly like text in the image."""
    if predicted is None:
        return max(orders, key=lambda grid: float(np.mean(grid[:, -1, 0] - grid[:, 0, 0]))), False
    expected = _shape_of(predicted)
    misfits = np.array([np.linalg.norm(_shape_of(grid.reshape(-1, 2)) - expected) for grid in orders])
    best, second = np.argsort(misfits)[:2]
    return orders[best], bool(misfits[best] < ALIKE_LIMIT * misfits[second])


def _shape_of(points: Array) -> Array:
    """``points`` (n, 2) without their translation and scale."""
    centred = points - points.mean(axis=0)
    return np.asarray(centred / np.linalg.norm(centred))
