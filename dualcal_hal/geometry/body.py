"""An arm's body: its capsules placed at joint angles, clear of itself and of what stands about its base."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualcal_hal.geometry.capsules import Capsules
from dualcal_hal.geometry.distance import length, segment_distance
from dualcal_hal.geometry.solids import Fixture
from dualcal_hal.kinematics import Chain
from dualcal_hal.transforms import Array

LARGEST_MOTION = 0.010
"""No point of an arm moves further (m) between two checks along a path."""

BETWEEN_SAMPLES = LARGEST_MOTION / 2
"""What clearance may fall short (m) between two checks: every point is within this of its place at one of them."""

_COARSE_STEP = 0.05  # rad; chords of it differ from their arcs by less than a thousandth
_ARC_RESERVE = 0.99


class ArmBody:
    """An arm with what it carries and what stands about its base.

    links, tool: its capsules; floor: height in its base, m, or None; fixtures: in its base; pairs: (k, 2) numbers of
    capsules that can meet; above_floor, moving: numbers of those held against the floor and the other base's fixtures,
    and against its own base's.
    """

    def __init__(
        self, chain: Chain, links: Capsules, tool: Capsules, floor: float | None, fixtures: Sequence[Fixture] = ()
    ) -> None:
        self.chain = chain
        self.links, self.tool = links, tool
        self.capsules = links.joined(tool)
        self.floor = floor
        self.fixtures = tuple(fixtures)
        # The column stands on what it is mounted on, and the shoulder turns above that at one height: neither is held
        # against a floor or what may carry both arms, the column not against anything of its own base.
        self.above_floor = np.flatnonzero(self.capsules.frame >= 2)
        self.moving = np.flatnonzero(self.capsules.frame >= 1)
        self.pairs = _own_pairs(links, tool)

    def segments(self, q: ArrayLike) -> Array:
        """Joint angles (k, n) to the capsules' ends in the arm's base, (k, c, 2, 3)."""
        frames = self.chain.frames(q)[:, self.capsules.frame]
        turned = self.capsules.ends @ np.swapaxes(frames[..., :3, :3], -1, -2)
        return np.asarray(turned + frames[..., None, :3, 3])

    def own_clearance(self, q: ArrayLike) -> Array:
        """Least distance (k,) in m to the floor, to the fixtures of its base, and between parts that may meet.

        Infinite if there is nothing to meet.
        """
        q = np.atleast_2d(np.asarray(q, dtype=float))
        segments, radius = self.segments(q), self.capsules.radius
        least = np.full(len(q), np.inf)
        if self.floor is not None:
            heights = segments[..., 2][:, self.above_floor].min(axis=2) - radius[self.above_floor]
            least = np.minimum(least, heights.min(axis=1) - self.floor)
        if len(self.pairs):
            first, second = self.pairs.T
            distance = segment_distance(segments[:, first], segments[:, second]) - radius[first] - radius[second]
            least = np.minimum(least, distance.min(axis=1))
        for fixture in self.fixtures:
            distance = fixture.separation(segments[:, self.moving]) - radius[self.moving]
            least = np.minimum(least, distance.min(axis=1))
        return np.asarray(least)

    def sampled(self, waypoints: ArrayLike, largest_motion: float = LARGEST_MOTION) -> Array:
        """Joint waypoints (w, n) to samples (k, n) on the straight segments between them, the waypoints included.

        No point of the arm moves further than ``largest_motion`` (m) from one sample to the next; of a rigid capsule
        an end moves furthest.
        """
        points = np.atleast_2d(np.asarray(waypoints, dtype=float))
        straight = [self._straight(*ends, largest_motion)[1:] for ends in itertools.pairwise(points)]
        return np.concatenate([points[:1], *straight])

    def _straight(self, start: Array, end: Array, largest_motion: float) -> Array:
        fractions = np.linspace(0.0, 1.0, 2 + int(np.max(np.abs(end - start)) / _COARSE_STEP))
        aim = largest_motion
        while True:
            samples = start + fractions[:, None] * (end - start)
            moved = length(np.diff(self.segments(samples), axis=0)).max(axis=(1, 2))
            if moved.max() <= largest_motion:
                return samples
            aim *= _ARC_RESERVE
            travelled = np.concatenate([[0.0], np.cumsum(moved)])
            even = np.linspace(0.0, travelled[-1], 1 + int(np.ceil(travelled[-1] / aim)))
            fractions = np.interp(even, travelled, fractions)


def _own_pairs(links: Capsules, tool: Capsules) -> NDArray[np.int64]:
    """Pairs (k, 2) of an arm's capsules that can meet: those with more between them than their own radii fill.

    Neighbours along the chain always touch; so do parts with only a short link between them. The tool counts as
    the end of the chain.
    """
    lengths = length(links.ends[:, 1] - links.ends[:, 0])
    count = len(lengths)
    pairs = []
    for i in range(count):
        for j in range(i + 2, count + len(tool)):
            last = min(j, count)
            radius_j = links.radius[j] if j < count else tool.radius[j - count]
            between = lengths[i + 1 : last].sum()
            if between > 1.25 * (links.radius[i] + radius_j):
                pairs.append((i, j))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)
