"""What is printed on the target's plate, as the mean over each pixel's area.

In closed form where one edge crosses a pixel and from parts of it where two do.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from dualcal_hal.target import Target
from dualcal_hal.transforms import Mask

Values = NDArray[np.float32]

_PARTS = 6  # per pixel in each direction, where edges cross


class CheckerPattern:
    """A checkerboard with ``margin`` m of white beyond the outer squares."""

    def __init__(self, board: Target, margin: float) -> None:
        self._board, self._margin = board, margin

    def paint(self, x: Values, y: Values) -> tuple[Values, Values]:
        """How much of each pixel, seen at (x, y) m in T, is plate, and how much of that is black; (height, width)."""
        board, (left, top) = self._board, self._board.outline[0, :2].tolist()
        margin = self._margin / board.square
        across = _Stripes.of_image((x - left) / board.square, board.columns + 1)
        down = _Stripes.of_image((top - y) / board.square, board.rows + 1)
        plate = (across.holds(margin) & down.holds(margin)).astype(np.float32)
        black = (across.holds(0.0) & down.holds(0.0) & ~(across.is_odd() ^ down.is_odd())).astype(np.float32)
        # Most pixels show one colour; the others are worth an average.
        mixed = np.nonzero(across.reaches(margin) & down.reaches(margin) & (across.mixes(margin) | down.mixes(margin)))
        plate[mixed], black[mixed] = _averaged(across.at(mixed), down.at(mixed), margin)
        return plate, black


def _averaged(across: _Stripes, down: _Stripes, margin: float) -> tuple[Values, Values]:
    """The shares of plate, and of black in that, over each pixel's area."""
    pattern = across.within(0.0) * down.within(0.0)
    return across.within(margin) * down.within(margin), pattern * (0.5 + 0.5 * _parity(across, down))


def _parity(across: _Stripes, down: _Stripes) -> Values:
    """The mean over each pixel of +1 in the black squares and -1 in the white ones."""
    sign_across, sign_down = across.sign(), down.sign()
    parity = sign_across * sign_down
    # Where two edges cross in one pixel, the mean of the product is not the product of the means.
    crossing = np.nonzero((np.abs(sign_across) < 1.0) & (np.abs(sign_down) < 1.0))
    parity[crossing] = np.mean(across.divided(crossing).sign() * down.divided(crossing).sign(), axis=0)
    return np.asarray(parity)


@dataclass(frozen=True, eq=False)
class _Stripes:
    """The board's squares along one of its directions, of which there are ``squares``.

    position: where each pixel's centre is, in squares from the outer edge; along_u, along_v: the change of
    that over the pixel.
    """

    position: Values
    along_u: Values
    along_v: Values
    squares: int

    @classmethod
    def of_image(cls, position: Values, squares: int) -> _Stripes:
        """``position``: (height, width)."""
        along_u, along_v = (cv2.Sobel(position, cv2.CV_32F, *order, ksize=1, scale=0.5) for order in ((1, 0), (0, 1)))
        # Beyond the border there is nothing to take a central difference with.
        along_u[:, [0, -1]] = np.diff(position[:, [0, 1, -2, -1]], axis=1)[:, [0, 2]]
        along_v[[0, -1]] = np.diff(position[[0, 1, -2, -1]], axis=0)[[0, 2]]
        return cls(position, np.asarray(along_u), np.asarray(along_v), squares)

    def at(self, pixels: tuple[NDArray[np.intp], ...]) -> _Stripes:
        """The same of chosen pixels."""
        return _Stripes(self.position[pixels], self.along_u[pixels], self.along_v[pixels], self.squares)

    def holds(self, margin: float) -> Mask:
        """Whether each pixel's centre is inside the outer edges moved outwards by ``margin`` squares."""
        return self._off_middle < self.squares / 2 + margin

    def reaches(self, margin: float) -> Mask:
        """Whether some of each pixel may be inside those."""
        return self._off_middle - self._reach < self.squares / 2 + margin

    def mixes(self, margin: float) -> Mask:
        """Whether some of each pixel may be outside those, or on the other side of an edge between squares."""
        off_line = np.abs(self.position - np.rint(self.position))
        return (off_line < self._reach) | (self._off_middle + self._reach > self.squares / 2 + margin)

    def is_odd(self) -> Mask:
        """Whether each pixel's centre is in the second, fourth, ... stripe."""
        half = 0.5 * self.position
        return np.asarray(half - np.floor(half) >= 0.5)

    @cached_property
    def _off_middle(self) -> Values:
        return np.asarray(np.abs(self.position - self.squares / 2))

    @cached_property
    def _reach(self) -> Values:
        """How far each pixel extends to both sides of its centre."""
        return np.asarray(0.5 * (np.abs(self.along_u) + np.abs(self.along_v)), dtype=np.float32)

    def divided(self, pixels: tuple[NDArray[np.intp], ...]) -> _Stripes:
        """Parts of the chosen (n,) pixels as pixels of their own, (parts, n)."""
        offset = (np.arange(_PARTS) + 0.5) / _PARTS - 0.5
        v, u = (grid.reshape(-1, 1) for grid in np.meshgrid(offset, offset))
        along_u, along_v = self.along_u[pixels], self.along_v[pixels]
        position = np.asarray(self.position[pixels] + u * along_u + v * along_v, dtype=np.float32)
        part_u: Values = np.broadcast_to(along_u / _PARTS, position.shape)
        part_v: Values = np.broadcast_to(along_v / _PARTS, position.shape)
        return _Stripes(position, part_u, part_v, self.squares)

    def within(self, margin: float) -> Values:
        """The share of each pixel that is inside the outer edges moved outwards by ``margin`` squares."""
        half = self.squares / 2
        return self._share(half + margin - np.abs(self.position - half))

    def sign(self) -> Values:
        """The mean over each pixel of +1 in the first, third, ... stripe and -1 in the others.

        The outer stripes go on beyond the outer edges, which :meth:`within` cuts off.
        """
        inner = np.clip(self.position, 0.5, self.squares - 0.5)
        in_pair = inner + 0.5 - 2.0 * np.floor(0.5 * inner + 0.25)
        return 2.0 * self._share(0.5 - np.abs(in_pair - 1.0)) - 1.0

    def _share(self, distance: Values) -> Values:
        """The share of each pixel on the inner side of an edge ``distance`` squares away from its centre.

        Exact for a straight edge: a step, averaged over the pixel's width and over its height.
        """
        longer, shorter = self._spans
        share = (distance > 0.0).astype(np.float32)
        edge = np.flatnonzero(2.0 * np.abs(distance) < longer + shorter)
        d, p, q = (np.take(values, edge) for values in (distance, longer, shorter))
        beyond = 0.5 * (p - q) - np.abs(d)
        tail = np.clip(beyond + q, 0.0, q) ** 2 / (2.0 * p * q) + np.maximum(beyond, 0.0) / p
        np.put(share, edge, np.where(d > 0.0, 1.0 - tail, tail))
        return share

    @cached_property
    def _spans(self) -> tuple[Values, Values]:
        """How far the position runs along the pixel's two sides, the longer way first; never 0."""
        u, v = np.abs(self.along_u), np.abs(self.along_v)
        longer = np.maximum(u, v)
        return longer, np.maximum(np.minimum(u, v), 1e-9 * longer)
