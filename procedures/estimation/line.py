"""The optical axis as a line through aligned positions of the feature point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.transforms import Array
from procedures.estimation.degenerate import Degenerate

FEWEST_POSITIONS = 3

# Positions closer together along the line than this count as one. Measured: coincident positions under
# 0.1 mm of noise spread by at most 0.7 mm (10,000 sets of 3 to 7); planned positions lie 0.2 m / (m - 1) apart.
APART = 0.005  # m

# Ratio of the spread across to the spread along the line above which there is no line. Measured: aligned
# positions 0.002 at most (0.1 px, 0.1 mrad, 7 lines x 200 runs); three corners of a square 0.58.
STRAIGHT = 0.1


@dataclass(frozen=True)
class Line:
    """``point`` (3,) is the centroid in m, ``direction`` (3,) a unit vector, ``rms`` the points' distance in m."""

    point: Array
    direction: Array
    rms: float


def fit_line(points: ArrayLike, towards: ArrayLike) -> Line:
    """Total least squares line through points (m, 3) in m (paper, the mu_k of section 3.2).

    The fitted direction has no sign of its own; it is taken on the side of ``towards`` (3,).
    Raises Degenerate for fewer than three positions, coincident positions and positions not on a line.
    """
    points = np.asarray(points, dtype=float)
    if len(points) < FEWEST_POSITIONS:
        raise Degenerate(f"{len(points)} positions, at least {FEWEST_POSITIONS} are needed")
    centroid = points.mean(axis=0)
    _, spread, directions = np.linalg.svd(points - centroid, full_matrices=False)
    distinct = _count_apart((points - centroid) @ directions[0])
    if distinct < FEWEST_POSITIONS:
        raise Degenerate(
            f"coincident positions: only {distinct} of {len(points)} lie more than {1e3 * APART:g} mm apart"
        )
    if spread[1] > STRAIGHT * spread[0]:
        raise Degenerate(f"the positions do not lie on a line: {spread[1] / spread[0]:.2f} across to along")
    direction = directions[0] * (1.0 if directions[0] @ np.asarray(towards, dtype=float) >= 0 else -1.0)
    return Line(centroid, direction, float(np.sqrt(np.sum(spread[1:] ** 2) / len(points))))


def _count_apart(along: Array) -> int:
    count, last = 0, -np.inf
    for position in np.sort(along):
        if position - last > APART:
            count, last = count + 1, position
    return count
