"""Where in the image corners were seen, how far out, and how the target was tilted: what an estimate rests on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualcal_hal.camera import Intrinsics
from dualcal_hal.transforms import Array

GRID = (8, 6)
"""Columns and rows of cells into which the image is divided."""

LEAST_SHARE = 0.8
"""Of the cells that must hold a corner."""
LEAST_TILT = np.deg2rad(15.0)
"""rad by which the target must be tilted about each of two axes, in LEAST_TILTED views each."""
LEAST_TILTED = 3
LEAST_VIEWS = 15
"""Views below which the coverage is poor, wherever their corners are."""

OUTER = 0.1
"""Share of width and height at each edge of the image that corners should reach."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """cells: (rows, columns) corners seen in each cell of the image; edges: whether corners were seen in the outermost
    tenth at the left, the right, the top and the bottom; radius: how far from the principal point the farthest corner
    is, by that of the farthest pixel; tilts: (k, 2) rad about the image's x and y, of each view.
    """

    cells: NDArray[np.int_]
    edges: tuple[bool, bool, bool, bool]
    radius: float
    tilts: Array

    @staticmethod
    def of(corners: Array, poses: Array, intrinsics: Intrinsics) -> Coverage:
        """Of corners (k, n, 2) px, NaN where one was not seen, of views with the target at ``T_E_T`` (k, 4, 4)."""
        size = np.array(intrinsics.size, dtype=float)
        seen = corners.reshape(-1, 2)[np.isfinite(corners[..., 0]).ravel()]
        cells = corners_in_cells(seen, intrinsics.size)
        low, high = OUTER * size, (1 - OUTER) * size - 1
        edges = (seen[:, 0] < low[0], seen[:, 0] > high[0], seen[:, 1] < low[1], seen[:, 1] > high[1])
        ends = np.array([[0, 0], [size[0] - 1, 0], [0, size[1] - 1], size - 1])
        centre = intrinsics.principal_point
        farthest = np.linalg.norm(seen - centre, axis=1).max(initial=0.0)
        radius = float(farthest / np.linalg.norm(ends - centre, axis=1).max())
        left, right, top, bottom = (bool(np.any(edge)) for edge in edges)
        return Coverage(cells, (left, right, top, bottom), radius, tilts_of(poses))

    @property
    def share(self) -> float:
        """Of the cells that hold a corner."""
        return float(np.mean(self.cells > 0))

    @property
    def tilted(self) -> tuple[int, int]:
        """How many views are tilted enough about the image's x and y."""
        about_x, about_y = np.sum(np.abs(self.tilts) >= LEAST_TILT, axis=0).tolist()
        return about_x, about_y

    def lacking(self) -> Iterator[str]:
        """What is missing, in words; nothing where the coverage will do."""
        if len(self.tilts) < LEAST_VIEWS:
            yield f"only {len(self.tilts)} views can be used, {LEAST_VIEWS} are needed"
        if self.share < LEAST_SHARE:
            empty = ", ".join(self._empty())
            yield (
                f"corners were seen in {self.share:.0%} of the image's {GRID[0]} x {GRID[1]} cells, "
                f"{LEAST_SHARE:.0%} are needed; there are none in {empty}"
            )
        for axis, views in zip(("horizontal", "vertical"), self.tilted, strict=True):
            if views < LEAST_TILTED:
                yield (
                    f"the target was tilted by {np.rad2deg(LEAST_TILT):.0f} deg or more about the {axis} axis of the "
                    f"image in {views} views, {LEAST_TILTED} are needed"
                )

    def _empty(self) -> Iterator[str]:
        """The rows' cells without a corner, counted from the top left."""
        for row, counts in enumerate(self.cells, start=1):
            columns = [str(column) for column, count in enumerate(counts, start=1) if count == 0]
            if columns:
                yield f"row {row} column{'s' if len(columns) > 1 else ''} {' '.join(columns)}"


def corners_in_cells(pixels: Array, size: tuple[int, int]) -> NDArray[np.int_]:
    """(rows, columns): how many of ``pixels`` (n, 2) are in each cell; outside the image or NaN they are in none."""
    columns, rows = GRID
    place = np.floor((pixels + 0.5) / np.array(size) * np.array(GRID))
    edges = [np.arange(rows + 1) - 0.5, np.arange(columns + 1) - 0.5]
    inside = np.all(np.isfinite(place), axis=1)
    counts, _, _ = np.histogram2d(place[inside, 1], place[inside, 0], bins=edges)
    return np.asarray(counts, dtype=np.int_)


def tilts_of(T_E_T: Array) -> Array:
    """(k, 2) rad by which the target's normal leans from the optical axis about the image's x and y."""
    normal = -T_E_T[..., :3, 2]
    return np.stack([np.arctan2(normal[..., 1], normal[..., 2]), np.arctan2(normal[..., 0], normal[..., 2])], axis=-1)
