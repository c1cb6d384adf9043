"""An arm's body: its capsules placed at joint angles, clear of itself and of what stands about its base."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from copy import copy

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualcal_hal.geometry.capsules import Capsules
from dualcal_hal.geometry.distance import length, segment_distance
from dualcal_hal.geometry.solids import Fixture
from dualcal_hal.kinematics import Chain, random_joints
from dualcal_hal.transforms import Array

LARGEST_MOTION = 0.010
"""No point of an arm moves further (m) between two checks along a path."""

BETWEEN_SAMPLES = LARGEST_MOTION / 2
"""What clearance may fall short (m) between two checks: every point is within this of its place at one of them."""

LEAST_APART = 0.008
"""m; parts of one arm that no posture brings so far apart are not held against each other."""

_POSTURES = 400
_COARSE_STEP = 0.05  # rad; chords of it differ from their arcs by less than a thousandth
_ARC_RESERVE = 0.99


class ArmBody:
    """An arm with what it carries and what stands about its base.

    links, tool: its capsules; floor: height in its base, m, or None; fixtures: in its base; clearance: m, what shall be
    kept. pairs: (k, 2) numbers of capsules that can meet; relief: (k,) m, added to the distance of pairs that are built
    too close together for the clearance; above_floor, moving: numbers of those held against the floor and the other
    base's fixtures, and against its own base's.
    """

    def __init__(
        self,
        chain: Chain,
        links: Capsules,
        tool: Capsules,
        floor: float | None,
        fixtures: Sequence[Fixture] = (),
        clearance: float = 0.0,
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
        self.pairs, self.relief = self._held_apart(clearance)

    def segments(self, q: ArrayLike) -> Array:
        """Joint angles (k, n) to the capsules' ends in the arm's base, (k, c, 2, 3)."""
        frames = self.chain.frames(q)[:, self.capsules.frame, None, :3]
        x, y, z = np.moveaxis(self.capsules.ends[..., None], 2, 0)
        # Written out: a product of many small matrices takes three times as long.
        return np.asarray(frames[..., 0] * x + frames[..., 1] * y + frames[..., 2] * z + frames[..., 3])

    def own_clearance(self, q: ArrayLike) -> Array:
        """Least distance (k,) in m to the floor, to the fixtures of its base, and between parts that may meet.

        Parts have their relief. Infinite if there is nothing to meet.
        """
        return self.own_clearance_at(self.segments(np.atleast_2d(np.asarray(q, dtype=float))))

    def own_clearance_at(self, segments: Array, enough: float = np.inf) -> Array:
        """The same, (k,) in m, with the capsules' ends at (k, c, 2, 3) in the arm's base.

        More than ``enough`` (m) may be said to be less, but not than that: it is quicker.
        """
        return np.asarray(self.own_clearances_at(segments, enough).min(axis=0))

    def own_clearances_at(self, segments: Array, enough: float = np.inf) -> Array:
        """The same, (2 + fixtures, k): to itself, to the floor, to each of the fixtures of its base."""
        radius = self.capsules.radius
        clearances = np.full((2 + len(self.fixtures), len(segments)), np.inf)
        if len(self.pairs):
            clearances[0] = (self._own_distances(segments, self.pairs) + self.relief).min(axis=1)
        if self.floor is not None:
            heights = segments[..., 2][:, self.above_floor].min(axis=2) - radius[self.above_floor]
            clearances[1] = heights.min(axis=1, initial=np.inf) - self.floor
        for number, fixture in enumerate(self.fixtures, start=2):
            distance = fixture.separation(segments[:, self.moving], enough + radius[self.moving])
            clearances[number] = (distance - radius[self.moving]).min(axis=1)
        return clearances

    def without(self, fixture: str) -> ArmBody:
        """The same without one of the fixtures of its base."""
        other = copy(self)
        other.fixtures = tuple(standing for standing in self.fixtures if standing.name != fixture)
        return other

    def sampled(self, waypoints: ArrayLike, largest_motion: float = LARGEST_MOTION) -> Array:
        """Joint waypoints (w, n) to samples (k, n) on the straight segments between them, the waypoints included.

        No point of the arm moves further than ``largest_motion`` (m) from one sample to the next; of a rigid capsule
        an end moves furthest.
        """
        points = np.atleast_2d(np.asarray(waypoints, dtype=float))
        straight = [self._straight(*ends, largest_motion)[1:] for ends in itertools.pairwise(points)]
        return np.concatenate([points[:1], *straight])

    def _held_apart(self, clearance: float) -> tuple[NDArray[np.int64], Array]:
        """Pairs (k, 2) of capsules that are held against each other, and what is added to the distance of each (k,).

        Neighbours along the chain always touch, and so do parts with only a short link between them: parts that no
        posture brings apart say nothing about a posture. Others can be brought apart, but not by the clearance: these
        need only half of the distance that is possible. What the arm carries counts as one part, the end of the chain.
        """
        count = len(self.links)
        pairs = np.array(
            [(i, j) for i in range(count) for j in range(i + 2, count + len(self.tool)) if min(j, count) >= i + 2],
            dtype=np.int64,
        ).reshape(-1, 2)
        if len(pairs) == 0:
            return pairs, np.zeros(0)
        q = random_joints(np.random.default_rng(0), _POSTURES, np.full(self.chain.joints, -np.pi), np.pi)
        distance = self._own_distances(self.segments(q), pairs)
        part = np.minimum(pairs[:, 1], count)
        possible = np.empty(len(pairs))
        for i, j in set(zip(pairs[:, 0].tolist(), part.tolist(), strict=True)):
            same = (pairs[:, 0] == i) & (part == j)
            possible[same] = distance[:, same].min(axis=1).max()
        held = possible >= LEAST_APART
        needed = np.minimum(clearance + BETWEEN_SAMPLES, possible[held] / 2)
        return np.asarray(pairs[held]), np.asarray(clearance + BETWEEN_SAMPLES - needed)

    def _own_distances(self, segments: Array, pairs: NDArray[np.int64]) -> Array:
        """Distances (k, p) in m of the pairs (p, 2) with the capsules' ends at (k, c, 2, 3)."""
        first, second = pairs.T
        radius = self.capsules.radius
        distance = segment_distance(segments[:, first], segments[:, second])
        return np.asarray(distance - radius[first] - radius[second])

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
