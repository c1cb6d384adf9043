"""What a controller tells of one arm: reports made of its joint messages and the newest STATUS, and failures."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import suppress

from backends.controller.link import ArmReport
from backends.controller.tcp import condition
from backends.controller.tcp.codec import JointFeedback, JointPosition, Message, Status, Valid
from backends.controller.tcp.port import named
from backends.controller.tcp.state import LATE_PERIODS, LOST_AFTER, Freshness
from backends.controller.tcp.transport import Address, Rhythm
from dualcal_hal.clock import Clock
from dualcal_hal.errors import DeviceError, DeviceTimeout, NotOpen
from dualcal_hal.findings import Finding
from dualcal_hal.robot import Mode

_OBSERVED = 1.0  # s


class Feedback:
    """Listens to a state port for one arm.

    group: whose joint messages are the arm's; None for a port that is the arm's alone. unknown_is_ready: as in the
    cell file.
    """

    def __init__(
        self, arm: str, joints: int, group: int | None, port: Address, unknown_is_ready: bool, clock: Clock
    ) -> None:
        self.status: Status | None = None
        self._arm, self._joints, self._group = arm, joints, group
        self._port = port
        self._unknown_is_ready = unknown_is_ready
        self._tells_status = False
        self._clock = clock
        self._lock = threading.Lock()
        self._open = False
        self._lost: DeviceError | None = None
        self._freshness = Freshness(arm, port, clock.now())
        self._status_at = 0.0
        self._status_rhythm = Rhythm()
        self._sends_as: int | None = None
        self._report: ArmReport | None = None
        self._sequence = 0
        self._moves_until = -1.0
        self._waiting: list[threading.Event] = []
        self._subscribers: tuple[Callable[[ArmReport], None], ...] = ()
        self._watchers: tuple[Callable[[DeviceError], None], ...] = ()

    # -- asked by the arm's link --------------------------------------------------------------------------------

    def open(self) -> None:
        """Nothing is known yet."""
        with self._lock:
            self._open, self._lost, self._report, self.status = True, None, None, None
            self._tells_status = False
        self.connected(self._clock.now())

    def close(self) -> None:
        """Whoever waits for a report gets NotOpen."""
        with self._lock:
            self._open = False
            self._subscribers, self._watchers = (), ()
            self._wake()

    @property
    def opened(self) -> bool:
        return self._open

    @property
    def mode(self) -> Mode:
        """By the newest STATUS, if it is not too old to say."""
        return self._mode(self._current_status(self._clock.now()))

    def report_after(self, time: float, deadline: float) -> ArmReport:
        """A report that arrived after ``time``, as soon as there is one; DeviceTimeout, NotOpen, or how it was lost."""
        arrived = threading.Event()
        with self._lock:
            self._waiting.append(arrived)
        try:
            while True:
                with self._lock:
                    arrived.clear()
                    if not self._open:
                        raise NotOpen(self._arm, "read", "its link is not open", "open it first")
                    if self._lost is not None:
                        raise type(self._lost)(self._arm, "read", self._lost.why, self._lost.advice)
                    if self._report is not None and self._report.time > time:
                        return self._report
                if not self._clock.wait(arrived, deadline):
                    why = f"{self._port} told no joint angles in time"
                    raise DeviceTimeout(self._arm, "read", why, "check that the server's state program runs")
        finally:
            with self._lock:
                self._waiting.remove(arrived)

    def moves_until(self, time: float) -> None:
        """The arm is taken to move until a STATUS that came after ``time`` says that it does not."""
        self._moves_until = time

    def may_move(self) -> bool:
        """Whether the arm may move: unless a STATUS that is new enough has said that it does not."""
        report = self._report
        return report is None or report.in_motion is not False or report.time <= self._moves_until

    def is_late(self) -> bool:
        """Whether the newest report is too old to begin a motion by."""
        report = self._report
        return report is None or self._clock.now() - report.time > self._freshness.limit

    def subscribe(self, function: Callable[[ArmReport], None]) -> Callable[[], None]:
        with self._lock:
            self._subscribers = (*self._subscribers, function)
        return lambda: self._unsubscribe(function)

    def on_failure(self, function: Callable[[DeviceError], None]) -> Callable[[], None]:
        with self._lock:
            self._watchers = (*self._watchers, function)

        def remove() -> None:
            with self._lock:
                self._watchers = tuple(other for other in self._watchers if other is not function)

        return remove

    def tell(self, error: DeviceError) -> None:
        """Tell all that watch of a failure, whatever becomes of one of them."""
        for function in self._watchers:
            try:
                function(named(error, self._arm))
            except Exception:
                logging.getLogger(__name__).exception("%s: one that was told of a failure failed", self._arm)

    def findings(self) -> list[Finding]:
        """Its rate and condition, in an operator's words, after reports of a second."""
        until = self._clock.now() + _OBSERVED
        with suppress(DeviceError):  # what there is is told
            while self.report_after(self._clock.now(), until).time < until:
                pass
        rhythm = self._freshness.rhythm
        period, jitter = rhythm.period, rhythm.jitter
        if period is None or jitter is None:
            rate = Finding("state rate", "not known yet", "note")
        else:
            rate = Finding("state rate", f"{1 / period:.1f} Hz, jitter {1000 * jitter:.1f} ms")
        return [rate, *condition.findings(self._current_status(self._clock.now()), self.mode)]

    # -- told by the port's thread ------------------------------------------------------------------------------

    def connected(self, now: float) -> None:
        """What was told before says nothing of now."""
        with self._lock:
            self._freshness = Freshness(self._arm, self._port, now)
            self._status_rhythm = Rhythm()
            self._sends_as = None
            if self._lost is not None:
                self.status = None

    def message(self, message: Message, time: float) -> None:
        match message:
            case Status():
                self._on_status(message, time)
            case JointPosition() if self._group is None:
                self._on_joints(message.positions, None, time)
            case JointFeedback() if message.valid & Valid.POSITION and self._is_mine(message.group):
                velocities = message.velocities if message.valid & Valid.VELOCITY else None
                self._on_joints(message.positions, velocities, time)

    def look(self, now: float) -> float:
        error = self._freshness.look(now)
        if error is not None:
            self.tell(error)
        return self._freshness.due()

    def lost(self, error: DeviceError) -> None:
        with self._lock:
            told, self._lost = self._lost is not None, named(error, self._arm)
            self._wake()
        if not told:
            self.tell(error)

    def _is_mine(self, group: int) -> bool:
        if self._group is not None:
            return group == self._group
        # A port of one arm: whatever number it gives itself.
        if self._sends_as is None:
            self._sends_as = group
        return group == self._sends_as

    def _on_status(self, status: Status, time: float) -> None:
        before, was = self.status, self.mode
        with self._lock:
            self.status, self._status_at, self._tells_status = status, time, True
            self._status_rhythm.beat(time)
        mode = self._mode(status)
        changed = mode is not was or condition.faults(status) != condition.faults(before)
        if before is not None and mode is not Mode.READY and changed:
            why, advice = condition.why_not(status, mode)
            self.tell(DeviceError(self._arm, "watch", why, advice))

    def _on_joints(self, positions: tuple[float, ...], velocities: tuple[float, ...] | None, time: float) -> None:
        self._freshness.arrived(time)
        status = self._current_status(time)
        with self._lock:
            self._lost = None
            self._sequence += 1
            self._report = report = ArmReport(
                positions=positions[: self._joints],
                velocities=None if velocities is None else velocities[: self._joints],
                mode=self._mode(status),
                faults=condition.faults(status),
                in_motion=self._in_motion(status),
                time=time,
                sequence=self._sequence,
            )
            self._wake()
        for function in self._subscribers:
            try:
                function(report)
            except Exception as error:  # noqa: BLE001 - whatever a subscriber raises, the port's thread goes on
                self._unsubscribe(function)
                why = f"the subscriber failed: {error!r}"
                self.tell(DeviceError(self._arm, "hand over a report", why, "it gets no more reports"))

    def _mode(self, status: Status | None) -> Mode:
        """What has told how it is, and tells it no more, is not one that cannot."""
        return condition.mode(status, self._unknown_is_ready and not (status is None and self._tells_status))

    def _in_motion(self, status: Status | None) -> bool | None:
        said = None if status is None else condition.known(status.in_motion)
        return True if said is False and self._status_at <= self._moves_until else said

    def _current_status(self, now: float) -> Status | None:
        """The newest, None once it is too old to say how the arm is."""
        period = self._status_rhythm.period or 0.0
        return self.status if now - self._status_at <= max(LOST_AFTER, LATE_PERIODS * period) else None

    def _unsubscribe(self, function: Callable[[ArmReport], None]) -> None:
        with self._lock:
            self._subscribers = tuple(other for other in self._subscribers if other is not function)

    def _wake(self) -> None:
        for arrived in self._waiting:
            arrived.set()
