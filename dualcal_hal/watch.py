"""What is watched while an arm of a real cell moves, on a thread of its own."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dualcal_hal.clock import Clock
from dualcal_hal.errors import DeviceError, DeviceTimeout, MotionFailed, MotionStopped
from dualcal_hal.robot import Joints, Mode, Robot, RobotState
from dualcal_hal.transforms import Array

FEEDBACK_PERIODS, LEAST_FEEDBACK_AGE = 3.0, 0.1
"""Feedback is too old after this many of its periods, and not before this many seconds."""

OWN_WORD_FIRST = 0.1
"""Seconds more that the device itself has to tell of it: its driver keeps the same rule, and knows what has failed."""

PERIOD_KNOWN_WITHIN = 0.5
"""Seconds for which no state may come before the period of the feedback is known: the slowest controllers tell ten a
second."""

OFF_THE_PATH = 0.05
"""rad that a joint may be off the path while it moves: lag along the path is none."""

LOOK_EVERY = 0.05
"""Seconds between two looks at clearance and speed."""

SPEED_SLACK = 1.1, 0.02
"""Factor and m/s by which the observed speed may exceed the bound: it is worked out from readings."""

SPEED_OVER = 0.1
"""Seconds over which a speed is observed, or from one state to the next where these are farther apart."""

_REMEMBERED = 1.0  # s
_PERIOD_SHARE = 0.2  # of a new interval in the mean of them


Alarm = Callable[[DeviceError, Sequence[DeviceError]], None]


@dataclass(frozen=True)
class Bounds:
    """What holds for one motion.

    other: the arm beside the one that moves; standing: where that stands, rad. waypoints: (w, n) rad, where the moving
    one stands first. corner: rad more that it may be off the path. clearance: of the moving arm's joint angles (n,) in
    rad and the other's, m; least: m that it may not fall below. speed: between two of its postures (rad) so many s
    apart, m/s; fastest: m/s that it may not exceed, None for any.
    """

    other: Robot
    standing: Joints
    waypoints: Array
    corner: float
    clearance: Callable[[Array, Array], float]
    least: float
    speed: Callable[[Joints, Joints, float], float]
    fastest: float | None


class Watch:
    """Looks at both arms until :meth:`end`; the first thing that is wrong is told to ``alarm``, on a thread of its own.

    ``alarm`` also gets what the arms themselves have told, to which more may come while it stops them.
    Both arms' feedback is fresh and tells of no fault; the one that moves is on its path, keeps clearance and speed.
    """

    def __init__(self, moving: Robot, bounds: Bounds, clock: Clock, alarm: Alarm) -> None:
        self._moving, self._other = moving, bounds.other
        self._bounds = bounds
        self._clock = clock
        self._alarm = alarm
        self._wake = threading.Event()
        self._ended = False
        self._failures: list[DeviceError] = []
        self._feedback = {robot.name: _Feedback(clock.now()) for robot in (moving, bounds.other)}
        self._leave = [
            leave
            for robot in (moving, bounds.other)
            for leave in (robot.observe(self._feedback[robot.name].arrived), robot.on_failure(self._on_failure))
        ]
        self._thread = threading.Thread(target=self._run, name=f"watch {moving.name}", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Look no more; any thread, any number of times."""
        self._ended = True
        self._wake.set()

    def _on_failure(self, error: DeviceError) -> None:
        if isinstance(error, MotionStopped):
            return  # stopped along with an arm of the same controller: whoever stopped that knows why
        self._failures.append(error)
        self._wake.set()

    def _run(self) -> None:
        try:
            while not self._ended:
                error = self._failures[0] if self._failures else self._look_safely()
                if error is not None and not self._ended:
                    self._alarm(error, self._failures)
                    return
                self._clock.wait(self._wake, self._clock.now() + LOOK_EVERY)
        finally:
            for leave in self._leave:
                leave()

    def _look_safely(self) -> DeviceError | None:
        """What cannot be looked at must not go on."""
        try:
            return self._look()
        except Exception as failed:  # noqa: BLE001 - an arm would move on, watched by nobody
            error = self._failed(f"this program could not look at it: {failed!r}")
            error.__cause__ = failed
            return error

    def _look(self) -> DeviceError | None:
        for robot in (self._moving, self._other) if self._other.joints else (self._moving,):
            error = self._feedback[robot.name].wrong(robot.name, self._clock.now())
            if error is not None:
                return error
        state, other = (self._feedback[robot.name].newest for robot in (self._moving, self._other))
        if state is None:
            return None
        q = np.array(state.positions)
        return self._off_path(q) or self._too_fast(state) or self._too_close(q, other) or self._other_moved(other)

    def _off_path(self, q: Array) -> DeviceError | None:
        off = off_path(self._bounds.waypoints, q)
        joint = int(np.argmax(off))
        if off[joint] <= OFF_THE_PATH + self._bounds.corner:
            return None
        return self._failed(f"joint {joint + 1} is {np.rad2deg(off[joint]):.2f} deg off its path")

    def _too_fast(self, state: RobotState) -> DeviceError | None:
        """By the mean over a while: arms that follow a stream of points swing about its speed."""
        fastest, before = self._bounds.fastest, self._feedback[self._moving.name].earlier(state.time - SPEED_OVER)
        if fastest is None or before is None:
            return None
        factor, slack = SPEED_SLACK
        speed = self._bounds.speed(before.positions, state.positions, state.time - before.time)
        if speed <= factor * fastest + slack:
            return None
        return self._failed(f"it moves at {speed * 1e3:.0f} mm/s, and {fastest * 1e3:.0f} mm/s is the most it may")

    def _too_close(self, q: Array, other: RobotState | None) -> DeviceError | None:
        if other is None and self._other.joints:  # a stand tells nothing, and stands
            return None
        clearance = self._bounds.clearance(q, np.array(() if other is None else other.positions))
        if clearance >= self._bounds.least:
            return None
        return self._failed(f"clearance may be down to {clearance * 1e3:.1f} mm, less than anywhere on its path")

    def _other_moved(self, other: RobotState | None) -> DeviceError | None:
        if other is None:
            return None
        moved = np.abs(np.subtract(other.positions, self._bounds.standing))
        joint = int(np.argmax(moved))
        if moved[joint] <= OFF_THE_PATH:
            return None
        why = f"it was to stand while {self._moving.name} moves, and joint {joint + 1} has turned by "
        return MotionFailed(
            self._other.name, "watch", f"{why}{np.rad2deg(moved[joint]):.2f} deg", "both arms are stopped; find out why"
        )

    def _failed(self, why: str) -> MotionFailed:
        return MotionFailed(self._moving.name, "move", why, "both arms are stopped; find out why first")


class _Feedback:
    """The states of one arm as they arrive."""

    def __init__(self, now: float) -> None:
        self.newest: RobotState | None = None
        self._arrived = now
        self._period = 0.0
        self._past: deque[RobotState] = deque()

    def arrived(self, state: RobotState) -> None:
        if self.newest is not None:
            interval = state.time - self.newest.time
            self._period = interval if not self._period else self._period + _PERIOD_SHARE * (interval - self._period)
        self.newest, self._arrived = state, state.time
        self._past.append(state)
        while self._past[0].time < state.time - _REMEMBERED:
            self._past.popleft()

    def earlier(self, time: float) -> RobotState | None:
        """The latest state that is no later than ``time``, None if there is none."""
        return next((state for state in reversed(tuple(self._past)) if state.time <= time), None)

    def wrong(self, arm: str, now: float) -> DeviceError | None:
        age, allowed = now - self._arrived, max(LEAST_FEEDBACK_AGE, FEEDBACK_PERIODS * self._period) + OWN_WORD_FIRST
        if not self._period:
            allowed = PERIOD_KNOWN_WITHIN
        if age > allowed:
            why = f"no state for {age:.2f} s where {allowed:.2f} s are allowed"
            return DeviceTimeout(arm, "watch", why, "check the link; both arms are stopped")
        state = self.newest
        if state is not None and (state.mode is not Mode.READY or state.faults):
            what = ", ".join([f"mode '{state.mode}'", *state.faults])
            return MotionFailed(arm, "watch", what, "clear it at the controller; both arms are stopped")
        return None


def off_path(waypoints: Array, q: Array) -> Array:
    """(n,) rad by which joint angles (n,) are off the polyline through ``waypoints`` (w, n), at its nearest point."""
    begin, way = waypoints[:-1], np.diff(waypoints, axis=0)
    square = np.maximum(np.sum(way**2, axis=1), 1e-18)
    share = np.clip(np.sum((q - begin) * way, axis=1) / square, 0.0, 1.0)
    off = np.abs(begin + share[:, None] * way - q)
    return np.asarray(off[np.argmin(np.max(off, axis=1))])
