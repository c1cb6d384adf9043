"""Ways for both arms from where they stand to where they shall be, one arm at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.geometry import CellGeometry, interpolate
from dualcal_hal.robot import Joints
from procedures.planning.belief import Belief
from procedures.planning.model import CellModel, Posture


@dataclass(frozen=True)
class Leg:
    """One arm's move through ``waypoints`` (rad), straight in joint space from each to the next; the other stands."""

    arm: str
    waypoints: tuple[Joints, ...]

    @property
    def goal(self) -> Joints:
        """Where it ends."""
        return self.waypoints[-1]


class WayFinder:
    """Finds ways that keep the clearance, for one belief."""

    def __init__(self, model: CellModel, belief: Belief, retreats: Iterable[Posture]) -> None:
        self._model = model
        self._placement = belief.placement
        self.geometry: CellGeometry = model.geometry
        self._retreats = tuple(retreats)

    def find(self, start: Posture, goal: Posture) -> tuple[Leg, ...] | None:
        """Legs from start to goal, or None if no order of straight moves keeps clear.

        Tried in turn: either arm first, then one or both by way of a retreat. An arm that stands at its goal stays
        there: leaving it would make it arrive anew.
        """
        stays = {
            arm
            for arm, here, there in (
                (self._model.active.name, start.active, goal.active),
                (self._model.passive.name, start.passive, goal.passive),
            )
            if here == there
        }
        for candidate in self._candidates(start, goal):
            way = tuple(leg for leg in candidate if leg.arm not in stays)
            if self._way_clear(start, way):
                return way
        return None

    def clear(self, arm: str, start: Posture, waypoints: ArrayLike) -> bool:
        """Whether one arm's straight moves from ``start`` through waypoints (k, n) keep clear, the other standing."""
        if arm == self._model.active.name:
            path = interpolate(np.vstack([start.active, waypoints]))
            own = self.geometry.active.own_clearance(path)
            between = self.geometry.between(path, [start.passive], self._placement)
        else:
            path = interpolate(np.vstack([start.passive, waypoints]))
            own = self.geometry.passive.own_clearance(path)
            between = self.geometry.between([start.active], path, self._placement)
        clearance = np.minimum(own, between)
        # An arm that stands closer than the margin, because the belief has changed, may leave but come no closer.
        return bool(np.all(clearance >= min(self._model.margin, clearance[0])))

    def _candidates(self, start: Posture, goal: Posture) -> Iterator[tuple[Leg, ...]]:
        a, p = self._model.active.name, self._model.passive.name
        to_a, to_p = Leg(a, (goal.active,)), Leg(p, (goal.passive,))
        yield (to_a, to_p)
        yield (to_p, to_a)
        for retreat in self._retreats:
            back_a, back_p = Leg(a, (retreat.active,)), Leg(p, (retreat.passive,))
            yield (back_p, to_a, to_p)
            yield (back_a, to_p, to_a)
            yield (back_p, back_a, to_a, to_p)
            yield (back_a, back_p, to_p, to_a)

    def _way_clear(self, start: Posture, way: tuple[Leg, ...]) -> bool:
        posture = start
        for leg in way:
            if not self.clear(leg.arm, posture, leg.waypoints):
                return False
            if leg.arm == self._model.active.name:
                posture = Posture(leg.goal, posture.passive)
            else:
                posture = Posture(posture.active, leg.goal)
        return True
