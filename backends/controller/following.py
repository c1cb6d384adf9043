"""A motion from when it is asked for until it has ended, by what the arm's controller reports."""

from __future__ import annotations

import numpy as np

from backends.controller.course import Course
from backends.controller.link import ArmReport, Transfer
from dualcal_hal.clock import Clock
from dualcal_hal.errors import DeviceError, MotionFailed
from dualcal_hal.robot import Motion, MotionState, RobotState
from dualcal_hal.transforms import Array

ARRIVED = 5e-4
"""rad within which each joint is where it was sent."""

STANDS_FOR = 0.05
"""Seconds that an arm has to stand before it has arrived: between two points of a stream it may seem to."""

NEVER_LEFT = 1.0
"""The same for a way that leads back to where it begins, of which no report shows the part in between."""

NEVER_ARRIVED = 3.0
"""Seconds that an arm may stand elsewhere once all was acknowledged: a controller may take a while to begin."""


class Standing:
    """Since when an arm stands, by its reports; by its positions where the controller does not say.

    unmoved: rad that readings of a joint at rest may differ by.
    """

    def __init__(self, unmoved: float = 1e-4) -> None:
        self._unmoved = unmoved
        self._since: float | None = None
        self._at: Array | None = None

    def look(self, report: ArmReport) -> float:
        """Seconds for which it stands at this report, negative if it moves."""
        at = np.array(report.positions)
        moves = report.in_motion
        if moves is None:
            moves = self._at is None or bool(np.max(np.abs(at - self._at)) > self._unmoved)
        if moves:
            self._since, self._at = None, at
            return -1.0
        if self._since is None:
            self._since, self._at = report.time, at
        return report.time - self._since


class Following:
    """``begun``: whether its course has been accepted. It ends its motion by settling alone; the rest is the arm's."""

    def __init__(self, motion: Motion, clock: Clock, begins_within: float = 0.0) -> None:
        """``begins_within``: as the link's."""
        self.motion = motion
        self._begins_within = begins_within
        self._clock = clock
        self._course: Course | None = None
        self._transfer = Transfer()
        self._begin = clock.now()
        self._standing = Standing()
        self._near = self._far = self._excursion = False
        self._stopping = False

    @property
    def begun(self) -> bool:
        return self._course is not None

    @property
    def stopped(self) -> bool:
        """Whether a stop was asked for."""
        return self._stopping

    def begin(self, course: Course, transfer: Transfer) -> None:
        """The controller has begun to take ``course``."""
        self._transfer, self._begin = transfer, self._clock.now()
        goal = course.waypoints[-1]
        # A way that leads back to where it begins, or hardly away from there, looks done before it has begun.
        self._near = bool(np.max(np.abs(np.subtract(course.start, goal))) <= ARRIVED)
        self._far = bool(np.max(np.abs(np.subtract(course.waypoints, goal))) > ARRIVED)
        self._course = course

    def stopping(self) -> float:
        """A stop is about to be sent; returns the seconds that braking may take."""
        self._stopping = True
        return 0.0 if self._course is None else float(np.max(self._course.speed / self._course.acceleration))

    def look(self, report: ArmReport, state: RobotState) -> DeviceError | None:
        """Settle the motion if it is done by this report; the error by which it cannot come to be."""
        course = self._course
        if course is None or self._stopping or self.motion.state is not MotionState.RUNNING:
            return None
        away = np.abs(np.subtract(report.positions, course.waypoints[-1]))
        arrived = bool(np.max(away) <= ARRIVED)
        self._excursion = self._excursion or not arrived
        stands = self._standing.look(report)
        if not self._transfer.complete:
            return None
        if arrived and stands >= self._has_to_stand():
            self.motion.settle(state)
        elif not arrived and stands >= NEVER_ARRIVED and self._clock.now() >= self._begin + course.duration:
            return self._missed(away)
        return None

    def _has_to_stand(self) -> float:
        """Seconds for which it has to stand at its goal before it has arrived."""
        if self._excursion or not self._near:
            return STANDS_FOR
        return max(STANDS_FOR, self._begins_within, NEVER_LEFT if self._far else 0.0)

    def fail(self, error: DeviceError) -> None:
        """End the motion by an error."""
        self.motion.end(MotionState.FAILED, None, error)

    def _missed(self, away: Array) -> MotionFailed:
        joint = int(np.argmax(away))
        why = (
            f"all points were acknowledged, and it stands with joint {joint + 1} "
            f"{np.rad2deg(away[joint]):.3f} deg from where it was sent"
        )
        return MotionFailed(self.motion.device, "move", why, "look at the controller: its log, its speed, its mode")
