"""Where an arm's joints are meant to be: the set points of its motion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dualcal_hal.robot import JointPath, Joints
from dualcal_hal.transforms import Array

_NO_MOVE = 1e-12  # rad


@dataclass(frozen=True, eq=False)
class _Phase:
    """A stretch of constant acceleration; (n,) arrays at its ``begin``, times in s."""

    begin: float
    duration: float
    position: Array
    velocity: Array
    acceleration: Array

    @property
    def end(self) -> float:
        return self.begin + self.duration

    def sample(self, when: float) -> tuple[Array, Array]:
        t = when - self.begin
        position = self.position + t * (self.velocity + 0.5 * t * self.acceleration)
        return position, self.velocity + t * self.acceleration


class Trajectory:
    """An analytic function of time, in s.

    On each segment all joints move in proportion, by the shortest trapezoidal (or triangular) profile of
    velocity that no joint's speed and acceleration forbids. ``end``: when it comes to rest, or did; ``arrivals``: when
    it reaches each waypoint of the path that it follows.
    """

    def __init__(self, home: Array, acceleration: Array) -> None:
        self._acceleration = acceleration
        self._phases: tuple[_Phase, ...] = ()
        self._rest = np.array(home, dtype=float)
        self.end = 0.0
        self.arrivals: tuple[float, ...] = ()

    def follow(self, path: JointPath, now: float) -> None:
        """Begin at rest to follow ``path``, whose speeds the arm can keep."""
        speed, acceleration = np.array(path.speed), np.array(path.acceleration)
        phases: list[_Phase] = []
        self.end, position = now, self._rest
        arrivals = []
        for waypoint in path.waypoints:
            phases += _segment(self.end, position, np.array(waypoint), speed, acceleration)
            self.end = phases[-1].end if phases else now
            arrivals.append(self.end)
            position = np.array(waypoint)
        self.arrivals = tuple(arrivals)
        self._phases, self._rest = tuple(phases), position

    def rest(self, at: Array, since: float) -> None:
        """Be at rest at joint angles (n,) in rad, since a time in s."""
        self._phases, self._rest, self.end = (), np.array(at, dtype=float), since

    def brake(self, now: float) -> None:
        """Come to rest on the path as fast as the arm can."""
        position, velocity = self.sample(now)
        # All joints slow down in proportion, so the arm stays on its segment.
        duration = float(np.max(np.abs(velocity) / self._acceleration))
        if duration == 0.0:
            self._phases, self._rest, self.end = (), position, now
            return
        braking = _Phase(now, duration, position, velocity, -velocity / duration)
        self._phases, self._rest, self.end = (braking,), position + 0.5 * duration * velocity, braking.end

    def sample(self, when: float) -> tuple[Array, Array]:
        """Joint angles (n,) in rad and velocities (n,) in rad/s."""
        for phase in self._phases:
            if when < phase.end:
                return phase.sample(max(when, phase.begin))
        return self._rest.copy(), np.zeros_like(self._rest)

    @property
    def destination(self) -> Joints:
        """The joint angles in rad at which it comes to rest."""
        return tuple(self._rest.tolist())


def _segment(begin: float, start: Array, end: Array, speed: Array, acceleration: Array) -> Iterator[_Phase]:
    """The phases of a straight segment between two rests."""
    way = end - start
    if np.max(np.abs(way)) < _NO_MOVE:
        return
    # In shares of the segment; the slowest joint sets the pace.
    gain = 1.0 / float(np.max(np.abs(way) / acceleration))
    peak = min(1.0 / float(np.max(np.abs(way) / speed)), gain**0.5)
    ramp = peak / gain
    cruise = max(0.0, 1.0 / peak - ramp)
    still = np.zeros_like(way)
    up = _Phase(begin, ramp, start, still, gain * way)
    level = _Phase(up.end, cruise, up.sample(up.end)[0], peak * way, still)
    down = _Phase(level.end, ramp, level.sample(level.end)[0], peak * way, -gain * way)
    yield from (up, level, down)
