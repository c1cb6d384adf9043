"""What is printed on a ChArUco board's plate: a checkerboard, and a marker in each of its white squares."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from backends.simulator.pattern import CheckerPattern, Values
from dualcal_hal.target import Charuco, Target
from dualcal_hal.transforms import Mask

_PARTS = 4  # per pixel in each direction, where a marker's cells meet


def pattern_of(board: Target, margin: float) -> CheckerPattern | CharucoPattern:
    """What is printed on the ``board``, with ``margin`` m of white beyond the outer squares."""
    return CharucoPattern(board, margin) if isinstance(board, Charuco) else CheckerPattern(board, margin)


class CharucoPattern:
    """The squares exactly as a checkerboard's; in the markers, mixed pixels are the mean of parts of them."""

    def __init__(self, board: Charuco, margin: float) -> None:
        self._board = board
        self._squares = CheckerPattern(board, margin)
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        self._count = dictionary.markerSize + 2  # cells in a row, with the black border
        columns, rows = board.marker_squares.T
        self._printed = np.zeros((board.rows + 1, board.columns + 1), dtype=bool)
        self._printed[rows, columns] = True
        # A cell more all around is white paper.
        self._black = np.zeros((*self._printed.shape, self._count + 2, self._count + 2), dtype=np.float32)
        for number, (column, row) in enumerate(board.marker_squares):
            marker = cv2.aruco.generateImageMarker(dictionary, number, self._count, borderBits=1)
            self._black[row, column, 1:-1, 1:-1] = marker == 0

    def paint(self, x: Values, y: Values) -> tuple[Values, Values]:
        """How much of each pixel, seen at (x, y) m in T, is plate, and how much of that is black; (height, width)."""
        (left, top), bottom = self._board.outline[0, :2].tolist(), float(self._board.outline[2, 1])
        # White comes first where the number of rows is even: that is the other kind of board upside down.
        plate, black = self._squares.paint(x, top + bottom - y if self._board.white_first else y)
        u, v = (x - left) / self._board.square, (top - y) / self._board.square
        pixels = np.nonzero(self._is_printed(u, v))
        if len(pixels[0]):
            black[pixels] += self._marker_share(u, v, pixels)
        return plate, black

    def _is_printed(self, u: Values, v: Values) -> Mask:
        """Whether (u, v) in squares from the top left lies in a square that holds a marker."""
        rows, columns = self._printed.shape
        inside = (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
        row, column = np.where(inside, v, 0).astype(int), np.where(inside, u, 0).astype(int)
        return np.asarray(inside & self._printed[row, column])

    def _marker_share(self, u: Values, v: Values, pixels: tuple[NDArray[np.intp], ...]) -> Values:
        """(n,) how much of each of the chosen pixels a marker's black cells cover."""
        along = [_gradient(position, pixels) for position in (u, v)]
        at_u, at_v = u[pixels], v[pixels]
        row, column = at_v.astype(int), at_u.astype(int)
        share = self._is_black(row, column, at_u, at_v)
        reach = [0.5 * np.abs(gradient).sum(axis=0) for gradient in along]
        mixed = np.flatnonzero(
            self._near_cell_edge(at_u - column, reach[0]) | self._near_cell_edge(at_v - row, reach[1])
        )
        offset = ((np.arange(_PARTS) + 0.5) / _PARTS - 0.5).astype(np.float32)
        right, down = (part.reshape(-1, 1) for part in np.meshgrid(offset, offset))
        part_u, part_v = (
            at[mixed] + right * gradient[0, mixed] + down * gradient[1, mixed]
            for at, gradient in zip((at_u, at_v), along, strict=True)
        )
        share[mixed] = self._is_black(row[mixed], column[mixed], part_u, part_v).mean(axis=0)
        return share

    def _is_black(self, row: NDArray[np.intp], column: NDArray[np.intp], u: Values, v: Values) -> Values:
        """1 where (u, v) is in a black cell of the square's marker, 0 elsewhere; (..., n)."""
        i, j = (np.clip(np.floor(self._cell(a)) + 1, 0, self._count + 1).astype(int) for a in (v - row, u - column))
        return np.asarray(self._black[row, column, i, j])

    def _near_cell_edge(self, within: Values, reach: Values) -> Mask:
        """Whether ``within`` a square (n,) there may be an edge between cells no farther than ``reach`` squares."""
        cell = self._cell(within)
        return np.asarray(np.abs(cell - np.clip(np.rint(cell), 0, self._count)) <= self._cell_count * reach)

    def _cell(self, within: Values) -> Values:
        """The place in the marker, in cells from its edge, of a place within its square, in squares."""
        return np.asarray((within - 0.5) * self._cell_count + 0.5 * self._count, dtype=np.float32)

    @property
    def _cell_count(self) -> float:
        """Cells that would fit along a square."""
        return self._count * self._board.square / self._board.marker


def _gradient(position: Values, pixels: tuple[NDArray[np.intp], ...]) -> Values:
    """(2, n): the change of ``position`` (height, width) over the chosen pixels, to the right and down."""
    return np.stack([np.asarray(np.gradient(position, axis=axis), dtype=np.float32)[pixels] for axis in (1, 0)])
