"""Whether two runs came to the same: what a replay gives against what was recorded."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dualcal_hal.session.captures import CaptureRecord
from dualcal_hal.session.result import T_H_E_NAME, T_P_A_NAME, Result
from dualcal_hal.transforms import rotation_angle

TOLERANCE_MM, TOLERANCE_RAD = 1e-6, 1e-9
"""Within which the same run on another machine agrees."""

TOLERANCE_PX = 1e-6


@dataclass(frozen=True)
class Comparison:
    """identical: to the last bit; differences: beyond the tolerances, a line for each."""

    identical: bool
    differences: tuple[str, ...]


def compare_captures(recorded: Sequence[CaptureRecord], now: Sequence[CaptureRecord]) -> Comparison:
    """By their ids; the numbers of the arrivals may differ, as an interrupted run counts others."""
    there, here = ({capture.id: replace(capture, active_arrival=0) for capture in each} for each in (recorded, now))
    lines = [f"capture {name} is missing" for name in there if name not in here]
    lines += [f"capture {name} was not recorded" for name in here if name not in there]
    for name in there.keys() & here.keys():
        lines += _capture_differences(there[name], here[name])
    return Comparison(there == here, tuple(sorted(lines)))


def compare_results(recorded: Result, now: Result) -> Comparison:
    """All of both."""
    return Comparison(recorded.to_document() == now.to_document(), tuple(_result_differences(recorded, now)))


def _capture_differences(recorded: CaptureRecord, now: CaptureRecord) -> Iterator[str]:
    for what in ("active_joints", "passive_joints"):
        off = float(np.max(np.abs(np.subtract(getattr(recorded, what), getattr(now, what)))))
        if off > TOLERANCE_RAD:
            yield f"capture {recorded.id}: {what.replace('_', ' ')} differ by {off:.3g} rad"
    pixels = np.array([recorded.feature, *_corners(recorded)]), np.array([now.feature, *_corners(now)])
    if pixels[0].shape != pixels[1].shape or np.any(np.isnan(pixels[0]) != np.isnan(pixels[1])):
        yield f"capture {recorded.id}: other corners are seen"
    elif (off := float(np.nanmax(np.abs(pixels[0] - pixels[1])))) > TOLERANCE_PX:
        yield f"capture {recorded.id}: corners differ by {off:.3g} px"
    if (recorded.aligned, recorded.order_known) != (now.aligned, now.order_known):
        yield f"capture {recorded.id}: another outcome"


def _corners(capture: CaptureRecord) -> list[tuple[float, float]]:
    return [corner or (np.nan, np.nan) for corner in capture.corners or ()]


def _result_differences(recorded: Result, now: Result) -> Iterator[str]:
    for name, there, here in (
        (T_P_A_NAME, recorded.T_P_A, now.T_P_A),
        (T_H_E_NAME, recorded.T_H_E, now.T_H_E),
    ):
        shift = 1e3 * float(np.linalg.norm(there[:3, 3] - here[:3, 3]))
        turn = float(rotation_angle(there[:3, :3], here[:3, :3]))
        if shift > TOLERANCE_MM or turn > TOLERANCE_RAD:
            yield f"{name} differs by {shift:.3g} mm and {turn:.3g} rad"
    for when, there_, here_ in (
        ("before", recorded.mismatch_before, now.mismatch_before),
        ("after", recorded.mismatch_after, now.mismatch_after),
    ):
        if (there_ is None) != (here_ is None):
            yield f"mismatch {when}: only one of both was verified"
        elif there_ is not None and here_ is not None and (off := 1e3 * abs(there_.mean - here_.mean)) > TOLERANCE_MM:
            yield f"mean mismatch {when} differs by {off:.3g} mm"
    for what in ("method", "verdict", "captures_used"):
        if getattr(recorded, what) != getattr(now, what):
            yield f"{what.replace('_', ' ')}: recorded {getattr(recorded, what)}, now {getattr(now, what)}"
    rejected = [tuple(capture.id for capture in each.captures_rejected) for each in (recorded, now)]
    if rejected[0] != rejected[1]:
        yield f"captures rejected: recorded {rejected[0]}, now {rejected[1]}"
