"""What a driver of a camera is, once it is open."""

from __future__ import annotations

from abc import ABC, abstractmethod

from dualcal_hal.camera import Frame
from dualcal_hal.findings import Finding


class Driver(ABC):
    """Frames of one open camera, asked for by one thread at a time."""

    @abstractmethod
    def take(self, not_before: float, deadline: float) -> Frame:
        """A frame, read-only, whose exposure provably began at or after ``not_before``; its time is the proven moment.

        Raises DeviceTimeout at the ``deadline`` (both are seconds of the clock), FrameRefused, LinkLost, and NotOpen if
        it is closed meanwhile.
        """

    @abstractmethod
    def findings(self) -> list[Finding]:
        """What it knows of itself: how the moment is proven, exposure, losses."""

    @abstractmethod
    def close(self) -> None:
        """Release everything; called once, also while another thread waits in :meth:`take`."""
