"""A result by maximum likelihood over all corners, with what it is worth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dualcal_hal.config import CellConfig
from dualcal_hal.errors import DegenerateCaptures, UsageError
from dualcal_hal.session.accuracy import Accuracy, PartRecord, Verification, VerifiedCaptureRecord
from dualcal_hal.session.captures import CaptureRecord, Captures
from dualcal_hal.session.plain import LARGEST
from dualcal_hal.session.result import T_H_E_NAME, T_P_A_NAME, Rejected, Result, Unobservable, Verdict
from dualcal_hal.transforms import Array, smallest_rotation, transform
from procedures.analysis.accuracy import accuracy_record, region_of
from procedures.analysis.knowns import arrays, given_knowns, inexact_knowns, stated_noise
from procedures.analysis.verification import CalibratedPlaces, joints, mismatch_of, mismatch_record, words_for
from procedures.estimation import Degenerate, Statistics, mismatch, statistics
from procedures.estimation.projection import undistort
from procedures.estimation.refined import Inexact, Refined, refined
from procedures.estimation.refined.suspects import TOGETHER, Suspect, next_suspects
from procedures.estimation.refined.verification import LEAST_PROBABILITY, Consistency, Part, verify
from procedures.figures import chance

FREE = ("target_mount", "intrinsics")
"""Knowns that can be left to the captures altogether."""


_MANY = 1e6  # squares, of which the number no longer counts
_FEWEST_CAPTURES, _FEWEST_ARRIVALS = 3, 2  # to verify with; the captures of one arrival share its error


@dataclass(frozen=True)
class Choices:
    """find_noise: the sigmas are found from the captures; keep_all: no capture is dropped; free: of ``FREE``."""

    find_noise: bool = False
    keep_all: bool = False
    free: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in self.free:
            if name not in FREE:
                raise UsageError(
                    f"--free {name}: only {' and '.join(FREE)} can be free; a sigma in the cell file may do"
                )


def analyse_refined(captures: Captures, cell: CellConfig, choices: Choices) -> Result:
    """Estimate from the calibration captures, verify on the others.

    Rejected is a verification capture on a constraint or arrival that was calibrated with, and what is no part of the
    rest. Raises DegenerateCaptures for captures that do not determine the transforms.
    """
    calibration, verification, rejected = _sort_out(captures.captures)
    inexact = inexact_knowns(cell, choices.free)
    found = _estimate(calibration, cell, choices, inexact)
    rejected += tuple(Rejected(calibration[one.capture].id, one.reason) for one in found.dropped)
    looked_at = verify(found, arrays(verification, cell)) if verification else None
    region = region_of(cell, verification or calibration)
    accuracy = accuracy_record(found, cell, calibration, [*calibration, *verification], region, stated_noise(cell))
    suspects = _suspects(looked_at, found, calibration, verification, cell)
    seen = None if looked_at is None else _verification_record(looked_at, suspects, verification)
    verdict, reasons = _judge(seen, accuracy)
    before = mismatch_of(verification, cell, cell.nominal.T_P_A, cell.nominal.T_H_E)
    after = _mismatch_after(verification, cell, found)
    return Result(
        method="refined",
        T_P_A=found.T_P_A,
        T_H_E=found.T_H_E,
        optical_axis=found.T_H_E[:3, 2],
        unobservable=_unobservable(found),
        iterations=(),
        mismatch_before=mismatch_record(before),
        mismatch_after=mismatch_record(after),
        captures_used=tuple(capture.id for capture, used in zip(calibration, found.used, strict=True) if used),
        captures_rejected=rejected,
        verdict=verdict,
        reasons=(*reasons, *found.warnings, *words_for(rejected)),
        accuracy=accuracy,
        verification=seen,
    )


def _sort_out(
    captures: Sequence[CaptureRecord],
) -> tuple[list[CaptureRecord], list[CaptureRecord], tuple[Rejected, ...]]:
    """For the estimate, for the proof, and those for neither."""
    calibrated = CalibratedPlaces.of(captures)
    verification = [capture for capture in captures if capture.use == "verification"]
    return (
        [capture for capture in captures if capture.use == "calibration"],
        [capture for capture in verification if not calibrated.has(capture)],
        tuple(Rejected(capture.id, calibrated.reason(capture)) for capture in verification if calibrated.has(capture)),
    )


def _estimate(
    calibration: Sequence[CaptureRecord], cell: CellConfig, choices: Choices, inexact: Sequence[Inexact]
) -> Refined:
    try:
        return refined(
            arrays(calibration, cell),
            given_knowns(cell),
            stated_noise(cell),
            further_starts=[(cell.nominal.T_P_A, cell.nominal.T_H_E)],
            keep_all=choices.keep_all,
            estimate_noise=choices.find_noise,
            inexact=inexact,
            estimate_inexact=cell.procedure.knowns == "estimate",
        )
    except Degenerate as error:
        raise DegenerateCaptures(f"the captures do not determine the transforms: {error}") from error


def _mismatch_after(verification: Sequence[CaptureRecord], cell: CellConfig, found: Refined) -> Statistics | None:
    """Of the feature point, where the knowns that were found have it, from the line that is seen in the principal point
    which was aligned with: the optical axis, but where intrinsics were found.
    """
    if not verification:
        return None
    knowns = found.knowns
    aligned = undistort(cell.camera.intrinsics.principal_point, knowns.matrix, knowns.distortion)
    turned = smallest_rotation([0.0, 0.0, 1.0], [*aligned.ravel(), 1.0])
    active, passive = joints(verification, cell)
    T_P_T = knowns.passive.forward(passive) @ knowns.T_F_T
    axis = found.T_H_E @ transform(turned, [0.0, 0.0, 0.0])
    return statistics(mismatch(found.T_P_A, axis, knowns.active.forward(active), T_P_T[:, :3, 3]))


def _suspects(
    looked_at: Consistency | None,
    found: Refined,
    calibration: Sequence[CaptureRecord],
    verification: Sequence[CaptureRecord],
    cell: CellConfig,
) -> tuple[Suspect, ...]:
    """What to look at next, where the verification captures are not as predicted."""
    if looked_at is None or looked_at.fits:
        return ()
    used = [capture for capture, kept in zip(calibration, found.used, strict=True) if kept]
    every = [*used, *verification]
    return next_suspects(found, arrays(every, cell), [capture.id for capture in every])


def _judge(seen: Verification | None, accuracy: Accuracy) -> tuple[Verdict, tuple[str, ...]]:
    space = accuracy.error_3d
    predicted = f"predicted 3D error of at most {space.p95_mm:.2g} mm (95 %) in the region"
    if seen is None:
        return "unverified", ("no verification captures: nothing shows that the noise is as stated", predicted)
    said = _said(seen)
    if seen.look_at == (TOGETHER.words,):
        off = f"the verification captures are farther from where they are predicted than chance explains: {said}"
        return "coarse", (off, f"look next at {TOGETHER.words}", predicted)
    if seen.probability < seen.least_probability:
        return "fail", (
            f"the verification captures are not where they are predicted, for the stated noise: {said}",
            *(f"look next at {words}" for words in seen.look_at[:1]),
        )
    reasons = (
        f"the verification captures are where they are predicted: {said}",
        *_few(seen),
        *_doubts(accuracy),
    )
    if space.p95_mm > space.required_mm:
        return "coarse", (f"{predicted}, above the {space.required_mm:g} mm required", *reasons)
    return "ok", (f"{predicted}, within the {space.required_mm:g} mm required", *reasons)


def _said(seen: Verification) -> str:
    parts = [
        f"{what} chi-square {_squares(part.chi_square)} of {part.degrees_of_freedom},"
        f" probability {chance(part.probability)}"
        for what, part in (("boards", seen.poses), ("corners on their boards", seen.corners))
        if part is not None and part.degrees_of_freedom
    ]
    both = f"; of either part (twice the smaller) {chance(seen.probability)}" if len(parts) > 1 else ""
    return f"{'; '.join(parts)}{both}"


def _few(seen: Verification) -> Iterator[str]:
    """Where it is worth little that the verification captures fit."""
    captures, arrivals = len(seen.captures), seen.arrivals or 0
    if captures < _FEWEST_CAPTURES or arrivals < _FEWEST_ARRIVALS:
        taken = f"{captures} verification capture{'s' * (captures > 1)} at {arrivals} arrival{'s' * (arrivals > 1)}"
        yield f"{taken} of the active arm prove{'s' * (captures == 1)} little: verify at several arrivals"


def _doubts(accuracy: Accuracy) -> Iterator[str]:
    """Where the calibration captures say otherwise than those of the verification."""
    fit = accuracy.fit
    if fit.scale > 1:
        why = "knowns that are not exact may be why" if accuracy.knowns else "something is off that these do not show"
        numbers = f"chi-square {fit.chi_square:.0f} of {fit.degrees_of_freedom}"
        yield f"yet the calibration captures themselves do not fit the stated noise ({numbers}): {why}"


def _squares(value: float) -> str:
    return f"{value:.1f}" if value < _MANY else f"{value:.1g}"


def _verification_record(
    looked_at: Consistency, suspects: Sequence[Suspect], verification: Sequence[CaptureRecord]
) -> Verification:
    return Verification(
        poses=_part_record(looked_at.poses),
        corners=_part_record(looked_at.corners),
        probability=looked_at.probability,
        least_probability=LEAST_PROBABILITY,
        arrivals=len({capture.active_arrival for capture in verification}),
        captures=tuple(
            VerifiedCaptureRecord(id=capture.id, chi_square=_finite(square), degrees_of_freedom=freedom)
            for capture, square, freedom in zip(
                verification, looked_at.captures.tolist(), looked_at.freedoms.tolist(), strict=True
            )
        ),
        look_at=tuple(suspect.words for suspect in suspects),
    )


def _part_record(part: Part) -> PartRecord:
    return PartRecord(chi_square=_finite(part.squares), degrees_of_freedom=part.freedom, probability=part.probability)


def _finite(value: float) -> float:
    """Of a board that should be behind the camera no square can be told: the largest a file holds."""
    return value if np.isfinite(value) else LARGEST


def _unobservable(found: Refined) -> tuple[Unobservable, ...]:
    entries = []
    for index, direction in enumerate(found.directions):
        if not direction.observable:
            of, axis = divmod(index, 6)
            unit: Array = np.eye(6)[axis]
            entries.append(Unobservable(direction.name, tuple(unit.tolist()), (T_P_A_NAME, T_H_E_NAME)[of]))
    return tuple(entries)
