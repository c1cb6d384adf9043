"""The two ports of one controller, and the arms that share them."""

from __future__ import annotations

import threading
from typing import Protocol

from backends.controller.tcp.dialects import Dialect
from backends.controller.tcp.motion import MotionPort
from backends.controller.tcp.state import StatePort
from dualcal_hal.errors import DeviceError


class Sharer(Protocol):
    """An arm that uses a controller's ports."""

    def stopped_along(self, error: DeviceError) -> None:
        """All of the controller's arms were told to stop."""


class Controller:
    """Its ports are open as long as one of its arms is."""

    def __init__(self, state: StatePort, motion: MotionPort, dialect: Dialect) -> None:
        self.state = state
        self.motion = motion
        self.dialect = dialect
        self._lock = threading.Lock()
        self._sharers: tuple[Sharer, ...] = ()

    def open(self, sharer: Sharer, deadline: float) -> None:
        """Have the state port open for this arm, too; LinkLost."""
        with self._lock:
            if not self._sharers:
                self.state.open(deadline)
            self._sharers = (*self._sharers, sharer)

    def open_motion(self, deadline: float) -> None:
        """Have the motion port open, once it is known how the server writes; LinkLost."""
        with self._lock:
            if not self.motion.opened:
                self.motion.open(deadline)

    def close(self, sharer: Sharer) -> None:
        """This arm needs it no more."""
        with self._lock:
            self._sharers = tuple(other for other in self._sharers if other is not sharer)
            if not self._sharers:
                self.motion.close()
                self.state.close()

    def stopped(self, sharer: Sharer, error: DeviceError) -> None:
        """One arm was stopped, and the others with it."""
        for other in self._sharers:
            if other is not sharer:
                other.stopped_along(error)
