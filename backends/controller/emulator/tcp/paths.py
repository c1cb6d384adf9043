"""How controllers make a motion of the points that they get: set points of the arm, in the joints of the kinematics."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dualcal_hal.transforms import Array

_PARALLEL = 1e-4  # 1 - cosine of the angle between stretches that are one straight way
_NO_WAY = 1e-9  # rad


class Piece(Protocol):
    """A stretch of a motion from ``begin`` to ``end``, s."""

    @property
    def begin(self) -> float: ...

    @property
    def end(self) -> float: ...

    def sample(self, t: float) -> tuple[Array, Array]:
        """Joint angles (n,) in rad and velocities (n,) in rad/s, at a time between."""


@dataclass(frozen=True, eq=False)
class Cubic:
    """From one place to another, (n,) rad, with the velocities (n,) in rad/s there."""

    begin: float
    end: float
    start: Array
    goal: Array
    leaving: Array
    arriving: Array

    def sample(self, t: float) -> tuple[Array, Array]:
        T = self.end - self.begin
        s = (t - self.begin) / T
        way, a, b = self.goal - self.start, T * self.leaving, T * self.arriving
        c2, c3 = 3 * way - 2 * a - b, a + b - 2 * way
        return self.start + s * (a + s * (c2 + s * c3)), (a + s * (2 * c2 + 3 * s * c3)) / T


@dataclass(frozen=True, eq=False)
class Even:
    """A stretch of constant acceleration along a straight way: from ``place`` (n,) along ``along`` (n,), at first with
    ``speed``."""

    begin: float
    end: float
    place: Array
    along: Array
    speed: float
    acceleration: float

    def sample(self, t: float) -> tuple[Array, Array]:
        t = t - self.begin
        way = t * (self.speed + 0.5 * t * self.acceleration)
        return self.place + way * self.along, (self.speed + t * self.acceleration) * self.along


class Pieces:
    """Pieces one after the other, and rest behind the last. What changes them holds the arm's lock."""

    def __init__(self, start: Array) -> None:
        self.last = np.array(start, dtype=float)
        self._pieces: list[Piece] = []

    @property
    def end(self) -> float:
        return self._pieces[-1].end if self._pieces else 0.0

    def add(self, piece: Piece, goal: Array) -> None:
        """Behind the others, which are cut off where it begins; it ends at ``goal`` (n,)."""
        self._pieces.append(piece)
        self.last = np.array(goal, dtype=float)

    def sample(self, t: float) -> tuple[Array, Array]:
        if not self._pieces or t >= self.end:
            return self.last.copy(), np.zeros_like(self.last)
        # The last that has begun: those that end later than it begins were cut off by it.
        piece = next((piece for piece in reversed(self._pieces) if piece.begin <= t), None)
        if piece is None:
            first = self._pieces[0]
            q, v = first.sample(first.begin)
            return q, np.zeros_like(v)
        return piece.sample(min(t, piece.end))

    def cut(self, t: float) -> None:
        """Forget what has not begun at ``t``."""
        while self._pieces and self._pieces[-1].begin > t:
            self._pieces.pop()


class TimedStream:
    """Points that each have a duration, as they come; smooth where the next is known and goes straight on.

    It begins ``ahead`` s after a first point, so that more are known by then.
    """

    def __init__(self, start: Array, ahead: float) -> None:
        self._pieces = Pieces(start)
        self._ahead = ahead
        self._waiting: deque[tuple[Array, float]] = deque()
        self._next_begin = ahead
        self._leaving = np.zeros(len(start))

    @property
    def end(self) -> float:
        return math.inf if self._waiting else self._pieces.end

    @property
    def last(self) -> Array:
        """(n,) rad: where it leads, as far as it has been told."""
        return self._waiting[-1][0] if self._waiting else self._pieces.last

    def add(self, goal: Array, duration: float, t: float) -> None:
        """A further point, that came at ``t``."""
        self._begin_waiting(t)
        if not self._waiting and t > self._pieces.end:
            self._next_begin, self._leaving = t + self._ahead, np.zeros_like(goal)
        self._waiting.append((np.array(goal, dtype=float), duration))

    def sample(self, t: float) -> tuple[Array, Array]:
        self._begin_waiting(t)
        return self._pieces.sample(t)

    def _begin_waiting(self, t: float) -> None:
        while self._waiting and t >= self._next_begin:
            goal, duration = self._waiting.popleft()
            start, begin = self._pieces.last, self._next_begin
            arriving = self._arriving(start, goal, duration)
            self._pieces.add(Cubic(begin, begin + duration, start, goal, self._leaving, arriving), goal)
            self._next_begin, self._leaving = begin + duration, arriving

    def _arriving(self, start: Array, goal: Array, duration: float) -> Array:
        """(n,) rad/s at ``goal``: of the smoothest motion through the points known that lie straight on, to rest at the
        last of them."""
        places, durations = [start, goal], [duration]
        for place, lasts in self._waiting:
            if not straight_on(places[-2], places[-1], place):
                break
            places.append(place)
            durations.append(lasts)
        if len(places) == 2:
            return np.zeros_like(goal)
        ways = np.linalg.norm(np.diff(places, axis=0), axis=1)
        speed = _spline_speeds(ways, np.array(durations), float(np.linalg.norm(self._leaving)))[0]
        return np.asarray(max(speed, 0.0) * (places[2] - goal) / ways[1])


def _spline_speeds(ways: Array, durations: Array, first: float) -> Array:
    """Speeds (k - 1,) between stretches (k,) of a cubic spline that begins with speed ``first`` and ends at rest."""
    rates = 1.0 / durations
    system = np.diag(2.0 * (rates[:-1] + rates[1:]))
    system += np.diag(rates[1:-1], 1) + np.diag(rates[1:-1], -1)
    slopes = 3.0 * ways * rates**2
    right = slopes[:-1] + slopes[1:]
    right[0] -= rates[0] * first
    return np.asarray(np.linalg.solve(system, right))


class RunOn:
    """Points that the controller takes at its own speed, as they come; it runs on where the next goes straight on.

    speed, acceleration: (n,) bounds.
    """

    def __init__(self, start: Array, speed: Array, acceleration: Array) -> None:
        self._pieces = Pieces(start)
        self._speed, self._acceleration = speed, acceleration
        self._chain_start = np.array(start, dtype=float)
        self._peak = self._gain = 1.0
        self._planned = 0.0, 0.0  # when the present stretch was, and how much of it lay ahead, rad

    @property
    def end(self) -> float:
        return self._pieces.end

    @property
    def last(self) -> Array:
        """(n,) rad: where it leads."""
        return self._pieces.last

    def add(self, goal: Array, t: float, speed: Array) -> float:
        """A further point, that came at ``t`` and is gone to no faster than ``speed`` (n,).

        Returns when it will have left the point before behind.
        """
        self._speed, before = speed, self._pieces.last
        goal = np.array(goal, dtype=float)
        if t < self.end and straight_on(self._chain_start, self._pieces.last, goal):
            here, velocity = self._pieces.sample(t)
            self._pieces.cut(t)
            self._go(here, float(np.linalg.norm(velocity)), goal, t)
        else:
            self._chain_start = self._pieces.last
            self._go(self._chain_start, 0.0, goal, max(t, self.end))
        return self.end - self._last_lasts(float(np.linalg.norm(goal - before)))

    def sample(self, t: float) -> tuple[Array, Array]:
        return self._pieces.sample(t)

    def _go(self, here: Array, speed: float, goal: Array, begin: float) -> None:
        way = goal - here
        length = float(np.linalg.norm(way))
        self._planned = begin, length
        if length < _NO_WAY:
            self._pieces.last = goal
            return
        along = way / length
        fastest, gain = (
            float(np.min(bound / np.maximum(np.abs(along), 1e-12))) for bound in (self._speed, self._acceleration)
        )
        fastest = max(fastest, speed)
        peak = min(fastest, math.sqrt(gain * length + speed**2 / 2))
        ramps = (2 * peak**2 - speed**2) / (2 * gain)
        phases = ((peak - speed) / gain, speed, gain), ((length - ramps) / peak, peak, 0.0), (peak / gain, peak, -gain)
        place, moment = here, begin
        for lasts, at, change in phases:
            if lasts > 0.0:
                piece = Even(moment, moment + lasts, place, along, at, change)
                place, moment = piece.sample(piece.end)[0], piece.end
                self._pieces.add(piece, place)
        self._pieces.last = goal
        self._peak, self._gain = peak, gain

    def _last_lasts(self, way: float) -> float:
        """Seconds that the last ``way`` of the present stretch takes."""
        begin, length = self._planned
        if way >= length:
            return self.end - begin
        braking = self._peak**2 / (2 * self._gain)
        if way <= braking:
            return math.sqrt(2 * way / self._gain)
        return self._peak / self._gain + (way - braking) / self._peak


def straight_on(start: Array, corner: Array, goal: Array) -> bool:
    """Whether the way over a corner, (n,) each, is straight."""
    first, second = corner - start, goal - corner
    lengths = float(np.linalg.norm(first) * np.linalg.norm(second))
    return lengths > _NO_WAY**2 and float(first @ second) >= (1 - _PARALLEL) * lengths


def corners(start: Array, points: list[Array]) -> list[Array]:
    """The points (n,) without those that lie on a straight way, and those that lead nowhere."""
    kept: list[Array] = [start]
    for point in points:
        if float(np.max(np.abs(point - kept[-1]))) < _NO_WAY:
            continue
        if len(kept) > 1 and straight_on(kept[-2], kept[-1], point):
            kept.pop()
        kept.append(point)
    return kept[1:]
