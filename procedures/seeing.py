"""Looking for the target: a picture between two readings of the arms, and the corners in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualcal_hal.errors import ArmMoved
from procedures.detection import Detection, Detector, Miss, Missed
from procedures.detection.outcome import found_from_record, found_to_record
from procedures.planning.belief import Belief
from procedures.planning.model import CellModel
from procedures.steps import Mark, Procedure, Sighting, look, work


@dataclass(frozen=True, eq=False)
class Seen:
    """What a picture showed: the corners, or why there are none; no sighting if an arm moved meanwhile.

    ``reason`` is empty if all is known of what was seen.
    """

    sighting: Sighting | None
    detection: Detection | None
    reason: str = ""


def see(model: CellModel, detector: Detector, belief: Belief) -> Procedure[Seen]:
    """Take a picture from where the arms stand and find the target in it.

    Where the order of the corners is not known the reason says so; the corners are given, for the feature point of an
    odd pattern is the middle one in any order.
    """
    try:
        sighting = yield from look()
    except ArmMoved as moved:
        return Seen(None, None, str(moved))
    predicted = model.predict_corners(sighting.active, sighting.passive, belief)
    near = predicted if np.all(np.isfinite(predicted)) else None
    image = sighting.frame.image
    found = yield from work(
        "detection",
        {},
        lambda: detector.detect(image, near),
        found_to_record,
        lambda record: found_from_record(record, len(model.board.corners)),
        of_image=True,
    )
    yield Mark(sighting.frame.time, _feature(found))
    if isinstance(found, Missed):
        return Seen(sighting, None, str(found))
    if not found.order_known:
        unknown = Missed(Miss.AMBIGUOUS_ORDER, "the pattern looks alike from two sides; use charuco")
        return Seen(sighting, found, str(unknown))
    return Seen(sighting, found)


def _feature(found: Detection | Missed) -> tuple[float, float] | None:
    if isinstance(found, Missed) or not np.all(np.isfinite(found.feature)):
        return None
    return float(found.feature[0]), float(found.feature[1])
