"""How well a cycle keeps its time."""

from __future__ import annotations

from array import array
from dataclasses import dataclass

import numpy as np

_KEPT = 1 << 17  # durations: twenty minutes at 100 Hz


@dataclass(frozen=True)
class CycleReport:
    """Counts of cycles; times in s; largest_step in shares of what the course's speed allows in one period."""

    cycles: int
    late: int
    longest_late_run: int
    longest_late_run_in_motion: int
    median: float
    p99: float
    largest_step: float
    jitter: float
    """p99 of how late a cycle begins."""


class CycleStatistics:
    """Written by the cycle alone; a report may be asked for from any thread."""

    def __init__(self) -> None:
        self.cycles = 0
        self.late = 0
        self.late_run = 0
        self.longest_late_run = 0
        self.longest_late_run_in_motion = 0
        self.largest_step = 0.0
        self._durations = array("d", bytes(8 * _KEPT))
        self._delays = array("d", bytes(8 * _KEPT))
        self._measured = 0

    def ended(self, duration: float | None, delay: float, late: int, moving: bool) -> None:
        """A cycle took ``duration`` s from its begin to its last answer, None where one is missing.

        It began ``delay`` s after it was due; ``late`` counts it and the cycles left out behind it, 0 if in time.
        """
        self.cycles += max(1, late)
        self.late += late
        self.late_run = self.late_run + late if late else 0
        self.longest_late_run = max(self.longest_late_run, self.late_run)
        if moving:
            self.longest_late_run_in_motion = max(self.longest_late_run_in_motion, self.late_run)
        if duration is not None:
            slot = self._measured % _KEPT
            self._durations[slot], self._delays[slot] = duration, delay
            self._measured += 1

    def report(self) -> CycleReport:
        count = min(self._measured, _KEPT)
        durations, delays = np.array(self._durations[:count]), np.array(self._delays[:count])
        median, p99 = np.quantile(durations, (0.5, 0.99)).tolist() if count else (np.nan, np.nan)
        return CycleReport(
            cycles=self.cycles,
            late=self.late,
            longest_late_run=self.longest_late_run,
            longest_late_run_in_motion=self.longest_late_run_in_motion,
            median=median,
            p99=p99,
            largest_step=self.largest_step,
            jitter=float(np.quantile(delays, 0.99)) if count else np.nan,
        )
