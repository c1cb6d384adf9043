"""A port of a controller that is kept connected: one thread that reads, and connects anew when the link breaks."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from typing import NoReturn

from backends.controller.promptness import prompt_interpreter, prompt_thread
from backends.controller.tcp.transport import Address, Connection
from dualcal_hal.clock import Clock
from dualcal_hal.errors import DeviceError, LinkLost

FIRST_BACK_OFF, LONGEST_BACK_OFF = 0.25, 5.0
"""Seconds before the next attempt to reconnect; each time doubled."""
_CONNECT_WITHIN = 2.0  # s of one attempt


class Port(ABC):
    """``arm`` is whose name errors bear. ``connected_at``: since when it is connected, None while it is not."""

    def __init__(self, arm: str, address: Address, clock: Clock) -> None:
        self.address = address
        self.connected_at: float | None = None
        self._arm = arm
        self._clock = clock
        self._lock = threading.RLock()
        self._closing = threading.Event()
        self._connection: Connection | None = None
        self._thread: threading.Thread | None = None

    def open(self, deadline: float) -> None:
        """Connect and begin to read; LinkLost if it cannot be reached, and then it is not open."""
        with self._lock:
            self._closing.clear()
            self._connection = connection = Connection(self._arm, self.address, self._clock)
        try:
            connection.connect(deadline)
        except LinkLost:
            self.close()
            raise
        self._prepare()
        self.connected_at = self._clock.now()
        name = f"{type(self).__name__} {self.address}"
        self._thread = threading.Thread(target=self._run, args=(connection,), name=name, daemon=True)
        self._thread.start()

    @property
    def opened(self) -> bool:
        """Whether it is kept connected."""
        return self._connection is not None

    def close(self) -> None:
        """Release it; its thread has ended on return. Any number of times."""
        with self._lock:
            self._closing.set()
            connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()
        self.connected_at = None
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
            self._thread = None

    @abstractmethod
    def _serve(self, connection: Connection) -> NoReturn:
        """Read from it until it breaks, which is raised as a DeviceError."""

    @abstractmethod
    def _lost(self, error: DeviceError) -> None:
        """The connection broke; ``error`` says how. It is closed already."""

    @abstractmethod
    def _prepare(self) -> None:
        """A connection was made, of which nobody knows yet."""

    def _may_connect(self) -> bool:
        """Whether it is time to connect anew."""
        return True

    def _run(self, connection: Connection | None) -> None:
        back_off = FIRST_BACK_OFF
        while connection is not None:
            error = self._end_of(connection)
            self.connected_at = None
            connection.close()
            if self._closing.is_set():
                return
            self._lost(error)
            if connection.statistics.messages_in:
                back_off = FIRST_BACK_OFF
            connection, back_off = self._reconnect(back_off)

    def _end_of(self, connection: Connection) -> DeviceError:
        """Serve a connection; why that ended."""
        try:
            with prompt_interpreter(), prompt_thread():
                self._serve(connection)
        except DeviceError as error:
            return error
        except Exception as error:  # noqa: BLE001 - a thread that died silently would leave its arm unwatched
            failed = LinkLost(self._arm, "read", f"this program failed: {error!r}", "report it")
            failed.__cause__ = error
            return failed

    def _reconnect(self, back_off: float) -> tuple[Connection | None, float]:
        """A new connection, None once it is closed; and how long to wait when that breaks."""
        while not self._clock.wait(self._closing, self._clock.now() + back_off):
            if not self._may_connect():
                continue
            back_off = min(2 * back_off, LONGEST_BACK_OFF)
            with self._lock:
                if self._closing.is_set():
                    break
                self._connection = connection = Connection(self._arm, self.address, self._clock)
            try:
                connection.connect(self._clock.now() + _CONNECT_WITHIN)
            except LinkLost:
                continue
            self._prepare()
            self.connected_at = self._clock.now()
            return connection, back_off
        return None, back_off


def named(error: DeviceError, arm: str) -> DeviceError:
    """The same error, of one arm of those that share a port."""
    return error if error.device == arm else type(error)(arm, error.attempted, error.why, error.advice)
