"""``distances.json``: how far the arms stayed from each other over a run, where something measured it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dualcal_hal.errors import FormatError, Problem
from dualcal_hal.session.folder import Session

DISTANCES = "distances.json"
DISTANCES_FORMAT = "dualcal.distances/1"


@dataclass(frozen=True)
class Distances:
    """Times in s, least distances between the arms in m, and between which parts that was.

    measured: from when to when (s) they were watched, in as many parts as the run had. A part begins where the last
    finished step before it ended, which may be earlier than where the part before ended. None where that is not told.
    """

    times: Sequence[float]
    distances: Sequence[float]
    between: Sequence[tuple[str, str]]
    measured: Sequence[tuple[float, float]] | None = None

    def to_document(self) -> dict[str, Any]:
        """As in the file: pairs of parts by their index in ``pairs``."""
        pairs = sorted(set(self.between))
        return {
            "format": DISTANCES_FORMAT,
            "time_s": list(self.times),
            "distance_mm": [1e3 * distance for distance in self.distances],
            "pair": [pairs.index(pair) for pair in self.between],
            "pairs": [list(pair) for pair in pairs],
            **({} if self.measured is None else {"measured_s": [list(part) for part in self.measured]}),
        }

    @staticmethod
    def from_document(document: Mapping[str, Any]) -> Distances:
        """From what :meth:`to_document` gives."""
        pairs = [(first, second) for first, second in document["pairs"]]
        distances = [distance / 1e3 for distance in document["distance_mm"]]
        measured = document.get("measured_s")
        parts = None if measured is None else [(begin, end) for begin, end in measured]
        return Distances(document["time_s"], distances, [pairs[index] for index in document["pair"]], parts)

    def after(self, earlier: Distances) -> Distances:
        """Those of a run that went on: nothing that was measured before is lost."""
        measured = None if self.measured is None or earlier.measured is None else [*earlier.measured, *self.measured]
        return Distances(
            [*earlier.times, *self.times],
            [*earlier.distances, *self.distances],
            [*earlier.between, *self.between],
            measured,
        )

    @property
    def missing(self) -> float:
        """Seconds of the run that nothing is known of: a part that was killed left nothing."""
        known = missing = 0.0
        for begin, end in self.measured or ():
            missing += max(0.0, begin - known)
            known = max(known, end)
        return missing

    def least(self) -> str:
        """The least one in words."""
        if not self.distances:
            return f"not measured{self._but()}"
        index = min(range(len(self.distances)), key=self.distances.__getitem__)
        first, second = self.between[index]
        where = f"{first} to {second}, at {self.times[index]:.1f} s"
        return f"{1e3 * self.distances[index]:.0f} mm: {where}{self._but()}"

    def _but(self) -> str:
        return f"; not known for {self.missing:.0f} s of a part that was killed" if self.missing else ""


def read_distances(session: Session) -> Distances | None:
    """Those of a session, None if nothing measured them; FormatError if the file is not as it should be."""
    if not (session.folder / DISTANCES).exists():
        return None
    document = session.read_document(DISTANCES, DISTANCES_FORMAT)
    try:
        return Distances.from_document(document)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        what = f"is no record of distances ({type(error).__name__}: {error})"
        raise FormatError([Problem(str(session.folder / DISTANCES), what)]) from error
