"""How fast arms may be: a share of their own speed, and a bound on the speed of every part of them."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.geometry import ArmBody
from dualcal_hal.geometry.distance import length
from dualcal_hal.limits import JointLimits
from dualcal_hal.robot import JointPath, Joints
from dualcal_hal.transforms import Array

REDUCED_SPEED = 0.250
"""m/s that no part of an arm exceeds until a calibration of the cell was verified: the reduced speed of ISO 10218-1."""

_STEP = 0.02  # rad; over it a chord is shorter than its arc by less than 2e-5
_CHORDS = 1.0001
_INSTANT = 1e-4  # s


@dataclass(frozen=True)
class Pace:
    """share: of the speeds in the cell file, at most 1; largest: m/s that no part may exceed, None for no bound."""

    share: float = 1.0
    largest: float | None = None

    @property
    def to_be_confirmed(self) -> float | None:
        """m/s that a controller which moves at a speed of its own must be confirmed to keep; None for any."""
        if self.largest is None and self.share >= 1.0:
            return None
        return self.share * REDUCED_SPEED

    def path(self, start: Joints, waypoints: tuple[Joints, ...], limits: JointLimits, body: ArmBody) -> JointPath:
        """The fastest path through ``waypoints`` (rad) that this and the arm's ``limits`` allow."""
        speed, acceleration = self.share * limits.speed, tuple(map(float, limits.acceleration))
        path = JointPath(waypoints, tuple(map(float, speed)), acceleration)
        bound = self.bound
        if bound is None or (fastest := fastest_part(body, start, path)) <= bound:
            return path
        return replace(path, speed=tuple(map(float, speed * bound / fastest)))

    @property
    def bound(self) -> float | None:
        """m/s that no part exceeds: the share counts here, too."""
        return None if self.largest is None else self.share * self.largest

    def at_most(self, speed: float | None) -> Pace:
        """The same for an arm that is not to be faster than ``speed`` (m/s) in any case."""
        if speed is None:
            return self
        return replace(self, largest=speed if self.largest is None else min(speed, self.largest))


FULL_PACE = Pace()
"""As fast as the arms are."""


def fastest_part(body: ArmBody, start: ArrayLike, path: JointPath) -> float:
    """The highest speed (m/s) that any part of the arm can come to on ``path`` from ``start`` (n,) in rad."""
    fastest = 0.0
    points = np.array([start, *path.waypoints], dtype=float)
    for begin, end in itertools.pairwise(points):
        way = end - begin
        if not np.any(way):
            continue
        steps = 1 + int(np.ceil(np.max(np.abs(way)) / _STEP))
        shares = np.linspace(0.0, 1.0, steps + 1)
        moved = length(np.diff(body.segments(begin + shares[:, None] * way), axis=0)).max()
        shares_a_second = 1.0 / float(np.max(np.abs(way) / np.array(path.speed)))
        fastest = max(fastest, float(_CHORDS * moved * steps * shares_a_second))
    return fastest


def part_speed(body: ArmBody, q: Array, velocity: Array) -> float:
    """The speed (m/s) of the fastest part of an arm at joint angles (n,) in rad that change by (n,) rad/s."""
    there, later = body.segments(np.array([q, q + _INSTANT * velocity]))
    return float(length(later - there).max() / _INSTANT)
