"""Which captures of one arm are estimated from, which prove the result, and which are for neither."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dualcal_hal.config import OneArmConfig
from dualcal_hal.robot import Joints
from dualcal_hal.session.captures import CaptureRecord
from dualcal_hal.session.result import Rejected
from dualcal_hal.transforms import Array
from procedures.estimation.refined.data import Indices

SAME_PLACE = 5e-3
"""rad: an arm whose joints all are as close as this stands where it stood."""


@dataclass(frozen=True)
class Sorted:
    """In the captures' order."""

    calibration: tuple[CaptureRecord, ...]
    verification: tuple[CaptureRecord, ...]
    rejected: tuple[Rejected, ...]


def sort_out(captures: Sequence[CaptureRecord], config: OneArmConfig) -> Sorted:
    """Rejected is a view of which too little is known, and one to verify that is from where one to calibrate is."""
    wrong = {capture.id: reason for capture in captures if (reason := _unusable(capture))}
    calibration = tuple(c for c in captures if c.use == "calibration" and c.id not in wrong)
    others = [c for c in captures if c.use == "verification" and c.id not in wrong]
    for capture in others:
        for reason in _calibrated_with(capture, calibration, config):
            wrong.setdefault(capture.id, reason)
    return Sorted(
        calibration,
        tuple(capture for capture in others if capture.id not in wrong),
        tuple(Rejected(capture.id, wrong[capture.id]) for capture in captures if capture.id in wrong),
    )


def _unusable(capture: CaptureRecord) -> str:
    if capture.corners is None:
        return "has no corners: a feature point alone does not tell where the target is"
    return "" if any(capture.corners) else "no corner was seen"


def _calibrated_with(
    capture: CaptureRecord, calibration: Sequence[CaptureRecord], config: OneArmConfig
) -> Iterator[str]:
    for other in calibration:
        if other.constraint == capture.constraint or (
            config.camera_on_arm and other.active_arrival == capture.active_arrival
        ):
            yield f"verification on {capture.constraint}, which was calibrated with"
        elif _alike(joints_of(capture), joints_of(other)):
            yield f"verification from where {other.id} was taken, which was calibrated with"


def joints_of(capture: CaptureRecord) -> Joints:
    """Of the arm, rad: the stand has none."""
    return capture.active_joints or capture.passive_joints


def stops(captures: Sequence[CaptureRecord], config: OneArmConfig) -> Indices:
    """(k,): captures of one number were taken from where the arm had stopped once. An arm with the target, which is
    the passive one, stops anew for each.
    """
    if not config.camera_on_arm:
        return np.arange(len(captures))
    first: list[CaptureRecord] = []
    numbers = []
    for capture in captures:
        number = next((n for n, other in enumerate(first) if _one_stop(capture, other)), len(first))
        first += [capture] if number == len(first) else []
        numbers.append(number)
    return np.array(numbers, dtype=np.intp)


def _one_stop(capture: CaptureRecord, other: CaptureRecord) -> bool:
    """What another program calls one arrival may have been read elsewhere."""
    return capture.active_arrival == other.active_arrival and _alike(joints_of(capture), joints_of(other))


def _alike(joints: Joints, others: Joints) -> bool:
    apart: Array = np.subtract(joints, others)
    return bool(np.all(np.abs(np.angle(np.exp(1j * apart))) < SAME_PLACE))  # whole turns are the same place
