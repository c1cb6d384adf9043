"""Finding a checkerboard: a lattice of the right size, in an order that the prediction decides."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from dualcal_hal.camera import Image
from dualcal_hal.errors import UsageError
from dualcal_hal.target import Checkerboard
from dualcal_hal.transforms import Array, Mask
from procedures.detection.appearance import contrast, gap, quadrants
from procedures.detection.corners import (
    checked_blur,
    homography,
    inside,
    lattice_points,
    mapped,
    off_plane,
    refined,
    spacing,
)
from procedures.detection.exposure import around, raise_if_faint, raise_light_problem
from procedures.detection.lattice import LEAST_STEP, OFF, find_lattices, find_saddles
from procedures.detection.outcome import Detection, Miss, Refused, Region
from procedures.detection.saddle import half_window, reach

GAP_LIMIT = 0.4
"""How far an edge may be from the middle grey, in parts of its contrast: spots with gaps are a half away."""
GOES_ON_LIMIT = 0.75
"""Contrast one square outside a corner, in parts of the corner's own: a half at the rim of a pattern."""
ALIKE_LIMIT = 0.75
"""An order is known if its misfit to the prediction is below this part of the second best's (38 deg of roll)."""
PART_LIMIT = 0.5
"""Where at least this part of the predicted corners is seen, the board is there, partly hidden."""

_MORE_CORNERS = "the checkerboard in the image has more corners than the target"
_NO_RIM = f"{_MORE_CORNERS}, or something lies against its rim; keep a margin around it free"
_FARTHEST_SHIFT = 2.5  # steps by which a prediction of a board that is partly hidden may be off
_WIDE = 4.0  # least steps, from which on the image is made smaller for the search


class CheckerboardFinder:
    """Finds one board; all its corners or none, for a part does not say which part it is."""

    def __init__(self, board: Checkerboard) -> None:
        if min(board.rows, board.columns) < 3:
            raise UsageError(
                f"a checkerboard of {board.rows} x {board.columns} inner corners cannot be detected:"
                " at least 3 x 3 are needed"
            )
        self._board = board
        self._shape = (board.rows, board.columns)
        self._lattice = lattice_points(range(board.columns), range(board.rows))
        ring = np.concatenate(
            [
                lattice_points(range(board.columns), (-1, board.rows)),
                lattice_points((-1, board.columns), range(board.rows)),
            ]
        )
        self._with_ring = np.concatenate([self._lattice, ring])
        self._ring_squares = (ring[:, None] + quadrants()).reshape(-1, 2)
        column, row = np.clip(ring.astype(int), 0, (board.columns - 1, board.rows - 1)).T
        self._beside_ring = row * board.columns + column

    def searches(self, size: tuple[int, int], near: Region | None, step: float) -> Iterator[tuple[Region, int]]:
        """Regions to search, each with the scale for it, the quickest first; ``step``: between corners, in px."""
        if near is not None:
            yield near, 2 if step > _WIDE * LEAST_STEP else 1
        yield (0, 0, *size), 2
        yield (0, 0, *size), 1

    def find(self, image: Image, region: Region, scale: int, predicted: Array | None) -> Detection:
        """The board within the region; raises Refused if there is none, or none that is usable."""
        x0, y0, x1, y1 = region
        saddles = find_saddles(image[y0:y1, x0:x1], scale).moved((x0, y0))
        refusal = Refused(Miss.NOT_FOUND, f"no pattern of {self._shape[0]} x {self._shape[1]} corners")
        # Wider squares have been looked for in the image made smaller.
        narrowest = _WIDE * LEAST_STEP if scale == 1 else np.inf
        lattices = find_lattices(saddles, len(self._lattice), narrowest)
        for window, ends in itertools.chain.from_iterable(_windows(lattice, self._shape) for lattice in lattices):
            if not ends:
                refusal = Refused(Miss.NOT_FOUND, _MORE_CORNERS)
                continue
            try:
                return self._measure(image, window, predicted)
            except Refused as refused:
                refusal = refused
        if refusal.missed.reason is Miss.NOT_FOUND and predicted is not None:
            self._raise_if_in_part(image, saddles.points, predicted)
        raise refusal

    def _measure(self, image: Image, grid: Array, predicted: Array | None) -> Detection:
        """Refine a candidate and see whether it is the board."""
        orders = _orders_from_the_front(grid)
        if not orders:
            raise Refused(Miss.NOT_FOUND, "the candidate's corners do not lie like a board's")
        grid, order_known = _choose(orders, predicted)
        grid = self._refine(image, grid)
        plane = homography(self._lattice, grid.reshape(-1, 2))
        off = float(off_plane(plane, self._lattice, grid.reshape(-1, 2)).max())
        if off > 0.0:
            raise Refused(Miss.NOT_FOUND, f"a corner of the candidate is {off:.1f} px too far off the others' plane")
        weakest = self._weakest_contrast(image, grid, plane)
        blur = checked_blur(image, grid, 0.4 * spacing(grid))
        return Detection(grid.reshape(-1, 2), order_known, blur, weakest, self._board.feature)

    def _refine(self, image: Image, grid: Array) -> Array:
        half = half_window(spacing(grid))
        start, size = grid.reshape(-1, 2), (image.shape[1], image.shape[0])
        if not np.all(inside(start, size, reach(half))):
            raise Refused(
                Miss.AT_BORDER,
                f"a corner is within {reach(half)} px of the image's edge; bring the target nearer to the middle",
            )
        saddles = refined(image, start, half)
        if not np.all(saddles.found):
            raise Refused(Miss.NOT_FOUND, "a corner of the candidate is no saddle of the grey values")
        return saddles.points.reshape(grid.shape)

    def _weakest_contrast(self, image: Image, grid: Array, plane: Array) -> float:
        """The contrast of the weakest corner, if black and white alternate over the pattern and no further."""
        with_ring = contrast(image, plane, self._with_ring)
        contrasts, beside = with_ring[: len(self._lattice)], with_ring[len(self._lattice) :]
        weakest = float((contrasts * np.sign(statistics.median(contrasts.tolist()))).min())
        raise_if_faint(weakest)
        if gap(image, grid) > GAP_LIMIT:
            raise Refused(Miss.NOT_FOUND, "the candidate's dark and bright parts do not meet like squares")
        if self._goes_on_outside(image, plane, beside / contrasts[self._beside_ring]):
            raise Refused(Miss.NOT_FOUND, _NO_RIM)
        return weakest

    def _goes_on_outside(self, image: Image, plane: Array, parts: Array) -> bool:
        """Whether the pattern goes on beyond the corners.

        parts: (m,) contrast of each place of the ring round them, in parts of that of the corner beside it.

        A part of a larger board may show little of what is beside it, the rest being hidden or outside the image. So
        one place where it goes on is enough, if there is another one that is no rim: a single one may be a shadow's
        edge, or something that touches the board.
        """
        size = (image.shape[1], image.shape[0])
        in_image = inside(mapped(plane, self._ring_squares).reshape(-1, 4, 2), size, 0.0).all(axis=1)
        parts = parts[in_image]
        goes_on, is_no_rim = parts > GOES_ON_LIMIT, np.abs(parts - 0.5) > GOES_ON_LIMIT - 0.5
        return bool(goes_on.any() and is_no_rim.sum() > 1)

    def _raise_if_in_part(self, image: Image, saddles: Array, predicted: Array) -> None:
        """Refused, with the reason for what is missing, if part of the board is seen near the prediction.

        saddles: (m, 2) px.
        """
        step = spacing(predicted.reshape(*self._shape, 2))
        places, size = _shifted(predicted, saddles, step), (image.shape[1], image.shape[0])
        seen = _near(places, saddles, OFF * step)
        if not PART_LIMIT * len(seen) <= seen.sum() < len(seen):
            return
        # A faint board loses corners to the noise, not to what is in front.
        shown = contrast(image, homography(self._lattice, places), self._lattice[seen])
        raise_if_faint(abs(float(np.median(shown))))
        checked_blur(image, np.where(seen[:, None], places, np.nan).reshape(*self._shape, 2), 0.4 * step)
        said = f"{seen.sum()} of {len(seen)} corners were found"
        if not np.all(inside(places, size, reach(half_window(step)))):
            raise Refused(Miss.AT_BORDER, f"{said}; bring the target nearer to the middle of the image")
        raise_light_problem(around(image, places[~seen], 0.2 * step))
        raise Refused(Miss.OCCLUDED, f"{said}; look what is in front of the rest")


def _shifted(predicted: Array, points: Array, step: float) -> Array:
    """``predicted`` (n, 2) px, shifted by at most a few steps to where most of the points (m, 2) agree with it."""
    shifts = (points[:, None] - predicted).reshape(-1, 2)
    shifts = shifts[np.linalg.norm(shifts, axis=1) <= _FARTHEST_SHIFT * step]
    if len(shifts) == 0:
        return predicted
    agreeing = KDTree(shifts).query_ball_point(shifts, OFF * step, return_length=True)
    return np.asarray(predicted + shifts[int(np.argmax(agreeing))])


def _near(places: Array, points: Array, within: float) -> Mask:
    """Which of the places (n, 2) have one of the points (m, 2) no farther than ``within`` px away."""
    if len(points) == 0:
        return np.zeros(len(places), dtype=bool)
    distances, _ = KDTree(points).query(places)
    return np.asarray(distances <= within)


def _windows(grid: Array, shape: tuple[int, int]) -> list[tuple[Array, bool]]:
    """The parts of a lattice (r, c, 2), NaN where nothing was seen, that are a whole ``shape`` (rows, columns), and
    whether the lattice ends there."""
    rows, columns = shape
    found = []
    for turned in (grid, np.swapaxes(grid, 0, 1))[: 1 if rows == columns else 2]:
        if turned.shape[0] < rows or turned.shape[1] < columns:
            continue
        there = np.zeros((turned.shape[0] + 2, turned.shape[1] + 2), dtype=np.uint8)  # with a rim where none was seen
        there[1:-1, 1:-1] = np.isfinite(turned[..., 0])
        whole = _seen_in(there[1:-1, 1:-1], shape) == rows * columns
        beside_rows, beside_columns = _seen_in(there[:, 1:-1], (1, columns)), _seen_in(there[1:-1], (rows, 1))
        # It goes on where most of the row or column beside it was seen too.
        on_rows, on_columns = 2 * beside_rows > columns, 2 * beside_columns > rows
        goes_on = on_rows[: -rows - 1] | on_rows[rows + 1 :]
        goes_on |= on_columns[:, : -columns - 1] | on_columns[:, columns + 1 :]
        for i, j in zip(*np.nonzero(whole), strict=True):
            found.append((turned[i : i + rows, j : j + columns], not goes_on[i, j]))
    return found


def _seen_in(there: NDArray[np.uint8], shape: tuple[int, int]) -> NDArray[np.int32]:
    """How many corners are ``there`` (r, c), one or none each, in each window of ``shape`` (rows, columns)."""
    rows, columns = shape
    above = np.asarray(cv2.integral(there), dtype=np.int32)
    return above[rows:, columns:] - above[:-rows, columns:] - above[rows:, :-columns] + above[:-rows, :-columns]


def _orders_from_the_front(grid: Array) -> list[Array]:
    """All ways to number ``grid`` (rows, columns, 2) as a board seen from the front: two, four for a square one.

    From the front rows go to the right and columns down, in an image with y down. None if a square's corners do not
    lie round it in the same sense as those of the others.
    """
    right, down = grid[:, 1:] - grid[:, :-1], grid[1:] - grid[:-1]
    # At each square's corners, (top or bottom, left or right, ...): the sense that all squares have there, 0 for none.
    across = np.stack([right[:-1], right[1:]])[:, None]
    along = np.stack([down[:, :-1], down[:, 1:]])
    turn = across[..., 0] * along[..., 1] - across[..., 1] * along[..., 0]
    sense = np.all(turn > 0, axis=(2, 3)).astype(int) - np.all(turn < 0, axis=(2, 3))
    grids = [(grid, sense), (np.swapaxes(grid, 0, 1), -sense.T)][: 2 if grid.shape[0] == grid.shape[1] else 1]
    orders = [
        turned[::down_way, ::right_way]
        for turned, senses in grids
        for down_way, of_row in zip((1, -1), senses, strict=True)
        for right_way, of_corner in zip((1, -1), of_row, strict=True)
        if down_way * right_way * of_corner > 0
    ]
    return orders if len(orders) == 2 * len(grids) else []


def _choose(orders: list[Array], predicted: Array | None) -> tuple[Array, bool]:
    """The order closest in shape to the prediction, and whether it clearly is; without one, the order that
    reads most nearly like text in the image."""
    if predicted is None:
        return max(orders, key=lambda grid: float(np.mean(grid[:, -1, 0] - grid[:, 0, 0]))), False
    expected = _shape_of(predicted)
    shapes = _shape_of(np.stack(orders).reshape(len(orders), -1, 2))
    misfits = _size_of(shapes - expected)
    best, second = np.argsort(misfits)[:2]
    return orders[best], bool(misfits[best] < ALIKE_LIMIT * misfits[second])


def _shape_of(points: Array) -> Array:
    """``points`` (..., n, 2) without their translation and scale."""
    centred = points - points.mean(axis=-2, keepdims=True)
    return np.asarray(centred / _size_of(centred)[..., None, None])


def _size_of(points: Array) -> Array:
    """(...): root of the sum of squares of ``points`` (..., n, 2)."""
    return np.asarray(np.sqrt(np.sum(points * points, axis=(-2, -1))))
