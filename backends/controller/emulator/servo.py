"""How an arm's drives follow what they are told: a little later, and no faster than they can."""

from __future__ import annotations

import math
from collections import deque
from typing import Protocol

import numpy as np

from dualcal_hal.robot import Joints
from dualcal_hal.transforms import Array

TICK = 1 / 240
"""Seconds from one set point of the motors to the next."""

DELAY = 0.01
"""Seconds that a command takes to the motors."""

RESERVE = 5.0
"""By how much the drives can accelerate beyond what the cell file allows to motions."""

_POSITION_GAIN, _VELOCITY_GAIN = 50.0, 200.0  # 1/s: critically damped, as the one is four times the other
_AT_REST_WITHIN = 1e-6, 1e-4  # rad, rad/s: less than a step of the encoders
_KEPT = 480  # ticks that the past is remembered for: two seconds


class SetPoints(Protocol):
    """Where an arm is to be: a function of the time in s since its beginning, in the joints of the kinematics."""

    @property
    def end(self) -> float:
        """From when on it rests, s since its beginning; infinity as long as that is not known."""

    def sample(self, t: float) -> tuple[Array, Array]:
        """Joint angles (n,) in rad and velocities (n,) in rad/s, at ``t`` >= 0 and also after its end."""


class Still:
    """To be at rest at joint angles (n,) in rad."""

    end = 0.0

    def __init__(self, at: Array) -> None:
        self._at = np.array(at, dtype=float)

    def sample(self, t: float) -> tuple[Array, Array]:
        return self._at.copy(), np.zeros_like(self._at)


class Ramp:
    """Evenly from one place to another within ``end`` s: what a drive makes of one set point to the next."""

    def __init__(self, start: Array, target: Array, duration: float) -> None:
        self._start, self._target = np.array(start, dtype=float), np.array(target, dtype=float)
        self.end = duration

    def sample(self, t: float) -> tuple[Array, Array]:
        way = self._target - self._start
        if t >= self.end:
            return self._target.copy(), np.zeros_like(way)
        return self._start + (t / self.end) * way, way / self.end


class Braking:
    """From a place and a velocity, (n,) each, to rest as fast as accelerations (n,) allow, all joints in proportion."""

    def __init__(self, position: Array, velocity: Array, acceleration: Array) -> None:
        self._position, self._velocity = np.array(position, dtype=float), np.array(velocity, dtype=float)
        self.end = float(np.max(np.abs(velocity) / acceleration))

    def sample(self, t: float) -> tuple[Array, Array]:
        t = min(t, self.end)
        left = 1.0 - t / self.end if self.end else 0.0
        return self._position + t * (1.0 + left) / 2 * self._velocity, left * self._velocity


class Servo:
    """The motors' set points, made tick by tick from what the arm is told; times are of the emulated world, in s.

    All joints are held back in proportion, so that an arm that cannot keep up stays on a straight way.
    destination: the joint angles in rad at which it is to rest, as far as is known; end: since when it rests, infinity
    while it does not.
    """

    def __init__(self, home: Array, speed: Array, acceleration: Array) -> None:
        """``speed`` and ``acceleration`` (n,) are the cell file's bounds."""
        self._speed, self._brake, self._acceleration = speed, acceleration, RESERVE * acceleration
        self._told: list[tuple[float, SetPoints]] = [(-math.inf, Still(home))]
        self._past: deque[tuple[float, Array, Array]] = deque(maxlen=_KEPT)
        self._past.append((0.0, np.array(home, dtype=float), np.zeros(len(home))))
        self.end = 0.0

    @property
    def destination(self) -> Joints:
        _, told = self._told[-1]
        return tuple(told.sample(told.end)[0].tolist()) if math.isfinite(told.end) else self._commanded_now()

    def _commanded_now(self) -> Joints:
        since, told = self._told[-1]
        return tuple(told.sample(max(0.0, self._past[-1][0] - since))[0].tolist())

    def commanded(self, when: float) -> Array:
        """(n,) rad: where it was told to be at ``when``."""
        since, told = self._told[-1]
        return told.sample(max(0.0, when - since) if math.isfinite(since) else 0.0)[0]

    def tell(self, set_points: SetPoints, now: float) -> None:
        """Have it follow ``set_points``, whose beginning is ``now``."""
        self._wake(now)
        self._told.append((now, set_points))

    def brake(self, now: float) -> None:
        """Bring it to rest from where it is, at once."""
        self.sample(now)
        _, q, v = self._past[-1]
        self._told = [(now - DELAY, Braking(q, v, self._brake))]
        self._wake(now)

    def _wake(self, now: float) -> None:
        if math.isfinite(self.end):
            _, q, v = self._past[-1]
            self._past.append((now, q, v))
            self.end = math.inf

    def sample(self, when: float) -> tuple[Array, Array]:
        """Joint angles (n,) in rad and velocities (n,) in rad/s; up to two seconds back."""
        while math.isinf(self.end) and self._past[-1][0] + TICK <= when + 1e-9:
            self._tick()
        time, q, v = next((entry for entry in reversed(self._past) if entry[0] <= when + 1e-9), self._past[0])
        return q + min(max(0.0, when - time), TICK) * v, v.copy()

    def _tick(self) -> None:
        before, q, v = self._past[-1]
        now = before + TICK
        sought, sought_velocity, rests = self._told_at(now - DELAY)
        off = sought - (q + TICK * v)
        # No faster than it can still brake before it is there, and all joints in proportion.
        room = float(np.min(self._brake / np.maximum(np.abs(off), 1e-12)))
        wanted = _within(sought_velocity + min(_POSITION_GAIN, math.sqrt(2.0 * room)) * off, self._speed)
        change = _within(TICK * _VELOCITY_GAIN * (wanted - v), TICK * self._acceleration)
        v = v + change
        q = q + TICK * v
        within, slow = _AT_REST_WITHIN
        if rests and np.max(np.abs(sought - q)) <= within and np.max(np.abs(v)) <= slow:
            q, v = sought, np.zeros_like(v)
            self.end = now
        self._past.append((now, q, v))

    def _told_at(self, when: float) -> tuple[Array, Array, bool]:
        while len(self._told) > 1 and self._told[1][0] <= when:
            del self._told[0]
        since, told = self._told[0]
        t = max(0.0, when - since) if math.isfinite(since) else 0.0
        rests = len(self._told) == 1 and t >= told.end
        return *told.sample(t), rests


def _within(values: Array, bounds: Array) -> Array:
    """The values, all made smaller in proportion if any is beyond its bound."""
    return np.asarray(values / max(1.0, float(np.max(np.abs(values) / bounds))))
