"""What of the camera's place a result has not found, but keeps as it was given."""

from __future__ import annotations

from dataclasses import dataclass

from dualcal_hal.session.result import T_H_E_NAME, Result


@dataclass(frozen=True)
class Kept:
    """Whether the camera's shift along its optical axis and its roll about it are the nominal ones by construction."""

    shift: bool
    roll: bool

    @classmethod
    def of(cls, result: Result) -> Kept:
        """The refined method finds both, if only with a large sigma."""
        entries = [] if result.accuracy is not None else [u for u in result.unobservable if u.of == T_H_E_NAME]
        return cls(
            shift=any(any(entry.direction[:3]) for entry in entries),
            roll=any(any(entry.direction[3:]) for entry in entries),
        )

    @property
    def words(self) -> str:
        """Empty where nothing is kept."""
        names = (("depth", self.shift), ("roll", self.roll))
        return " and ".join(name for name, kept in names if kept)
