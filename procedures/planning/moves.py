"""Moves of one arm while the other stands: how far they keep clear, how long they take, what is in their way.

A point is the joint angles of both arms in one array, the active one's first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.geometry import BETWEEN_SAMPLES, ArmBody, CellGeometry, Placement
from dualcal_hal.transforms import Array
from procedures.planning.model import ArmModel, CellModel
from procedures.planning.obstacles import closest_of_active, closest_of_passive, closest_own

_COARSE = 8  # every eighth sample of a move is checked before all of them
_ROUNDING = 1e-9  # m and rad, for what rounding does at the margin and at a limit


@dataclass(frozen=True, eq=False)
class Mover:
    """One arm, with the other one standing.

    axes, standing_axes: which of a point's axes are its own and the other's; margin: m, what checked postures keep
    clear.
    """

    arm: ArmModel
    axes: slice
    standing: ArmModel
    standing_axes: slice
    geometry: CellGeometry
    placement: Placement
    margin: float
    is_active: bool
    is_alone: bool = False
    """As if the other arm, and what stands about its base, were not there."""

    @staticmethod
    def both(model: CellModel, placement: Placement) -> tuple[Mover, Mover]:
        """The active arm and the passive one; the margin includes what clearance may fall short between samples."""
        n = model.active.chain.joints
        active, passive = (model.active, slice(0, n)), (model.passive, slice(n, None))
        margin = model.margin + BETWEEN_SAMPLES
        return (
            Mover(*active, *passive, model.geometry, placement, margin, is_active=True),
            Mover(*passive, *active, model.geometry, placement, margin, is_active=False),
        )

    def samples(self, waypoints: ArrayLike) -> Array:
        """Joint waypoints (w, n) to the joint angles (k, n) that are checked."""
        return self._body.sampled(waypoints)

    def clearances(self, q: Array, point: Array, enough: float = np.inf) -> Array:
        """Least clearance at joint angles (k, n), whatever the bases' error; the other arm stands as in the point.

        (2, k) in m: to the other arm and what stands about its base, and to the floor, its own fixtures and itself.
        More than ``enough`` may be said to be less, but not than that: it is quicker.
        """
        segments = self._body.segments(q)
        own = self._body.own_clearance_at(segments, enough)
        if self.is_alone:
            return np.stack([np.full(len(q), np.inf), own])
        standing = self._standing_body.segments(point[None, self.standing_axes])
        both = (segments, standing) if self.is_active else (standing, segments)
        return np.stack([self.geometry.between_at(*both, self.placement, enough), own])

    def free_samples(self, samples: Array, point: Array) -> int:
        """How many of the samples (k, n) of a move can be passed from its first on.

        An arm that stands closer than the margin may leave: its clearance may only grow until it has the margin. Not
        where the bases may be so wrong that it touches the other arm: then every way could lead deeper into it.
        """
        free = len(samples)
        for stride in (_COARSE, 1):
            clearances = self.clearances(samples[:free:stride], point, self.margin)
            if clearances[0, 0] < self._least_to_leave:
                return 0
            allowed = np.minimum(self.margin, np.maximum.accumulate(clearances, axis=1)) - _ROUNDING
            blocked = np.flatnonzero(np.any(clearances < allowed, axis=0))
            if len(blocked):
                free = int(blocked[0]) * stride
        return free

    def may_leave(self, point: Array) -> bool:
        """Whether it is sure not to touch the other arm, or what stands about that, where it stands in the point."""
        return bool(self.clearances(point[None, self.axes], point)[0, 0] >= self._least_to_leave)

    def is_within_limits(self, point: Array) -> bool:
        """Whether its joint angles in the point are within the procedure's limits."""
        return bool(self.arm.joint_margin(point[self.axes]) >= -_ROUNDING)

    def is_clear(self, point: Array) -> bool:
        """Whether it keeps the margin where it stands in the point."""
        return bool(np.all(self.clearances(point[None, self.axes], point) >= self.margin - _ROUNDING))

    def duration(self, waypoints: Array) -> float:
        """Seconds for joint waypoints (w, n), at rest at each of them."""
        return float(np.sum(self.arm.move_time(waypoints[:-1], waypoints[1:])))

    def closest(self, samples: Array, point: Array) -> tuple[float, str]:
        """The least clearance in m at joint angles (k, n), and of what."""
        clearances = self.clearances(samples, point)
        own, worst = np.unravel_index(np.argmin(clearances), clearances.shape)
        least, q, there = float(clearances[own, worst]), samples[worst], point[self.standing_axes]
        if own:
            return least, closest_own(self._body, q)
        if self.is_active:
            return least, closest_of_passive(self.geometry, self.placement, q, there, self.standing.name)
        return least, closest_of_active(self.geometry, self.placement, there, q, self.standing.name)

    @property
    def _least_to_leave(self) -> float:
        return min(BETWEEN_SAMPLES, self.margin)

    @property
    def _body(self) -> ArmBody:
        return self.geometry.active if self.is_active else self.geometry.passive

    @property
    def _standing_body(self) -> ArmBody:
        return self.geometry.passive if self.is_active else self.geometry.active
