"""``distances.json``: how far the arms stayed from each other over a run, where something measured it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dualcal_hal.session.folder import Session

DISTANCES = "distances.json"
DISTANCES_FORMAT = "dualcal.distances/1"


@dataclass(frozen=True)
class Distances:
    """Times in s, least distances between the arms in m, and between which parts that was."""

    times: Sequence[float]
    distances: Sequence[float]
    between: Sequence[tuple[str, str]]

    def to_document(self) -> dict[str, Any]:
        """As in the file: pairs of parts by their index in ``pairs``."""
        pairs = sorted(set(self.between))
        return {
            "format": DISTANCES_FORMAT,
            "time_s": list(self.times),
            "distance_mm": [1e3 * distance for distance in self.distances],
            "pair": [pairs.index(pair) for pair in self.between],
            "pairs": [list(pair) for pair in pairs],
        }

    @staticmethod
    def from_document(document: Mapping[str, Any]) -> Distances:
        """From what :meth:`to_document` gives."""
        pairs = [(first, second) for first, second in document["pairs"]]
        distances = [distance / 1e3 for distance in document["distance_mm"]]
        return Distances(document["time_s"], distances, [pairs[index] for index in document["pair"]])

    def least(self) -> str:
        """The least one in words."""
        index = min(range(len(self.distances)), key=self.distances.__getitem__)
        first, second = self.between[index]
        return f"{1e3 * self.distances[index]:.0f} mm: {first} to {second}, at {self.times[index]:.1f} s"


def read_distances(session: Session) -> Distances | None:
    """Those of a session, None if nothing measured them; FormatError if the file is not as it should be."""
    if not (session.folder / DISTANCES).exists():
        return None
    return Distances.from_document(session.read_document(DISTANCES, DISTANCES_FORMAT))
