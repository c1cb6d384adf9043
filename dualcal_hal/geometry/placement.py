"""Where the bases stand to each other, how wrong that may be, and what is clear nevertheless.

The bound: let n be any unit vector, e the ends of what moves with the error, measured from the pivot, and f the points
of what does not. Turning e by at most theta brings it along n to at most |e| cos(max(0, beta - theta)), with beta the
angle between e and n; moving it by t adds at most t. Therefore

    distance >= min n.f - max |e| cos(max(0, beta_e - theta)) - t.

The maximum over a capsule's axis is at one of its ends, because the largest n.(R e) over rotations R is convex in e.
The bound is best with n along the shortest distance; without an error it then is that distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualcal_hal.geometry.distance import dot, length
from dualcal_hal.transforms import Array


@dataclass(frozen=True, eq=False)
class Placement:
    """Where the active arm's base stands in the passive one's, ``T_P_A`` (4, 4), and how wrong that may be.

    The error is T_true = T_P_A exp(xi): its parts are at most ``translation`` (m) and ``rotation`` (rad), turning
    about the active base's origin.
    """

    T_P_A: Array
    translation: float = 0.0
    rotation: float = 0.0


def farthest_along(n: Array, points: Array, rotation: float) -> Array:
    """How far along directions n (..., 3) points (..., 3) come that turn about the origin by up to ``rotation``, m."""
    along, distance = dot(n, points), length(points)
    rotation = min(rotation, np.pi)
    across = np.sqrt(np.maximum(distance**2 - along**2, 0.0))
    turned = along * np.cos(rotation) + across * np.sin(rotation)
    return np.asarray(np.where(along >= distance * np.cos(rotation), distance, turned))


def largest_motion(points: Array, translation: float, rotation: float) -> Array:
    """How far at most (...) points (..., 3) move by an error that turns them about the origin, m."""
    return np.asarray(translation + 2 * np.sin(min(rotation, np.pi) / 2) * length(points))
