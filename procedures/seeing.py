"""Looking for the target: a picture between two readings of the arms, and the corners in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualcal_hal.errors import ArmMoved
from procedures.detection import Detection, Detector, Missed
from procedures.planning.belief import Belief
from procedures.planning.model import CellModel
from procedures.steps import Procedure, Sighting, look


@dataclass(frozen=True, eq=False)
class Seen:
    """What a picture showed: the corners, or why there are none to use. No sighting if an arm moved meanwhile."""

    sighting: Sighting | None
    detection: Detection | None
    reason: str = ""


def see(model: CellModel, detector: Detector, belief: Belief) -> Procedure[Seen]:
    """Take a picture from where the arms stand and find the target in it.

    Corners whose order is not known are of no use here: an even pattern's feature point would be another corner, and
    a fit to all corners would be to the wrong ones.
    """
    try:
        sighting = yield from look()
    except ArmMoved as moved:
        return Seen(None, None, str(moved))
    predicted = model.predict_corners(sighting.active, sighting.passive, belief)
    found = detector.detect(sighting.frame.image, predicted if np.all(np.isfinite(predicted)) else None)
    if isinstance(found, Missed):
        return Seen(sighting, None, f"{found.reason}: {found.detail}")
    if not found.order_known:
        return Seen(sighting, None, "the pattern could be seen from two sides: the order of its corners is not known")
    return Seen(sighting, found)
