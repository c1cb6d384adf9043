"""RRT-Connect: two trees of points, one at either end, grow towards random samples and towards each other.

J. Kuffner and S. LaValle, "RRT-Connect: an efficient approach to single-query path planning", ICRA 2000. What a
point is and how far one may go from it towards another is the caller's: a point is an array (n,).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from dualcal_hal.transforms import Array

Advance = Callable[[Array, Array], Sequence[Array]]
"""From a point towards another as far as is free: the points (n,) to pass, the last is where it ended; none if it
cannot move at all. The moves between them can be made in both directions."""

Cost = Callable[[Array], float]
"""Of a path (w, n)."""


class _Tree:
    def __init__(self, root: Array, scale: Array) -> None:
        self._scale = scale
        self.points = root[None]
        self._parents = [-1]

    def grow(self, target: Array, advance: Advance) -> int:
        """Advance from the nearest point towards a target; the number of the point at which it ended."""
        index = int(np.argmin(np.sum(np.square((self.points - target) / self._scale), axis=1)))
        for point in advance(self.points[index], target):
            self.points = np.vstack([self.points, point])
            self._parents.append(index)
            index = len(self._parents) - 1
        return index

    def path_to(self, index: int) -> list[Array]:
        """The points from the root to this one."""
        path = []
        while index >= 0:
            path.append(self.points[index])
            index = self._parents[index]
        return path[::-1]


def connect(start: Array, goal: Array, samples: Iterable[Array], advance: Advance, scale: Array) -> Array | None:
    """A path (w, n) from ``start`` to ``goal``, or None if the samples are used up before the trees meet.

    samples: (n,) each, one an iteration; scale: (n,) what counts as equally far in each axis.
    """
    first, second = _Tree(start, scale), _Tree(goal, scale)
    growing, other = first, second
    for sample in samples:
        reached = growing.grow(sample, advance)
        met = other.grow(growing.points[reached], advance)
        if np.array_equal(growing.points[reached], other.points[met]):
            to_first, to_second = (reached, met) if growing is first else (met, reached)
            return np.array(first.path_to(to_first) + second.path_to(to_second)[-2::-1])
        growing, other = other, growing
    return None


def shorten(
    path: Array,
    detours: Callable[[Array, Array], Iterable[Array]],
    free: Callable[[Array], bool],
    cost: Cost,
    draws: Array,
) -> Array:
    """The path (w, n) with stretches replaced where that lowers its cost.

    Each of the draws (k, 2) in [0, 1) picks two places along it; ``detours`` says how to get from one to the other,
    (v, n) with both ends, and ``free`` whether that can be gone. Cost is judged first, it is cheaper.
    """
    for low, high in np.sort(draws, axis=1):
        (i, one), (j, two) = _place(path, low), _place(path, high)
        for detour in detours(one, two):
            shorter = np.vstack([path[: i + 1], detour, path[j + 1 :]])
            if cost(shorter) < cost(path) and free(detour):
                path = _without_repeats(shorter)
                break
    return path


def _place(path: Array, share: float) -> tuple[int, Array]:
    """The segment and the point (n,) on it, at a share of the path with all segments counting the same."""
    segment, along = divmod(share * (len(path) - 1), 1.0)
    i = int(segment)
    return i, path[i] + along * (path[i + 1] - path[i])


def _without_repeats(path: Array) -> Array:
    moves = [bool(np.any(one != other)) for one, other in itertools.pairwise(path)]
    return path[[True, *moves]]
