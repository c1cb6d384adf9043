"""From captures and a cell to a result. No device, repeatable on any session."""

from __future__ import annotations

from dualcal_hal.config import METHODS, CellConfig
from dualcal_hal.errors import UsageError
from dualcal_hal.session.captures import Captures
from dualcal_hal.session.result import Result
from procedures.analysis.board_poses import refuse_two_kinds_of_noise, refuse_what_poses_hide
from procedures.analysis.paper import analyse_as_paper
from procedures.analysis.refined import FREE, Choices, analyse_refined

__all__ = ["FREE", "Choices", "analyse"]


def analyse(captures: Captures, cell: CellConfig, method: str, choices: Choices | None = None) -> Result:
    """Estimate from the calibration captures, verify on the others.

    choices: of the refined method alone. Raises UsageError for an unknown method, choices that are not for it, and
    where captures or cell do not have what the method needs; DegenerateCaptures for captures that do not determine the
    transforms.
    """
    if method == "refined":
        choices = choices or Choices()
        refuse_what_poses_hide(captures, cell, choices.free)
        if choices.find_noise:
            refuse_two_kinds_of_noise(captures)
        return analyse_refined(captures, cell, choices)
    if method != "paper":
        raise UsageError(f"unknown method '{method}'; there are: {', '.join(METHODS)}")
    if choices is not None:
        raise UsageError("--noise, --keep-all and --free are for method refined")
    return analyse_as_paper(captures, cell)
