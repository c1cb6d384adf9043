"""The target on the passive arm."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dualcal_hal.transforms import Array


@dataclass(frozen=True)
class Target:
    """``rows`` x ``columns`` inner corners, ``square`` in m; ``feature`` is the index of the feature point.

    Frame T has its origin in the feature point, x right and y up when looked at from the front, z towards
    the viewer. Corner (i, j) has index ``i * columns + j``, read from the front like text.
    """

    rows: int
    columns: int
    square: float
    feature: int

    @cached_property
    def corners(self) -> Array:
        """(rows * columns, 3): the corners in T, m."""
        i, j = np.divmod(np.arange(self.rows * self.columns), self.columns)
        x = (j - (self.columns - 1) / 2) * self.square
        y = ((self.rows - 1) / 2 - i) * self.square
        corners = np.stack([x, y, np.zeros_like(x)], axis=1)
        return np.asarray(corners - corners[self.feature])

    @property
    def feature_is_central(self) -> bool:
        """Whether the feature point is the middle corner, which is the same in whatever order the corners are read."""
        return 2 * self.feature + 1 == self.rows * self.columns

    @cached_property
    def outline(self) -> Array:
        """(4, 3): the outer corners of the pattern's squares in T, m (one square beyond the inner corners)."""
        lowest, highest = self.corners.min(axis=0), self.corners.max(axis=0)
        x0, y0 = lowest[:2] - self.square
        x1, y1 = highest[:2] + self.square
        return np.array([[x0, y1, 0.0], [x1, y1, 0.0], [x1, y0, 0.0], [x0, y0, 0.0]])


@dataclass(frozen=True)
class Checkerboard(Target):
    """Black and white squares; it looks alike in two orientations, or four if it is square."""


@dataclass(frozen=True)
class Charuco(Target):
    """A checkerboard with an ArUco marker, ``marker`` m wide, in each white square, which tells where it is.

    dictionary: OpenCV's name of the markers' dictionary; white_first: whether the top left square is white and
    not black, as on boards with an even number of rows of squares printed before OpenCV 4.6. A marker's bit (there are
    as many in a row as the dictionary's name says, and two of the border) must be 2 px wide in a sharp image, 4 px in
    one that is blurred by 1.5 px.
    """

    marker: float
    dictionary: str
    white_first: bool = False

    @cached_property
    def marker_squares(self) -> Array:
        """(markers, 2): column and row of the square that holds each marker, by the marker's id, from the top left."""
        rows, columns = np.divmod(np.arange((self.rows + 1) * (self.columns + 1)), self.columns + 1)
        white = (rows + columns) % 2 == (0 if self.white_first else 1)
        return np.stack([columns[white], rows[white]], axis=1)
