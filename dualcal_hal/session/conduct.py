"""``run.json``: how a run was made, where that is not how the cell file alone has it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dualcal_hal.errors import FormatError, Problem
from dualcal_hal.pace import FULL_PACE, Pace
from dualcal_hal.session.folder import Session
from dualcal_hal.session.plain import Fields

CONDUCT = "run.json"
CONDUCT_FORMAT = "dualcal.run/1"

CALIBRATION, INTRINSICS = PROCEDURES = ("calibration", "intrinsics")
"""What runs are for."""


@dataclass(frozen=True)
class Conduct:
    """pace: how fast the arms might be; emulated: whether the devices were an emulator started for the run; procedure:
    its name on the command line."""

    pace: Pace = FULL_PACE
    emulated: bool = False
    procedure: str = CALIBRATION

    def to_document(self) -> dict[str, Any]:
        """As in the file."""
        largest = self.pace.largest
        return {
            "format": CONDUCT_FORMAT,
            "procedure": self.procedure,
            "emulated": self.emulated,
            "speed": {"share": self.pace.share, "largest_mm_s": None if largest is None else largest * 1e3},
        }


def read_conduct(session: Session) -> Conduct:
    """What the session says; as the cell file alone has it where it says nothing. FormatError if it is damaged."""
    path = session.folder / CONDUCT
    if not path.exists():
        return Conduct()
    try:
        fields = Fields(session.read_document(CONDUCT, CONDUCT_FORMAT), CONDUCT)
        speed = fields.part("speed")
        share = speed.finite("share")
        largest = None if speed.is_null("largest_mm_s") else speed.finite("largest_mm_s") / 1e3
        if not 0 < share <= 1 or (largest is not None and largest <= 0):
            raise ValueError("speed: is none that arms could have")
        procedure = fields.choice("procedure", PROCEDURES) if "procedure" in fields else CALIBRATION
        return Conduct(Pace(share, largest), fields.flag("emulated"), procedure)
    except ValueError as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError([Problem(str(path), str(error))]) from error


def keep_conduct(session: Session, conduct: Conduct) -> None:
    """Write it down, unless there is nothing to say, nor was before."""
    if conduct != read_conduct(session):
        session.write_document(CONDUCT, conduct.to_document())
