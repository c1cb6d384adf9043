"""What the wires of one arm are to the arm: reports that come in, courses and stops that go out.

All angles here are the controller's own joints, in rad; times are seconds of the clock.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

from backends.controller.course import Course
from dualcal_hal.errors import DeviceError
from dualcal_hal.findings import Finding
from dualcal_hal.robot import Joints, Mode


@dataclass(frozen=True, slots=True)
class ArmReport:
    """What the controller said of an arm, stamped on arrival.

    positions, velocities: rad, rad/s, one entry a joint; velocities None where the controller tells none.
    in_motion: None where it does not say. mode: READY only if a motion would be carried out.
    faults: in words, each with joint or node and code. sequence: grows with every report of this arm.
    """

    positions: Joints
    velocities: Joints | None
    mode: Mode
    faults: tuple[str, ...]
    in_motion: bool | None
    time: float
    sequence: int


class Transfer:
    """How far a controller has taken a course. The link ends it once, by one of complete and fail."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._ended = False
        self._listeners: list[Callable[[], None]] = []
        self.error: DeviceError | None = None
        """Why not all of it was taken."""

    @property
    def complete(self) -> bool:
        """Whether all of the course was taken: acknowledged by the controller, or told to the drives."""
        return self._ended and self.error is None

    def completed(self) -> None:
        """All was taken (called by the link)."""
        self._end(None)

    def failed(self, error: DeviceError) -> None:
        """The rest is not taken: a refusal, a lost link, a fault (called by the link)."""
        self._end(error)

    def on_end(self, listener: Callable[[], None]) -> None:
        """Call ``listener`` once it has ended, on the link's thread; at once if it has."""
        with self._lock:
            if not self._ended:
                self._listeners.append(listener)
                return
        listener()

    def _end(self, error: DeviceError | None) -> None:
        with self._lock:
            if self._ended:
                return
            self._ended, self.error = True, error
            listeners, self._listeners = self._listeners, []
        for listener in listeners:
            listener()


class ArmLink(ABC):
    """One arm's wires. Threads are its own; every call may come from any thread.

    It reconnects by itself after a loss, with back-off, and then reports again; it never goes on with a course, enables
    drives or acknowledges a fault by itself.
    """

    begins_within: float = 0.0
    """Seconds within which the controller begins to move once it has taken a course: before, an arm that stands near
    its goal may not have begun."""

    def __init__(self, arm: str, joints: int) -> None:
        self.arm = arm
        self.joints = joints

    @abstractmethod
    def open(self, deadline: float) -> None:
        """Connect and have a first report; DeviceTimeout, LinkLost or a DeviceError that says what is wrong in words.

        Leaves nothing open if it raises. Moves nothing, enables nothing.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop a course that is under way, and release all; any number of times. Its threads have ended on return."""

    @abstractmethod
    def report_after(self, time: float, deadline: float) -> ArmReport:
        """A report that arrived after ``time``; waits for it. DeviceTimeout, LinkLost, NotOpen."""

    @abstractmethod
    def subscribe(self, function: Callable[[ArmReport], None]) -> Callable[[], None]:
        """Hand each report to ``function`` as it arrives, on the link's thread; returns what ends that."""

    @abstractmethod
    def on_failure(self, function: Callable[[DeviceError], None]) -> Callable[[], None]:
        """Tell ``function`` of each failure at once, on the link's thread; returns what ends that.

        Feedback that is late (DeviceTimeout: older than three periods, at least 0.1 s), a lost link (LinkLost: older
        than 1 s, or closed), a fault of the controller or of a drive (DeviceError with joint or node and code).
        """

    @abstractmethod
    def send(self, course: Course) -> Transfer:
        """Begin to hand a course over; returns when the controller has accepted what it must before the arm moves.

        A course that it cannot take (too many points) is refused before anything is sent. CommandRefused,
        DeviceTimeout, LinkLost.
        """

    @abstractmethod
    def stop(self, reason: str) -> None:
        """Put a stop on the wire at once, also where nothing moves; any thread, bounded by 0.3 s.

        A transfer under way fails with MotionStopped of that reason. DeviceError where it cannot be sent.
        """

    @abstractmethod
    def enable(self, timeout: float) -> None:
        """Switch the drives on. CommandRefused where the controller offers no way to, with what to do instead."""

    @abstractmethod
    def disable(self, timeout: float) -> None:
        """Switch the drives off, as :meth:`enable`."""

    @abstractmethod
    def reset_fault(self, timeout: float) -> None:
        """Acknowledge a fault, as :meth:`enable`; the drives stay off."""

    @abstractmethod
    def findings(self) -> list[Finding]:
        """What an operator is told of this link by ``dualcal doctor``: only read, nothing is moved."""
