"""What is told of an arm, on a thread of its own: no listener, however slow, holds up the cycle."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import TypeVar

from backends.controller.link import ArmReport
from dualcal_hal.errors import DeviceError

_F = TypeVar("_F")
_REPORTS = 64  # that wait for a slow listener; older ones are left out


class Notices:
    """Hands reports, failures and ends of transfers to those who asked for them; failures before reports."""

    def __init__(self, device: str) -> None:
        self._device = device
        self._changed = threading.Condition()
        self._urgent: deque[Callable[[], None]] = deque()
        self._reports: deque[ArmReport] = deque(maxlen=_REPORTS)
        self._on_report: list[Callable[[ArmReport], None]] = []
        self._on_failure: list[Callable[[DeviceError], None]] = []
        self._ending = False
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        self._ending = False
        self._thread = threading.Thread(target=self._tell, name=f"{self._device} CAN notices", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """After what is due was told; any number of times."""
        with self._changed:
            self._ending = True
            self._changed.notify()
        thread, self._thread = self._thread, None
        if thread is not None and thread is not threading.current_thread():
            thread.join()

    def subscribe(self, function: Callable[[ArmReport], None]) -> Callable[[], None]:
        return _added(self._on_report, function)

    def on_failure(self, function: Callable[[DeviceError], None]) -> Callable[[], None]:
        return _added(self._on_failure, function)

    def report(self, report: ArmReport) -> None:
        if not self._on_report:
            return  # a thread that is not woken takes no interpreter from the cycle
        with self._changed:
            self._reports.append(report)
            self._changed.notify()

    def failure(self, error: DeviceError) -> None:
        for listener in tuple(self._on_failure):
            self.call(partial(listener, error))

    def call(self, function: Callable[[], None]) -> None:
        """Call ``function`` before any report that waits."""
        with self._changed:
            self._urgent.append(function)
            self._changed.notify()

    def _tell(self) -> None:
        while True:
            with self._changed:
                while not (self._urgent or self._reports or self._ending):
                    self._changed.wait()
                if self._urgent:
                    calls = [self._urgent.popleft()]
                elif self._ending:
                    return
                else:
                    report = self._reports.popleft()
                    calls = [partial(listener, report) for listener in self._on_report]
            for call in calls:
                self._guarded(call)

    def _guarded(self, call: Callable[[], None]) -> None:
        try:
            call()
        except Exception as error:  # noqa: BLE001 - one listener's failure must not take this thread from the others
            threading.excepthook(
                threading.ExceptHookArgs((type(error), error, error.__traceback__, threading.current_thread()))
            )


def _added(listeners: list[_F], function: _F) -> Callable[[], None]:
    listeners.append(function)

    def end() -> None:
        if function in listeners:
            listeners.remove(function)

    return end
