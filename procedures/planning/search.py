"""Search for paths of both arms' joint angles on which one arm moves at a time and keeps clear.

A point is the joint angles of both arms in one array, the active one's first; a path (w, n) changes those of one arm
from each point to the next.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from dualcal_hal.geometry import Placement
from dualcal_hal.transforms import Array
from procedures.planning.moves import Mover
from procedures.planning.rrt import connect, shorten

ITERATIONS = 100
"""Samples towards which a search for both arms grows before it gives up: about 3 s, 8 s among several fixtures.

Most ways that are searched for are found with the first three, few need more than twenty."""

ALONE_ITERATIONS = 40
"""The same for one arm as if the other were not: a fifth of a second, half a one among several fixtures."""

SHORTCUTS = 30
"""Random shortcuts tried on a path that was searched for."""


class Search:
    """Moves the arms it is given; one that is at its goal stays there. The same query has the same answer."""

    def __init__(self, movers: Sequence[Mover], placement: Placement, retreats: Sequence[Array]) -> None:
        self._movers = movers
        self._iterations = ITERATIONS if len(movers) > 1 else ALONE_ITERATIONS
        self._placement = placement
        self._retreats = retreats

    def moving(self, here: Array, there: Array) -> list[Mover]:
        """The arms that are not where they shall be."""
        return [mover for mover in self._movers if np.any(here[mover.axes] != there[mover.axes])]

    def moves(self, path: Array) -> Iterator[tuple[Mover, Array, Array]]:
        """Who moves from which point to which, along a path (w, n)."""
        for here, there in itertools.pairwise(path):
            for mover in self.moving(here, there):
                yield mover, here, there

    def direct(self, here: Array, there: Array) -> Iterator[Array]:
        """Paths of one move an arm: either first, or the only one that has to move."""
        movers = self.moving(here, there)
        if len(movers) < 2:
            yield np.array([here, there])
            return
        for first in movers:
            corner = here.copy()
            corner[first.axes] = there[first.axes]
            yield np.array([here, corner, there])

    def is_free(self, path: Array) -> bool:
        """Whether all moves of a path (w, n) keep clear."""
        for mover, here, there in self.moves(path):
            samples = mover.samples([here[mover.axes], there[mover.axes]])
            if mover.free_samples(samples, here) < len(samples):
                return False
        return True

    def straight(self, here: Array, there: Array) -> Array | None:
        """The first direct path that is free, or None."""
        return next((path for path in self.direct(here, there) if self.is_free(path)), None)

    def connects(self, here: Array, there: Array) -> bool:
        """Whether there is any path on which its arms come there, all others left where they are."""
        goal = here.copy()
        for mover in self._movers:
            goal[mover.axes] = there[mover.axes]
        if self.straight(here, goal) is not None:
            return True
        return self._connected(here, goal, self._random(here, goal)) is not None

    def around(self, here: Array, there: Array) -> Array | None:
        """A path by way of the retreats or random points, with shortcuts, or None if none was found."""
        rng = self._random(here, there)
        path = self._connected(here, there, rng)
        if path is None:
            return None
        return shorten(path, self.direct, self.is_free, self._duration, rng.random((SHORTCUTS, 2)))

    def _connected(self, here: Array, there: Array, rng: np.random.Generator) -> Array | None:
        scale = np.ones(len(here))
        for mover in self._movers:
            scale[mover.axes] = mover.arm.speed
        return connect(here, there, self._targets(here, there, rng), self._advance, scale)

    def _targets(self, here: Array, there: Array, rng: np.random.Generator) -> Iterator[Array]:
        """Points to grow towards: the retreats, then random ones, each joint in the turn that is nearest."""
        movers = self.moving(here, there)
        for i in range(len(self._retreats) + self._iterations):
            target = here.copy()
            for mover in movers:
                arm, axes = mover.arm, mover.axes
                q = self._retreats[i][axes] if i < len(self._retreats) else rng.uniform(arm.lower, arm.upper)
                target[axes] = arm.nearest_turn(q, (here[axes] + there[axes]) / 2)
            yield target

    def _advance(self, here: Array, target: Array) -> list[Array]:
        """The points towards a target, one arm after the other as far as each can, in the better of both orders."""
        movers = self.moving(here, target)
        one = self._advance_in(movers, here, target)
        if len(movers) < 2 or (one and np.array_equal(one[-1], target)):
            return one
        other = self._advance_in(movers[::-1], here, target)
        return min(one, other, key=lambda points: self._duration(np.array([points[-1] if points else here, target])))

    def _advance_in(self, order: Sequence[Mover], here: Array, target: Array) -> list[Array]:
        points = []
        for mover in order:
            samples = mover.samples([here[mover.axes], target[mover.axes]])
            free = mover.free_samples(samples, here)
            if free > 1:
                here = here.copy()
                here[mover.axes] = samples[free - 1] if free < len(samples) else target[mover.axes]
                points.append(here)
        return points

    def _duration(self, path: Array) -> float:
        return sum(mover.duration(path[:, mover.axes]) for mover in self._movers)

    def _random(self, here: Array, there: Array) -> np.random.Generator:
        """Of the query alone, so that its answer does not depend on what was asked before."""
        placement = self._placement
        query = [here, there, placement.T_P_A.ravel(), np.array([placement.translation, placement.rotation])]
        words = np.frombuffer(np.concatenate(query).tobytes(), dtype=np.uint32)
        return np.random.Generator(np.random.Philox(np.random.SeedSequence(words.tolist())))
