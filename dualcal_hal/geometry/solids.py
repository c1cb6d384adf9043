"""What stands about an arm: solids fixed to its base, and how far segments stay from them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.geometry.distance import dot, length, unit
from dualcal_hal.geometry.placement import farthest_along, largest_motion
from dualcal_hal.transforms import Array, apply, inverse

_BISECTIONS = 16


class Solid(ABC):
    """A solid in a frame of its own."""

    @abstractmethod
    def separation(self, segments: Array, pivot: Array, translation: float, rotation: float) -> Array:
        """Least distance (...) in m between segments (..., 2, 3) and the solid; never more than the true one.

        Whatever the error of the segments' place within ``translation`` (m) and ``rotation`` (rad) about ``pivot``
        (3,). Not above zero where they may touch.
        """

    @abstractmethod
    def away(self, points: Array) -> Array:
        """Distance (...) in m of points (..., 3) from the solid, or less."""


class Convex(Solid):
    """A convex solid, kept clear of by the bound of :mod:`dualcal_hal.geometry.placement`."""

    @abstractmethod
    def nearest(self, points: Array) -> Array:
        """The points of the solid closest to points (..., 3)."""

    @abstractmethod
    def lowest_along(self, n: Array) -> Array:
        """The least n.f (...) over points f of the solid, for directions n (..., 3) from outside towards it."""

    def separation(self, segments: Array, pivot: Array, translation: float, rotation: float) -> Array:
        n = unit(self._gap(segments))
        moving = farthest_along(n[..., None, :], segments - pivot, rotation).max(axis=-1) + dot(n, pivot)
        return np.asarray(self.lowest_along(n) - moving - translation)

    def away(self, points: Array) -> Array:
        return length(points - self.nearest(points))

    def _gap(self, segments: Array) -> Array:
        """Vector (..., 3) to the solid from the closest point of a segment, by bisection: the distance is convex."""
        start, along = segments[..., 0, :], segments[..., 1, :] - segments[..., 0, :]
        fraction, step = np.full(start.shape[:-1], 0.5), 0.25
        for _ in range(_BISECTIONS):
            points = start + fraction[..., None] * along
            receding = dot(points - self.nearest(points), along)
            fraction -= step * np.sign(receding)
            step /= 2
        points = start + fraction[..., None] * along
        return self.nearest(points) - points


@dataclass(frozen=True, eq=False)
class Block(Convex):
    """A box about the origin; ``sizes``: (3,) m."""

    sizes: Array

    def nearest(self, points: Array) -> Array:
        return np.clip(points, -self.sizes / 2, self.sizes / 2)

    def lowest_along(self, n: Array) -> Array:
        return np.asarray(-np.abs(n) @ self.sizes / 2)


@dataclass(frozen=True)
class Cylinder(Convex):
    """A cylinder about the origin, along z; ``radius`` and ``length`` in m."""

    radius: float
    length: float

    def nearest(self, points: Array) -> Array:
        distance = np.hypot(points[..., 0], points[..., 1])
        shrink = np.minimum(1.0, self.radius / np.maximum(distance, 1e-12))
        z = np.clip(points[..., 2], -self.length / 2, self.length / 2)
        return np.stack([points[..., 0] * shrink, points[..., 1] * shrink, z], axis=-1)

    def lowest_along(self, n: Array) -> Array:
        return np.asarray(-self.radius * np.hypot(n[..., 0], n[..., 1]) - np.abs(n[..., 2]) * self.length / 2)


@dataclass(frozen=True)
class HalfSpace(Convex):
    """Everything with z below 0."""

    def nearest(self, points: Array) -> Array:
        return np.concatenate([points[..., :2], np.minimum(points[..., 2:], 0.0)], axis=-1)

    def lowest_along(self, n: Array) -> Array:
        return np.zeros(n.shape[:-1])  # n is straight down


@dataclass(frozen=True, eq=False)
class Fixture:
    """A solid that stands at ``T`` (4, 4) in a base's frame."""

    name: str
    solid: Solid
    T: Array

    def separation(self, segments: Array, enough: ArrayLike = np.inf) -> Array:
        """Least distance (k, c) in m from segments (k, c, 2, 3) in the fixture's base.

        What is farther than ``enough``, (c,) or one, may be said to be nearer, but not than that: it is quicker.
        """
        return self._separation(self.T, segments, 0.0, 0.0, enough)

    def separation_from_afar(
        self, T_X_base: Array, segments: Array, translation: float, rotation: float, enough: ArrayLike = np.inf
    ) -> Array:
        """The same from segments (k, c, 2, 3) in frame X, whatever the error of X, or of the base, about X's origin."""
        return self._separation(T_X_base @ self.T, segments, translation, rotation, enough)

    def _separation(self, T: Array, segments: Array, translation: float, rotation: float, enough: ArrayLike) -> Array:
        T_solid = inverse(T)
        pivot = T_solid[:3, 3]
        placed = apply(T_solid, segments.reshape(-1, 3)).reshape(segments.shape)
        if np.all(np.isinf(enough)):
            return self.solid.separation(placed, pivot, translation, rotation)
        half = length(placed[..., 1, :] - placed[..., 0, :]) / 2
        moved = largest_motion(placed - pivot, translation, rotation).max(axis=-1)
        separation = self.solid.away(placed.mean(axis=-2)) - half - moved
        # All segments of a posture or none: how a mesh is looked up depends on the longest of them.
        near = np.any(separation < enough, axis=-1)
        if np.any(near):
            separation[near] = self.solid.separation(placed[near], pivot, translation, rotation)
        return np.asarray(separation)
