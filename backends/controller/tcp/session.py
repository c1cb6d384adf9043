"""One arm at a controller's ports: courses, stops and the operator's commands that it is sent."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress

from backends.controller.course import Course
from backends.controller.link import ArmLink, ArmReport, Transfer
from backends.controller.tcp import condition
from backends.controller.tcp.codec import Status
from backends.controller.tcp.controller import Controller
from backends.controller.tcp.dialects import (
    RESET_ALARM,
    START_COMMANDS,
    START_SERVOS,
    STOP_SERVOS,
    Motoman,
    TooManyPoints,
    Verdict,
)
from backends.controller.tcp.feedback import Feedback
from backends.controller.tcp.handover import HandOver
from backends.controller.tcp.port import named
from dualcal_hal.clock import Clock
from dualcal_hal.errors import (
    CommandRefused,
    DeviceError,
    DeviceTimeout,
    LinkLost,
    MotionStopped,
    NotOpen,
    UsageError,
)
from dualcal_hal.findings import Finding
from dualcal_hal.robot import Mode

_REPORT_WITHIN = 1.0  # s for a report that is newer than the connection
_STATUS_WITHIN = 0.5  # s after the first report; some servers send none
_EXPLAINED_WITHIN = 0.25  # s; the slowest servers send one each 0.2 s

_AT_THE_PENDANT = {
    "enable": "switch the drives on at the pendant, in automatic mode",
    "disable": "switch the drives off at the pendant",
    "reset a fault": "acknowledge it at the pendant",
}


class SimpleMessageArm(ArmLink):
    """``group``: the arm's number in messages that carry one."""

    def __init__(
        self, arm: str, joints: int, group: int, controller: Controller, feedback: Feedback, clock: Clock
    ) -> None:
        super().__init__(arm, joints)
        self._group = group
        self._controller = controller
        self._feedback = feedback
        self._dialect = controller.dialect
        self.begins_within = self._dialect.begins_within
        self._clock = clock
        self._lock = threading.Lock()
        self._handover: HandOver | None = None
        self._detach: list[Callable[[], None]] = []

    def open(self, deadline: float) -> None:
        if self._feedback.opened:
            raise UsageError(f"{self.arm}: open: it is open already; close it first")
        self._feedback.open()
        self._detach = [
            self._controller.state.add(self._feedback),
            self._controller.motion.on_failure(self._on_motion_failure),
            self._feedback.on_failure(self._on_failure),
        ]
        try:
            self._controller.open(self, deadline)
            self._feedback.report_after(-1.0, deadline)
            self._controller.open_motion(deadline)
            self._await_status(min(deadline, self._clock.now() + _STATUS_WITHIN))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        if not self._feedback.opened:
            return
        stopped = MotionStopped(self.arm, "move", "stopped: its link is closed")
        if self._moves():
            with suppress(DeviceError):  # it is closed all the same
                self._stop(stopped)
        if self._handover is not None:
            self._handover.halt(stopped)
            self._handover.join()
            self._handover = None
        while self._detach:
            self._detach.pop()()
        self._controller.close(self)
        self._feedback.close()

    def report_after(self, time: float, deadline: float) -> ArmReport:
        return self._feedback.report_after(time, deadline)

    def subscribe(self, function: Callable[[ArmReport], None]) -> Callable[[], None]:
        return self._feedback.subscribe(function)

    def on_failure(self, function: Callable[[DeviceError], None]) -> Callable[[], None]:
        return self._feedback.on_failure(function)

    def send(self, course: Course) -> Transfer:
        self._refuse_unless_ready("move")
        opening = self._dialect.opening(self._group)
        try:
            points = self._dialect.points(course, self._group)
        except TooManyPoints as error:
            raise CommandRefused(self.arm, "move", str(error), "go there in shorter moves") from error
        messages = (*opening, *points)
        needed = len(messages) if self._dialect.downloads else len(opening) + 1
        with self._lock:
            if self._handover is not None and self._handover.running:
                raise CommandRefused(self.arm, "move", "another course is handed over", "stop it first")
            self._handover = handover = HandOver(
                self.arm,
                self._group,
                messages,
                needed,
                self._controller.motion,
                self._dialect,
                self._clock,
                self._feedback.moves_until,
                self._explain,
            )
        self._feedback.moves_until(self._clock.now())
        handover.begin()
        return handover.transfer

    def stop(self, reason: str) -> None:
        if not self._feedback.opened:
            raise NotOpen(self.arm, "stop", "its link is not open", "open it first")
        self._stop(MotionStopped(self.arm, "move", f"stopped: {reason}"))

    def stopped_along(self, error: DeviceError) -> None:
        """The controller stopped, whose arms stop all at once."""
        if self._moves():
            stopped = named(error, self.arm)
            if self._handover is not None:
                self._handover.halt(stopped)
            self._feedback.tell(stopped)

    def enable(self, timeout: float) -> None:
        motoman, deadline = self._switching("enable"), self._clock.now() + timeout
        if self._feedback.mode in (Mode.FAULT, Mode.EMERGENCY_STOP):
            why, advice = condition.why_not(self._feedback.status, self._feedback.mode)
            raise CommandRefused(self.arm, "enable", why, f"{advice}, or reset it first")
        self._command(motoman, START_SERVOS, "enable", deadline)
        self._command(motoman, START_COMMANDS, "enable", deadline)
        self._await("enable", condition.is_enabled, deadline)

    def disable(self, timeout: float) -> None:
        motoman, deadline = self._switching("disable"), self._clock.now() + timeout
        self._command(motoman, STOP_SERVOS, "disable", deadline)
        self._await("disable", lambda status: condition.known(status.drives_powered) is False, deadline)

    def reset_fault(self, timeout: float) -> None:
        motoman, deadline = self._switching("reset a fault"), self._clock.now() + timeout
        self._command(motoman, RESET_ALARM, "reset a fault", deadline)
        self._await("reset a fault", lambda status: not condition.known(status.in_error), deadline)

    def findings(self) -> list[Finding]:
        state, motion = self._controller.state, self._controller.motion
        found = []
        for what, port in (("state port", state), ("motion port", motion)):
            if port.connected_at is not None:
                found.append(Finding(what, f"{port.address} is connected"))
            else:
                advice = "check cable, address and the server program"
                found.append(Finding(what, f"{port.address} is not connected", "problem", advice))
        wire = state.wire
        found.append(Finding("byte order", str(wire)) if wire else Finding("byte order", "not known", "problem"))
        return [*found, *self._feedback.findings()]

    # -- stops and failures -------------------------------------------------------------------------------------

    def _stop(self, error: MotionStopped) -> None:
        if self._handover is not None:
            self._handover.halt(error)
        self._feedback.moves_until(self._clock.now())
        try:
            self._controller.motion.stop(self.arm, self._dialect.stop(self._group))
        except DeviceError as lost:
            raise named(lost, self.arm) from lost
        finally:
            self._feedback.moves_until(self._clock.now())
        self._controller.stopped(self, error)

    def _on_failure(self, error: DeviceError) -> None:
        """Nothing more is sent to an arm that has failed; whoever watches it has it stopped."""
        handover = self._handover
        if handover is not None and handover.running and not isinstance(error, DeviceTimeout):
            handover.halt(error)

    def _on_motion_failure(self, error: DeviceError) -> None:
        self._feedback.tell(error)

    def _moves(self) -> bool:
        """Whether it may be on a course."""
        return self._handover is not None and (self._handover.running or self._feedback.may_move())

    def _explain(self, refused: DeviceError) -> None:
        """Servers refuse without a reason; the next STATUS has it."""
        if not isinstance(refused, CommandRefused):
            return
        deadline = self._clock.now() + _EXPLAINED_WITHIN
        with suppress(DeviceError):
            while self._feedback.mode is Mode.READY:
                self._feedback.report_after(self._clock.now(), deadline)
            why, _ = condition.why_not(self._feedback.status, self._feedback.mode)
            refused.add_note(f"{self.arm}: {why}")

    # -- what has to be so before -------------------------------------------------------------------------------

    def _refuse_unless_ready(self, attempted: str) -> None:
        """A report that is newer than the motion port's connection has to say that the arm would move."""
        connected_at = self._controller.motion.connected_at
        if self._feedback.opened and connected_at is None:
            raise LinkLost(
                self.arm, attempted, f"{self._controller.motion.address} is not connected", "wait until it is again"
            )
        self._feedback.report_after(connected_at or 0.0, self._clock.now() + _REPORT_WITHIN)
        if self._feedback.is_late():
            raise DeviceTimeout(self.arm, attempted, "feedback is late", "check the network")
        mode = self._feedback.mode
        if mode is not Mode.READY:
            why, advice = condition.why_not(self._feedback.status, mode)
            raise CommandRefused(self.arm, attempted, why, advice)

    def _await_status(self, deadline: float) -> None:
        with suppress(DeviceTimeout):
            while self._feedback.status is None:
                self._feedback.report_after(self._clock.now(), deadline)

    # -- the operator's commands --------------------------------------------------------------------------------

    def _switching(self, attempted: str) -> Motoman:
        if not self._feedback.opened:
            raise NotOpen(self.arm, attempted, "its link is not open", "open it first")
        if not isinstance(self._dialect, Motoman):
            why = "its server has no message for it"
            raise CommandRefused(self.arm, attempted, why, _AT_THE_PENDANT[attempted])
        if self._handover is not None and self._handover.running:
            raise CommandRefused(self.arm, attempted, "a course is handed over", "stop it first")
        return self._dialect

    def _command(self, motoman: Motoman, command: int, attempted: str, deadline: float) -> None:
        motion, message = self._controller.motion, motoman.command(command, self._group)
        within = deadline - self._clock.now()
        reply = motion.reply(motion.request(self.arm, message, motion.packet(self.arm, message), within))
        judged = motoman.judge(reply)
        if judged.verdict is not Verdict.TAKEN:
            why = judged.why or "the controller is busy"
            raise CommandRefused(self.arm, attempted, why, "see the controller's messages")

    def _await(self, attempted: str, done: Callable[[Status], bool], deadline: float) -> None:
        """Wait for a STATUS that says so."""
        try:
            while (status := self._feedback.status) is None or not done(status):
                self._feedback.report_after(self._clock.now(), deadline)
        except DeviceTimeout as error:
            why = "the controller took the command, and its STATUS does not show it"
            raise DeviceTimeout(self.arm, attempted, why, "see the controller's messages") from error
