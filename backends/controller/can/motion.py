"""What leads the drives from cycle to cycle: along a course, or by way of set-points of their own.

No thread, no bus: the cycle asks each time what to tell the drives next.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Sequence
from enum import Enum, auto

import numpy as np

from backends.controller.can.axis import Axis
from backends.controller.can.objects import AT_ONCE, HALT, NEW_SET_POINT, SET_POINT_TAKEN, TARGET_REACHED
from backends.controller.course import Course
from dualcal_hal.transforms import Array

HOLD_AT, SLOW_AT, STOP_AT = 1, 2, 3
"""How many late cycles in a row have the last target held, the course slowed down, and the arm stopped."""

_RECOVERY = 0.1  # of the course's speed, gained back by each cycle in time
_ROUNDING = 1e-6
_NO_WAY = 1e-12  # rad
_LEAD_IN = 0.5  # of the course's speed, at which the drives are led to where it begins


class Lead(ABC):
    """What the drives follow at the moment."""

    is_told: bool = False
    """Whether all of it was told to the drives."""
    is_over: bool = False
    """Whether nothing more is to come: told, or at rest after a brake."""
    is_braking: bool = False
    """Whether it is to end before its end."""
    halted: bool = False
    """Whether the drives are left with the halt bit set."""
    largest_step: float = 0.0
    """In shares of what the course's speed allows in a period."""

    @abstractmethod
    def command(self, axes: Sequence[Axis], late: int) -> None:
        """Set each axis's target and bits for the next cycle; ``late`` cycles went before in a row."""

    @abstractmethod
    def brake(self) -> None:
        """From the next cycle on, come to rest as fast as the arm can."""


class CourseLead(Lead):
    """A target in each cycle, along a course. In late cycles its time stands still or runs slower.

    So no step is larger than the course's speed in one period, however late a cycle comes.
    """

    def __init__(self, course: Course, held: Array, period: float) -> None:
        """``held`` (n,): the target that the drives have, rad; ``period``: s."""
        self._course = course
        self._period = period
        self._bound = course.speed * period
        self._last = np.array(held)
        self._time = 0.0
        self._pace = 1.0

    def command(self, axes: Sequence[Axis], late: int) -> None:
        target = self.next(late)
        for axis, angle in zip(axes, target.tolist(), strict=True):
            axis.target, axis.bits = axis.scale.to_counts(angle), 0

    def next(self, late: int) -> Array:
        """The target (n,), rad, of the next cycle. ValueError for a course that does not keep its own speed."""
        if late >= STOP_AT:
            self.brake()
        if self.is_over or (late == HOLD_AT and not self.is_braking):
            return self._last
        if late == SLOW_AT:
            self._pace *= 0.5
        elif not self.is_braking:
            self._pace = min(1.0, self._pace + _RECOVERY)
        if (leading := self._towards_start()) is not None:
            return self._step_to(leading)
        self._time = min(self._time + self._pace * self._period, self._course.duration)
        target = self._step_to(self._course.sample(self._time)[0])
        self._look_for_end()
        return target

    def brake(self) -> None:
        if self.is_braking:
            return
        self.is_braking = True
        if self._time > 0.0:
            self._course.brake(self._time)
            self._pace = max(self._pace, 0.5)  # else a course slowed down would also take long to end
        else:
            self.is_over = True

    def _towards_start(self) -> Array | None:
        """On the way from where the drives were left to where the course begins: a few counts, as a rule."""
        if self._time > 0.0:
            return None
        way = np.array(self._course.start) - self._last
        steps = np.ceil(float(np.max(np.abs(way) / (_LEAD_IN * self._bound), initial=0.0)))
        return self._last + way / steps if steps else None

    def _step_to(self, target: Array) -> Array:
        step = float(np.max(np.abs(target - self._last) / self._bound, initial=0.0))
        if step > 1.0 + _ROUNDING:
            raise ValueError(f"the course steps by {step:.3f} times what its speed allows in a cycle")
        self.largest_step = max(self.largest_step, step)
        self._last = target
        return target

    def _look_for_end(self) -> None:
        if self._time >= self._course.duration:
            self.is_over = True
            self.is_told = not self.is_braking


class _Handshake(Enum):
    WAITING = auto()
    """For a set-point."""
    PRESENTED = auto()
    """Bit 4 set, until all drives answer with bit 12."""
    RELEASED = auto()
    """Bit 4 cleared, until all drives have cleared bit 12."""
    MOVING = auto()
    """Until all drives have arrived."""


class SetPointLead(Lead):
    """Set-points that each drive makes its own way to (profile position), all handed over in one cycle.

    A brake is the halt bit, with which drives stand and stay enabled. It stays set until the next set-point was taken,
    as a drive would go on to the last one without it.
    """

    def __init__(self, halted: bool, arrival: int) -> None:
        """halted: whether the drives are held by the halt bit; arrival: counts within which a drive has arrived."""
        self.halted = halted
        self._arrival = arrival
        self._handshake = _Handshake.WAITING
        self._targets: Sequence[int] = ()
        self._last_one = False
        self._lock = threading.Lock()
        self.wake: threading.Event = threading.Event()
        """Set when the set-point is reached, or none will be any more."""

    def go(self, targets: Sequence[int], is_last: bool) -> None:
        """Hand ``targets`` over in the next cycle, counts; none any more once it brakes."""
        with self._lock:
            if self.is_braking:
                return
            self.wake.clear()
            self._targets, self._last_one = targets, is_last
            self._handshake = _Handshake.PRESENTED

    def brake(self) -> None:
        with self._lock:
            self.is_braking = self.halted = True
            self.is_over = True
        self.wake.set()

    def command(self, axes: Sequence[Axis], late: int) -> None:
        if late >= STOP_AT:
            self.brake()
        with self._lock:
            if not self.is_braking:
                self._proceed(axes)
            bits = HALT if self.halted else 0
            if self._handshake is _Handshake.PRESENTED and not self.is_braking:
                bits |= NEW_SET_POINT | AT_ONCE
        for number, axis in enumerate(axes):
            axis.bits = bits
            if self._targets:
                axis.target = self._targets[number]

    def _proceed(self, axes: Sequence[Axis]) -> None:
        taken = [bool(axis.statusword & SET_POINT_TAKEN) for axis in axes]
        if self._handshake is _Handshake.PRESENTED and all(taken):
            # Only a drive that was told of it in a cycle before can have taken it.
            if all(axis.bits & NEW_SET_POINT for axis in axes):
                self._handshake, self.halted = _Handshake.RELEASED, False
        elif self._handshake is _Handshake.RELEASED and not any(taken):
            self._handshake = _Handshake.MOVING
            self.is_told = self._last_one
        elif self._handshake is _Handshake.MOVING and self._arrived(axes):
            self._handshake = _Handshake.WAITING
            self.is_over = self._last_one
            self.wake.set()

    def _arrived(self, axes: Sequence[Axis]) -> bool:
        return all(self.has_arrived(axis, target) for axis, target in zip(axes, self._targets, strict=True))

    def has_arrived(self, axis: Axis, target: int) -> bool:
        """Whether a drive says so, and stands there."""
        return bool(axis.statusword & TARGET_REACHED) and abs(axis.position - target) <= self._arrival


def proportioned(way: Array, speed: Array, acceleration: Array) -> tuple[Array, Array]:
    """Speeds and accelerations (n,) with which joints that have ``way`` (n,) to go by trapezoids arrive together.

    The largest that keep ``speed`` and ``acceleration`` (n,), all in one unit of angle; zero where there is no way.
    """
    distance = np.abs(way)
    if np.max(distance, initial=0.0) < _NO_WAY:
        return np.zeros_like(distance), np.zeros_like(distance)
    gain = 1.0 / float(np.max(distance / acceleration))
    peak = min(1.0 / float(np.max(distance / speed)), gain**0.5)
    return distance * peak, distance * gain
