"""Ways for both arms from where they stand to where they shall be, one arm at a time."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.geometry import CellGeometry
from dualcal_hal.robot import Joints
from dualcal_hal.session.plain import Fields, expect, finites
from dualcal_hal.transforms import Array
from procedures.planning.belief import Belief
from procedures.planning.model import CellModel, Posture
from procedures.planning.moves import Mover
from procedures.planning.search import Search

_TRUE_ROUNDING = 1e-5
"""m by which distances of true shapes may differ that are the same."""


@dataclass(frozen=True)
class Leg:
    """One arm's move through ``waypoints`` (rad), straight in joint space from each to the next; the other stands."""

    arm: str
    waypoints: tuple[Joints, ...]

    @property
    def goal(self) -> Joints:
        """Where it ends."""
        return self.waypoints[-1]

    def to_record(self) -> dict[str, Any]:
        """As plain JSON."""
        return {"arm": self.arm, "waypoints_rad": self.waypoints}

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> Self:
        """And back, to the last bit; ValueError."""
        fields = Fields(record, "the leg")
        waypoints = tuple(finites(each, "waypoints_rad") for each in fields.items("waypoints_rad"))
        if not waypoints:
            raise ValueError("waypoints_rad is empty")
        return cls(fields.text("arm"), waypoints)


class WayFinder:
    """Finds ways that keep the clearance, for one belief.

    ``margin`` (m) is what checked postures keep clear, so that what lies between them keeps the procedure's clearance.
    """

    def __init__(self, model: CellModel, belief: Belief, retreats: Iterable[Posture]) -> None:
        self.geometry: CellGeometry = model.geometry
        self._model = model
        self._T_P_A = belief.placement.T_P_A
        movers = Mover.both(model, belief.placement)
        self.margin = movers[0].margin
        self._movers = {mover.arm.name: mover for mover in movers}
        points = [_point(posture) for posture in retreats]
        self._together = Search(movers, belief.placement, points)
        self._alone = [Search([replace(mover, is_alone=True)], belief.placement, points) for mover in movers]

    def from_record(self, record: Any) -> tuple[Leg, ...] | None:
        """A way of these arms that was recorded; ValueError for anything else."""
        if record is None:
            return None
        way = tuple(map(Leg.from_record, expect(record, list, "the way")))
        for leg in way:
            mover = self._movers.get(leg.arm)
            if mover is None:
                raise ValueError(f"there is no arm {leg.arm[:60]!r}")
            joints = mover.arm.chain.joints
            if any(len(waypoint) != joints for waypoint in leg.waypoints):
                raise ValueError(f"'{leg.arm}' has {joints} joints")
        return way

    def find(self, start: Posture, goal: Posture) -> tuple[Leg, ...] | None:
        """Legs from start to goal, or None if no way was found that keeps clear.

        Straight where that is free, else searched for: by way of a retreat, then by random points; what is found is
        checked once more in the true shapes. An arm that stands at its goal stays there: leaving it would make it
        arrive anew. The same query has the same answer, whatever was asked before.
        """
        here, there = _point(start), _point(goal)
        movers = self._together.moving(here, there)
        if not all(mover.is_within_limits(there) and mover.may_leave(here) for mover in movers):
            return None
        path = self._together.straight(here, there)
        if path is None and all(mover.is_clear(there) for mover in movers) and self._can_alone(here, there):
            path = self._together.around(here, there)
        if path is None:
            return None
        way = self._legs(path)
        return way if self._is_truly_clear(start, way) else None

    def clear(self, arm: str, start: Posture, waypoints: ArrayLike) -> bool:
        """Whether one arm's straight moves from ``start`` through waypoints (k, n) keep clear, the other standing."""
        ends = np.asarray(waypoints, dtype=float)
        path = np.tile(_point(start), (len(ends) + 1, 1))
        path[1:, self._movers[arm].axes] = ends
        return self._together.is_free(path)

    def clearance_along(self, start: Posture, way: Iterable[Leg]) -> float:
        """Least clearance in m, whatever the bases' error, of the checked postures of a way; inf if nothing moves."""
        least = np.inf
        for mover, point, waypoints in self._walk(start, way):
            least = min(least, float(np.min(mover.clearances(mover.samples(waypoints), point))))
        return least

    def travel(self, start: Posture, way: Iterable[Leg]) -> float:
        """Seconds that the arms need for a way, at rest at each of its waypoints."""
        return sum(mover.duration(waypoints) for mover, _, waypoints in self._walk(start, way))

    def blocked_by(self, start: Posture, goal: Posture) -> str:
        """What is in the way of the straight moves from start to goal, for each order of the arms; "" if nothing."""
        here, there = _point(start), _point(goal)
        beyond = [m.arm.name for m in self._together.moving(here, there) if not m.is_within_limits(there)]
        if beyond:
            return f"the goal of '{beyond[0]}' is outside its limits"
        paths = list(self._together.direct(here, there))
        obstructed = list(filter(None, map(self._obstruction, paths)))
        if not obstructed and not any(self._is_truly_clear(start, self._legs(path)) for path in paths):
            return (
                "in their true shapes the arms come too close to each other, to themselves or to what stands about them"
            )
        return "; ".join(obstructed)

    def is_clear_in_true_shapes(self, posture: Posture) -> bool:
        """Whether a posture keeps the procedure's clearance in the true shapes, the bases standing as believed."""
        return bool(np.all(self._true_clearances(_point(posture)) >= self._model.margin))

    def _is_truly_clear(self, start: Posture, way: Sequence[Leg]) -> bool:
        """Whether each leg's posture of least clearance, and where it ends, keep clear in the true shapes.

        What is closer than told at first may be left: each two parts come no closer than they were.
        """
        allowed = np.minimum(self._model.margin, self._true_clearances(_point(start))) - _TRUE_ROUNDING
        return all(np.all(self._true_clearances(point) >= allowed) for point in self._closest(start, way))

    def _closest(self, start: Posture, way: Sequence[Leg]) -> Iterator[Array]:
        """Of each leg the checked point with the least clearance, and its end."""
        for mover, point, waypoints in self._walk(start, way):
            samples = mover.samples(waypoints)
            for q in (samples[np.argmin(mover.clearances(samples, point).min(axis=0))], waypoints[-1]):
                passed = point.copy()
                passed[mover.axes] = q
                yield passed

    def _true_clearances(self, point: Array) -> Array:
        joints = self._model.active.chain.joints
        return self._model.exact.clearances(point[:joints], point[joints:], self._T_P_A)

    def _can_alone(self, here: Array, there: Array) -> bool:
        """Whether each arm could go there if the other were not: most goals without a way fail here, and sooner."""
        return all(search.connects(here, there) for search in self._alone)

    def _obstruction(self, path: Array) -> str:
        """The first move of a path that is not free, and what it comes close to."""
        before = ""
        for mover, here, there in self._together.moves(path):
            samples = mover.samples([here[mover.axes], there[mover.axes]])
            if mover.free_samples(samples, here) < len(samples):
                least, what = mover.closest(samples, here)
                how = f"comes within {least * 1e3:.0f} mm of" if least > 0 else "may touch"
                return f"{before}'{mover.arm.name}' {how} {what}"
            before = f"after '{mover.arm.name}' has moved, "
        return ""

    def _walk(self, start: Posture, way: Iterable[Leg]) -> Iterator[tuple[Mover, Array, Array]]:
        """Who moves, the point before it, and its waypoints (w, n) from there, for each leg."""
        point = _point(start)
        for leg in way:
            mover = self._movers[leg.arm]
            yield mover, point, np.array([point[mover.axes], *leg.waypoints])
            point = point.copy()
            point[mover.axes] = leg.goal

    def _legs(self, path: Array) -> tuple[Leg, ...]:
        moves = [(mover.arm.name, tuple(map(float, to[mover.axes]))) for mover, _, to in self._together.moves(path)]
        runs = itertools.groupby(moves, key=lambda move: move[0])
        return tuple(Leg(arm, tuple(waypoint for _, waypoint in run)) for arm, run in runs)


def _point(posture: Posture) -> Array:
    return np.array([*posture.active, *posture.passive])
