"""Time: the one place that knows it. Everything that waits, waits here."""

from __future__ import annotations

import heapq
import itertools
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from datetime import UTC, datetime


class Handle:
    """A call that was asked for and can be taken back."""

    def __init__(self) -> None:
        self.cancelled = False

    def cancel(self) -> None:
        self.cancelled = True


class Clock(ABC):
    """Seconds since an arbitrary start, waiting, and calls at a time."""

    @abstractmethod
    def now(self) -> float:
        """Seconds, never going back."""

    @abstractmethod
    def wait(self, event: threading.Event, deadline: float | None) -> bool:
        """Wait until ``event`` is set or ``now() >= deadline``; says whether the event is set."""

    @abstractmethod
    def call_at(self, when: float, function: Callable[[], None]) -> Handle:
        """Call ``function`` once at or soon after ``when``; at once if that has passed."""


class RealClock(Clock):
    """The machine's monotonic time. Calls run on threads of their own, as daemons."""

    def now(self) -> float:
        return time.monotonic()

    def wait(self, event: threading.Event, deadline: float | None) -> bool:
        return event.wait(None if deadline is None else max(0.0, deadline - self.now()))

    def call_at(self, when: float, function: Callable[[], None]) -> Handle:
        timer = threading.Timer(max(0.0, when - self.now()), function)
        timer.daemon = True
        timer.start()
        return _TimerHandle(timer)


class _TimerHandle(Handle):
    def __init__(self, timer: threading.Timer) -> None:
        super().__init__()
        self._timer = timer

    def cancel(self) -> None:
        super().cancel()
        self._timer.cancel()


class VirtualClock(Clock):
    """Time that is made by waiting: a wait runs the calls that are due and jumps to its end.

    Calls run in the thread that waits, in the order of their times, and of their asking at one time;
    so everything that happens in virtual time is deterministic.
    """

    def __init__(self, start: float = 0.0) -> None:
        self._now = start
        self._calls: list[tuple[float, int, Handle, Callable[[], None]]] = []
        self._order = itertools.count()
        self._lock = threading.Lock()

    def now(self) -> float:
        return self._now

    def wait(self, event: threading.Event, deadline: float | None) -> bool:
        while not event.is_set():
            call = self._next_call(deadline)
            if call is None:
                break
            call()
        if deadline is None:
            # Nothing left in virtual time can set it; another thread still may.
            return event.wait()
        return event.is_set()

    def _next_call(self, deadline: float | None) -> Callable[[], None] | None:
        with self._lock:
            while self._calls and (deadline is None or self._calls[0][0] <= deadline):
                when, _, handle, function = heapq.heappop(self._calls)
                if not handle.cancelled:
                    self._now = max(self._now, when)
                    return function
            if deadline is not None:
                self._now = max(self._now, deadline)
            return None

    def call_at(self, when: float, function: Callable[[], None]) -> Handle:
        handle = Handle()
        with self._lock:
            heapq.heappush(self._calls, (max(when, self._now), next(self._order), handle, function))
        return handle


def utc_now() -> datetime:
    """The date, for names and records; never for measuring time."""
    return datetime.now(UTC)
