"""The set points that a drive makes for its one axis by itself."""

from __future__ import annotations

import math


class TrajectoryGenerator:
    """A position and a velocity that change by speed and acceleration; counts, counts/s."""

    def __init__(self) -> None:
        self.position = 0.0
        self.velocity = 0.0

    def rest(self, position: float) -> None:
        """Stand at a position."""
        self.position, self.velocity = position, 0.0

    def follow(self, position: float, dt: float) -> None:
        """Be where another one says, ``dt`` s after the last time."""
        if dt > 0.0:
            self.velocity = (position - self.position) / dt
        self.position = position

    def brake(self, deceleration: float, dt: float) -> bool:
        """Slow down for ``dt`` s; says whether it has come to rest."""
        return self._change_to(0.0, deceleration * dt, dt)

    def approach(self, target: float, speed: float, acceleration: float, deceleration: float, dt: float) -> bool:
        """Go on towards ``target`` for ``dt`` s; says whether it stands there.

        The speed is one from which a step of this length and a braking end at the target at the farthest.
        """
        way = target - self.position
        step = deceleration * dt
        if abs(way) < 0.5 and abs(self.velocity) <= step:
            self.rest(target)
            return True
        wanted = min(speed, math.sqrt(step * step + 2.0 * deceleration * abs(way)) - step)
        slower = self.velocity * way < 0.0 or abs(self.velocity) > wanted
        self._change_to(math.copysign(wanted, way), step if slower else acceleration * dt, dt)
        return False

    def _change_to(self, velocity: float, most: float, dt: float) -> bool:
        self.velocity += max(-most, min(most, velocity - self.velocity))
        self.position += self.velocity * dt
        return self.velocity == velocity
