"""Whose clock a time is of: times of two processes can be compared if both are of one boot of one machine."""

from __future__ import annotations

import os
import socket
from dataclasses import dataclass
from functools import cache
from pathlib import Path

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_TIME_NAMESPACE = "/proc/self/ns/time"


@dataclass(frozen=True)
class ClockId:
    """The monotonic clock of one boot of one machine.

    host: the machine's name; boot: what no other boot has, of this machine or another; "" where that is not known.
    """

    host: str
    boot: str

    def is_comparable_with(self, other: ClockId) -> bool:
        """Whether both are one clock; what does not know its boot is nobody's."""
        return self == other and self.boot != ""


@cache
def own_clock() -> ClockId:
    """Of dualcal_hal.clock.RealClock in this process."""
    return ClockId(socket.gethostname(), _boot())


def _boot() -> str:
    """A container may have a monotonic clock of its own: its time namespace belongs to what is compared."""
    try:
        return f"{_BOOT_ID.read_text().strip()} {os.readlink(_TIME_NAMESPACE)}"
    except OSError:
        return ""
