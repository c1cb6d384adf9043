"""One arm of a controller: what it reports in the joints of its kinematics, and the motions it is asked for."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from backends.controller.course import Course
from backends.controller.following import STANDS_FOR, Following, Standing
from backends.controller.joint_map import JointMap
from backends.controller.link import ArmLink, ArmReport, Transfer
from dualcal_hal.clock import Clock
from dualcal_hal.errors import CommandRefused, DeviceError, DeviceTimeout, LinkLost, MotionFailed, NotOpen
from dualcal_hal.findings import Finding
from dualcal_hal.limits import JointLimits
from dualcal_hal.robot import JointPath, Mode, Motion, Robot, RobotState, StopResult
from dualcal_hal.transforms import Array

STOP_CONFIRMED_WITHIN = 0.5
"""Seconds after the braking itself within which a stop is to be confirmed by a newer report."""

STATE_TIMEOUT = 1.0
"""Seconds within which a report has to come before a motion."""


_STOP_AGAIN_AFTER = 0.02  # s, where the link was lost


@dataclass(frozen=True)
class OwnSpeed:
    """Of a controller that ignores the speed it is sent; confirmed: m/s that it was confirmed to be set to, or None."""

    confirmed: float | None


class ControlledRobot(Robot):
    """Its link is given by :meth:`attach` while the backend is open; without one every call raises NotOpen."""

    def __init__(
        self, name: str, limits: JointLimits, joint_map: JointMap, clock: Clock, speed: OwnSpeed | None = None
    ) -> None:
        """``speed``: the controller's own, where it does not keep a path's."""
        self.name = name
        self._speed = speed
        self._limits = limits
        self._map = joint_map
        self._clock = clock
        self._link: ArmLink | None = None
        self._detach: list[Callable[[], None]] = []
        self._lock = threading.RLock()
        self._previous: ArmReport | None = None
        self._following: Following | None = None
        self._states: list[Callable[[RobotState], None]] = []
        self._failures: list[Callable[[DeviceError], None]] = []

    def attach(self, link: ArmLink) -> None:
        """Speak to the arm through an open link from here on."""
        self._link, self._previous = link, None
        self._detach = [link.subscribe(self._on_report), link.on_failure(self._on_failure)]

    def detach(self) -> None:
        """The link is about to be closed: a motion under way is stopped."""
        link, self._link = self._link, None
        with self._lock:
            following, self._following = self._following, None
            self._states, self._failures = [], []
        if link is not None and following is not None:
            following.stopping()
            with suppress(DeviceError):  # closing the link stops the arm, too
                link.stop("its backend is closed")
            following.motion.stop("its backend was closed")
        while self._detach:
            self._detach.pop()()

    @property
    def joints(self) -> int:
        return len(self._limits.lower)

    @property
    def keeps_speed(self) -> bool:
        return self._speed is None

    @property
    def confirmed_speed(self) -> float | None:
        return None if self._speed is None else self._speed.confirmed

    def read(self, timeout: float) -> RobotState:
        link, now = self._opened("read"), self._clock.now()
        return self._state(link.report_after(now, now + timeout))

    def subscribe(self, function: Callable[[RobotState], None]) -> Callable[[], None]:
        """States as they arrive; a ``function`` that raises gets no more, and that is told as a failure."""
        self._opened("subscribe")
        return _added(self._states, function)

    def on_failure(self, function: Callable[[DeviceError], None]) -> Callable[[], None]:
        self._opened("watch")
        return _added(self._failures, function)

    def start(self, path: JointPath) -> Motion:
        """Hand the path over, once a report asked for now says that the arm is ready and stands.

        What is stopped meanwhile does not begin, or is stopped as it begins.
        """
        link = self._opened("move")
        if (why := self._limits.objection(path)) is not None:
            raise CommandRefused(self.name, "move", why, "check the path")
        with self._lock:
            self._refuse_if_moving("move")
            motion = Motion(self.name, self._clock)
            following = Following(motion, self._clock, link.begins_within)
            self._following = following
        motion.on_end(lambda: self._ended(following))
        try:
            now = self._clock.now()
            report = link.report_after(now, now + STATE_TIMEOUT)
            self._refuse_unless_ready(report)
            start = self._map.from_controller(np.array(report.positions))
            course = Course(start, path, self._map)
            if following.stopped:
                return motion  # while it waited for the report
            transfer = link.send(course)
            following.begin(course, transfer)
            transfer.on_end(lambda: self._on_transfer(following, transfer))
            if following.stopped:
                link.stop("it was stopped as it began")  # the one before may have come before the course
        except DeviceError as error:
            self._ended(following)
            following.fail(error)
            raise
        except BaseException:
            self._ended(following)
            motion.stop("it was interrupted before it had begun")
            with suppress(DeviceError):  # what interrupts is the error to tell
                link.stop("interrupted")
            raise
        return motion

    def stop(self, reason: str) -> StopResult:
        """Confirmed by a report newer than the stop that says that the arm stands; else it tells what is known."""
        link = self._opened("stop")
        with self._lock:
            following = self._following
            braking = 0.0 if following is None else following.stopping()
        deadline = self._clock.now() + braking + STOP_CONFIRMED_WITHIN
        try:
            sent = self._send_stop(link, reason, deadline)
            result = self._standing_after(link, sent, deadline)
        except DeviceError as error:
            result = StopResult(confirmed=False, detail=error.why)
        if following is not None:
            self._ended(following)
            following.motion.stop(reason if result.confirmed else f"{reason}; not confirmed: {result.detail}")
        return result

    def enable(self, timeout: float) -> None:
        self._opened("enable").enable(timeout)

    def disable(self, timeout: float) -> None:
        link = self._opened("disable")
        self._refuse_if_moving("disable")
        link.disable(timeout)

    def reset_fault(self, timeout: float) -> None:
        self._opened("reset a fault").reset_fault(timeout)

    def findings(self) -> list[Finding]:
        return self._opened("check").findings()

    # -- what comes from the link's threads ---------------------------------------------------------------------

    def _on_report(self, report: ArmReport) -> None:
        state = self._state(report)
        with self._lock:
            self._previous = report
            following = self._following
        if following is not None:
            self._follow(following, report, state)
        for function in tuple(self._states):
            try:
                function(state)
            except Exception as error:  # noqa: BLE001 - whatever a subscriber raises, the link's thread goes on
                if function in self._states:
                    self._states.remove(function)
                why, advice = f"the subscriber failed: {error!r}", "it gets no more states"
                self._tell(DeviceError(self.name, "hand over a state", why, advice))

    def _follow(self, following: Following, report: ArmReport, state: RobotState) -> None:
        error = _fault(self.name, report) if following.begun else None
        error = error or following.look(report, state)
        if error is not None:
            self._end_by(following, error)

    def _on_transfer(self, following: Following, transfer: Transfer) -> None:
        if transfer.error is not None and not following.stopped:
            self._end_by(following, transfer.error)

    def _on_failure(self, error: DeviceError) -> None:
        with self._lock:
            following = self._following
        if following is not None:
            self._end_by(following, error)
        self._tell(error)

    def _end_by(self, following: Following, error: DeviceError) -> None:
        """Stop the arm, first of all, and end its motion by the error."""
        following.stopping()
        link = self._link
        if link is not None:
            try:
                link.stop(error.why)
            except DeviceError as second:
                error.add_note(f"{self.name}: the stop could not be sent ({second.why}): use the emergency stop")
        self._ended(following)
        following.fail(error)

    def _tell(self, error: DeviceError) -> None:
        for function in tuple(self._failures):
            try:
                function(error)
            except Exception:
                logging.getLogger(__name__).exception("%s: one that was told of a failure failed", self.name)

    # -- states -------------------------------------------------------------------------------------------------

    def _state(self, report: ArmReport) -> RobotState:
        q = self._map.from_controller(np.array(report.positions))
        velocity = self._velocity(report)
        return RobotState(
            tuple(q.tolist()), tuple(velocity.tolist()), report.mode, report.faults, report.time, report.sequence
        )

    def _velocity(self, report: ArmReport) -> Array:
        """(n,) rad/s; from two reports where the controller tells none, zero where it says that the arm stands."""
        before = self._previous
        if report.in_motion is False:
            return np.zeros(self.joints)
        if report.velocities is not None:
            return self._map.velocity_from_controller(np.array(report.velocities))
        if before is None or before.time >= report.time:
            return np.zeros(self.joints)
        change = np.subtract(report.positions, before.positions) / (report.time - before.time)
        return self._map.velocity_from_controller(change)

    def _send_stop(self, link: ArmLink, reason: str, deadline: float) -> float:
        """When it was sent, s. A lost link may be there again in time, and the arm still on its way."""
        while True:
            sent = self._clock.now()
            try:
                link.stop(reason)
                return sent
            except LinkLost:
                if sent + _STOP_AGAIN_AFTER >= deadline:
                    raise
            self._clock.wait(threading.Event(), sent + _STOP_AGAIN_AFTER)

    def _standing_after(self, link: ArmLink, sent: float, deadline: float) -> StopResult:
        """Wait for a report after ``sent`` that says that the arm stands; DeviceTimeout where none comes at all."""
        standing, report = Standing(), link.report_after(sent, deadline)
        while report.in_motion is not False and standing.look(report) < STANDS_FOR:
            try:
                report = link.report_after(report.time, deadline)
            except DeviceTimeout:
                return StopResult(confirmed=False, detail="the controller still says that the arm moves")
        return StopResult(confirmed=True)

    def _refuse_unless_ready(self, report: ArmReport) -> None:
        if report.mode is not Mode.READY or report.faults:
            what = ", ".join([f"mode '{report.mode}'", *report.faults])
            raise CommandRefused(self.name, "move", f"the arm is not ready: {what}", "clear it at the controller")
        if report.in_motion:
            raise CommandRefused(self.name, "move", "the controller says that the arm moves", "wait until it stands")

    def _refuse_if_moving(self, attempted: str) -> None:
        if self._following is not None:
            raise CommandRefused(self.name, attempted, "it is moving", "wait for its motion or stop it")

    def _ended(self, following: Following) -> None:
        with self._lock:
            if self._following is following:
                self._following = None

    def _opened(self, attempted: str) -> ArmLink:
        link = self._link
        if link is None:
            raise NotOpen(self.name, attempted, "its backend is not open", "open it first")
        return link


def _fault(arm: str, report: ArmReport) -> DeviceError | None:
    """What ends a motion by this report: a fault, or a mode in which nothing moves."""
    if report.faults:
        return MotionFailed(arm, "move", ", ".join(report.faults), "clear it at the controller")
    if report.mode is not Mode.READY:
        return MotionFailed(arm, "move", f"mode '{report.mode}'", "see what the controller says")
    return None


def _added(functions: list[Any], function: Any) -> Callable[[], None]:
    """Have ``function`` in the list; what is returned takes it out again, any number of times."""
    functions.append(function)

    def remove() -> None:
        with suppress(ValueError):
            functions.remove(function)

    return remove
