"""What a robot arm is to everybody else: joint angles, and nothing of kinematics."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from dualcal_hal.clock import Clock
from dualcal_hal.errors import DeviceError, DeviceTimeout, DualcalError, MotionFailed, MotionStopped
from dualcal_hal.findings import Finding

Joints = tuple[float, ...]


class Mode(StrEnum):
    """Whether the device would carry out a motion; only ``READY`` does, ``UNKNOWN`` counts as no."""

    READY = "ready"
    DISABLED = "disabled"
    MANUAL = "manual"
    EMERGENCY_STOP = "emergency stop"
    FAULT = "fault"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class RobotState:
    """What the device reported at one moment.

    positions: joint angles in rad; velocities: rad/s; time: seconds of the clock at sampling;
    sequence: grows with every state of this device.
    """

    positions: Joints
    velocities: Joints
    mode: Mode
    faults: tuple[str, ...]
    time: float
    sequence: int


@dataclass(frozen=True, slots=True)
class JointPath:
    """Absolute waypoints in rad, straight in joint space between them, with a rest at each.

    speed (rad/s) and acceleration (rad/s^2) are upper bounds per joint; the joints of a segment move in
    proportion. The path starts where the arm stands.
    """

    waypoints: tuple[Joints, ...]
    speed: Joints
    acceleration: Joints


@dataclass(frozen=True, slots=True)
class StopResult:
    """What became of a stop: ``confirmed`` only if the device said that it stands still."""

    confirmed: bool
    detail: str = ""


class MotionState(StrEnum):
    RUNNING = "running"
    SETTLED = "settled"
    STOPPED = "stopped"
    FAILED = "failed"


class Motion:
    """A motion that a device accepted. The backend ends it once, by one of settle, stop, fail."""

    def __init__(self, device: str, clock: Clock) -> None:
        self._device = device
        self._clock = clock
        self._ended = threading.Event()
        self._lock = threading.Lock()
        self._state = MotionState.RUNNING
        self._final: RobotState | None = None
        self._error: DualcalError | None = None
        self._listeners: list[Callable[[], None]] = []

    @property
    def device(self) -> str:
        """The arm that moves."""
        return self._device

    @property
    def state(self) -> MotionState:
        return self._state

    @property
    def final(self) -> RobotState | None:
        """The state in which the arm settled, None as long as it has not."""
        return self._final

    @property
    def error(self) -> DualcalError | None:
        """Why the motion ended without having settled, None as long as it has not."""
        return self._error

    def on_end(self, listener: Callable[[], None]) -> None:
        """Call ``listener`` when the motion has ended, on the device's thread; at once if it has.

        Whoever waits for the motion goes on only once all listeners have been called: a listener must not wait for it.
        """
        with self._lock:
            if self._state is MotionState.RUNNING:
                self._listeners.append(listener)
                return
        listener()

    def wait(self, timeout: float) -> RobotState:
        """The state in which the arm settled at the last waypoint.

        Raises MotionStopped, MotionFailed, or DeviceTimeout after ``timeout`` seconds (the motion then
        goes on; the caller decides to stop it).
        """
        self._clock.wait(self._ended, self._clock.now() + timeout)
        return self.result(timeout)

    def result(self, timeout: float = 0.0) -> RobotState:
        """As :meth:`wait`, without waiting; ``timeout`` is only named in the error."""
        if self._error is not None:
            raise self._error
        if self._final is None:
            raise DeviceTimeout(
                self._device, "move", f"not arrived within {timeout:g} s", "check its speed and its path"
            )
        return self._final

    def settle(self, final: RobotState) -> None:
        """The arm stands at the last waypoint (called by the backend)."""
        self.end(MotionState.SETTLED, final, None)

    def stop(self, reason: str) -> None:
        """The arm was stopped on the way (called by the backend)."""
        self.end(MotionState.STOPPED, None, MotionStopped(self._device, "move", f"stopped: {reason}"))

    def fail(self, why: str, advice: str = "", kind: type[MotionFailed] = MotionFailed) -> None:
        """A fault ended the motion (called by the backend)."""
        self.end(MotionState.FAILED, None, kind(self._device, "move", why, advice))

    def end(self, state: MotionState, final: RobotState | None, error: DualcalError | None) -> None:
        """The motion has ended so; what comes after its first end changes nothing (called by the backend)."""
        with self._lock:
            if self._state is not MotionState.RUNNING:
                return
            self._state, self._final, self._error = state, final, error
            listeners, self._listeners = self._listeners, []
        try:
            for listener in listeners:
                listener()
        finally:
            self._ended.set()


class Robot(ABC):
    """One arm's joints as its device reports and moves them. Every call that can block takes a timeout in s."""

    name: str

    @property
    @abstractmethod
    def joints(self) -> int:
        """How many joints it has."""

    @property
    def keeps_speed(self) -> bool:
        """Whether it is no faster than a path says; if not it moves at a speed of its controller's own."""
        return True

    @property
    def confirmed_speed(self) -> float | None:
        """m/s that its controller was confirmed to be set to, if it does not keep a path's; None where nobody has."""
        return None

    @abstractmethod
    def read(self, timeout: float) -> RobotState:
        """A state sampled after the call; raises DeviceTimeout, LinkLost or NotOpen, never an old state."""

    @abstractmethod
    def subscribe(self, function: Callable[[RobotState], None]) -> Callable[[], None]:
        """Hand each state to ``function`` as it arrives, on the device's thread; returns what ends that."""

    def observe(self, function: Callable[[RobotState], None]) -> Callable[[], None]:
        """As :meth:`subscribe`, for those who look after the arm and ask it nothing: it is recorded as no call."""
        return self.subscribe(function)

    def on_failure(self, function: Callable[[DeviceError], None]) -> Callable[[], None]:
        """Tell ``function`` at once when the arm's link or drives fail, on the device's thread; returns what ends that.

        A device that has no failures of its own, as a simulated one, tells none.
        """
        return lambda: None

    @abstractmethod
    def start(self, path: JointPath) -> Motion:
        """Begin to follow ``path``; returns when the device has accepted it. Raises CommandRefused."""

    @abstractmethod
    def stop(self, reason: str) -> StopResult:
        """Stand still as fast as the device can: from any thread, at any time, again and again, bounded."""

    @abstractmethod
    def enable(self, timeout: float) -> None:
        """Switch the drives on: the operator's command, called by no procedure."""

    @abstractmethod
    def disable(self, timeout: float) -> None:
        """Switch the drives off: the operator's command, called by no procedure."""

    @abstractmethod
    def reset_fault(self, timeout: float) -> None:
        """Acknowledge a fault: the operator's command, called by no procedure."""

    def findings(self) -> list[Finding]:
        """What an operator is told of it by a check; only read, nothing is moved."""
        return []
