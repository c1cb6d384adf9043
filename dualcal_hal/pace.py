"""How fast arms may be: a share of their own speed, and a bound on the speed of every part of them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.geometry import ArmBody
from dualcal_hal.geometry.distance import length
from dualcal_hal.limits import JointLimits
from dualcal_hal.robot import JointPath, Joints

REDUCED_SPEED = 0.250
"""m/s that no part of an arm exceeds until a calibration of the cell was verified: the reduced speed of ISO 10218-1."""

_STEP = 0.02  # rad; over it a chord is shorter than its arc by less than 2e-5
_CHORDS = 1.0001
_NO_MOVE = 1e-12  # rad
_AIM = 0.98  # of a bound: what is read of where an arm stands scatters, and the bound is held against it once more


@dataclass(frozen=True)
class Pace:
    """share: of the speeds and accelerations in the cell file, at most 1; largest: m/s that no part may exceed, None
    for no bound."""

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
        path = _scaled(JointPath(waypoints, tuple(limits.speed), tuple(limits.acceleration)), self.share)
        bound = self.bound
        if bound is None:
            return path
        slower = [
            _AIM * bound / (segment.farthest * segment.at_speed)
            for segment in _segments(body, start, path)
            if segment.speed > _AIM * bound
        ]
        return _scaled(path, min(slower, default=1.0))

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
    """The highest speed (m/s) that any part of the arm comes to on ``path`` from ``start`` (n,) in rad."""
    return max((segment.speed for segment in _segments(body, start, path)), default=0.0)


def _scaled(path: JointPath, share: float) -> JointPath:
    """The same at a share of its speed; it speeds up as gently, so that it takes as long to come to its speed."""
    speed, acceleration = (tuple((share * np.array(bound)).tolist()) for bound in (path.speed, path.acceleration))
    return replace(path, speed=speed, acceleration=acceleration)


@dataclass(frozen=True)
class _Segment:
    """A straight way between two rests. farthest: m that a part moves for a share of it, where that is most; at_speed,
    at_most: shares a second at the path's speed, and those that the way is long enough to come to."""

    farthest: float
    at_speed: float
    at_most: float

    @property
    def speed(self) -> float:
        """Of the fastest part, m/s."""
        return self.farthest * min(self.at_speed, self.at_most)


def _segments(body: ArmBody, start: ArrayLike, path: JointPath) -> Iterator[_Segment]:
    points = np.array([start, *path.waypoints], dtype=float)
    for begin, end in itertools.pairwise(points):
        way = end - begin
        if np.max(np.abs(way)) < _NO_MOVE:
            continue
        steps = 1 + int(np.ceil(np.max(np.abs(way)) / _STEP))
        shares = np.linspace(0.0, 1.0, steps + 1)
        moved = length(np.diff(body.segments(begin + shares[:, None] * way), axis=0)).max()
        at_speed = 1.0 / float(np.max(np.abs(way) / np.array(path.speed)))
        # Half of the way speeds up, half slows down, by the joint that needs most for it.
        at_most = float(np.max(np.abs(way) / np.array(path.acceleration))) ** -0.5
        yield _Segment(float(_CHORDS * moved * steps), at_speed, at_most)


def part_speed(body: ArmBody, before: ArrayLike, after: ArrayLike, seconds: float) -> float:
    """The mean speed (m/s) of the fastest part of an arm that came from joint angles (n,) to others in ``seconds``."""
    there, here = body.segments(np.array([before, after], dtype=float))
    return float(length(here - there).max() / seconds)
