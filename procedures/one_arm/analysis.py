"""From the captures of a cell with one arm to a result. No device, repeatable on any session."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from dualcal_hal.config import OneArmCell, OneArmConfig
from dualcal_hal.errors import DegenerateCaptures
from dualcal_hal.session.accuracy import DirectionRecord, FoundSigmaRecord, LimitsRecord
from dualcal_hal.session.captures import CaptureRecord, Captures
from dualcal_hal.session.one_arm_result import (
    CovarianceRecord,
    OffRecord,
    OneArmFitRecord,
    OneArmNoiseRecord,
    OneArmResult,
    OneArmVerificationRecord,
    OneArmViewRecord,
    PredictedErrorRecord,
    PredictedRecord,
    TransformRecord,
    VerifiedViewRecord,
)
from dualcal_hal.session.result import Rejected, Verdict
from dualcal_hal.transforms import Array, Mask, inverse
from procedures.analysis import Choices
from procedures.analysis.accuracy import known_records
from procedures.detection.outcome import corners_from_record
from procedures.estimation import Degenerate
from procedures.estimation.refined import Limits, Refined
from procedures.estimation.refined.left_out import LeftOut, leave_one_out, predicted
from procedures.estimation.refined.one_arm import OneArm, Placement, Views, as_captures, described
from procedures.estimation.refined.verification import LEAST_PROBABILITY, Consistency, verify
from procedures.one_arm.fit import estimate, inexact_of, joint_sigma, placement_of, views_of

_FEWEST_MOVED = 2
"""Views in a row at either end that are dropped, from where something is said to have moved."""

_COMPONENTS = tuple(f"{what} {axis}" for what in ("translation", "rotation") for axis in "xyz")


def analyse_one_arm(captures: Captures, cell: OneArmCell, choices: Choices | None = None) -> OneArmResult:
    """Estimate from the calibration captures, each of them predicted by the others; verify on the rest.

    Raises DegenerateCaptures for captures that do not determine camera and target.
    """
    config, choices = cell.one_arm, choices or Choices()
    calibration, verification = (_of(captures, use) for use in ("calibration", "verification"))
    placement, inexact = placement_of(config), inexact_of(config, choices.free)
    views = _views(config, calibration)
    try:
        result = estimate(config, views, keep_all=choices.keep_all, find_noise=choices.find_noise, inexact=inexact)
        found = described(views, placement, result)
        left_out = leave_one_out(views, found, inexact)
    except Degenerate as error:
        raise DegenerateCaptures(f"the views do not tell where camera and target are: {error}") from error
    proof = _verification(config, placement, result, verification) if verification else None
    accuracy = _accuracy(config, found, calibration + verification)
    verdict, reasons = _judge(found, proof, accuracy, _off(left_out, found.used))
    if moved := _moved(found, calibration):
        # What holds for the rest of the views need not hold for what comes after.
        verdict, reasons = "fail", (moved, *reasons)
    reasons = (*reasons, *found.warnings)
    return _result(config, found, calibration, left_out, accuracy, proof, verdict=verdict, reasons=reasons)


def _moved(found: OneArm, calibration: Sequence[CaptureRecord]) -> str:
    """What is said where it is the last views, or the first, that do not belong to the others; else nothing."""
    dropped = np.flatnonzero(~found.used)
    count, views = len(dropped), len(calibration)
    if count >= _FEWEST_MOVED and dropped[0] == views - count:
        return f"the views from {calibration[dropped[0]].id} on are elsewhere: target or camera may have moved then"
    if count >= _FEWEST_MOVED and dropped[-1] == count - 1:
        return f"the views up to {calibration[dropped[-1]].id} are elsewhere: target or camera may have moved then"
    return ""


def _of(captures: Captures, use: str) -> list[CaptureRecord]:
    """Those with corners: nothing else tells where a target is that may be anywhere."""
    return [capture for capture in captures.captures if capture.use == use and capture.corners is not None]


def _views(config: OneArmConfig, captures: Sequence[CaptureRecord]) -> Views:
    if not captures:
        raise DegenerateCaptures("there are no calibration captures with corners")
    corners = [corners_from_record(capture.corners or ()) for capture in captures]
    return views_of(config, [capture.active_joints or capture.passive_joints for capture in captures], corners)


def _accuracy(config: OneArmConfig, found: OneArm, captures: Sequence[CaptureRecord]) -> PredictedRecord:
    """Of points where the camera saw the target."""
    flange = config.arm.chain.forward([capture.active_joints or capture.passive_joints for capture in captures])
    carried = inverse(flange) if config.camera_on_arm else flange
    in_camera = (inverse(found.camera) @ carried @ found.target)[:, :3, 3]
    there, camera = found.spatial_error(in_camera), found.spatial_error(np.zeros(3))
    return PredictedRecord(
        camera=PredictedErrorRecord(rms_mm=1e3 * float(camera.rms), p95_mm=1e3 * float(camera.p95)),
        at_target=PredictedErrorRecord(rms_mm=1e3 * float(there.rms.max()), p95_mm=1e3 * float(there.p95.max())),
        required_mm=1e3 * config.procedure.verification.required_accuracy,
    )


def _verification(
    config: OneArmConfig, placement: Placement, result: Refined, captures: Sequence[CaptureRecord]
) -> OneArmVerificationRecord:
    views = _views(config, captures)
    data, knowns = as_captures(views, placement)
    looked_at = verify(result, data)
    off = predicted(data, result.knowns, result.T_P_A, result.T_H_E)
    before = predicted(data, knowns, inverse(config.nominal.target), config.nominal.camera)
    every = np.ones(len(captures), dtype=bool)
    return OneArmVerificationRecord(
        nominal=_off(before, every) if np.isfinite(before.pixels).any(axis=(1, 2)).all() else None,
        found=_off(off, every),
        chi_square=looked_at.statistic,
        degrees_of_freedom=looked_at.freedom,
        probability=looked_at.probability,
        least_probability=LEAST_PROBABILITY,
        views=tuple(_verified(captures, off, looked_at)),
    )


def _verified(captures: Sequence[CaptureRecord], off: LeftOut, looked_at: Consistency) -> Iterator[VerifiedViewRecord]:
    for k, capture in enumerate(captures):
        yield VerifiedViewRecord(
            id=capture.id,
            off=_off(off, np.arange(len(captures)) == k),
            chi_square=float(looked_at.captures[k]),
            degrees_of_freedom=float(looked_at.freedoms[k]),
            residuals_px=_corners(off.pixels[k]),
        )


def _off(left_out: LeftOut, chosen: Mask) -> OffRecord:
    """Over all corners of the chosen (k,) views."""
    pixels, at_target = left_out.pixels[chosen], left_out.at_target[chosen]
    rms = float(np.sqrt(np.nanmean(pixels**2))), float(np.sqrt(np.nanmean(at_target**2)))
    return OffRecord(rms_px=rms[0], rms_mm=1e3 * rms[1])


def _judge(
    found: OneArm, proof: OneArmVerificationRecord | None, accuracy: PredictedRecord, left_out: OffRecord
) -> tuple[Verdict, tuple[str, ...]]:
    reached, required = accuracy.at_target.p95_mm, accuracy.required_mm
    error = f"predicted 3D error of at most {reached:.2g} mm (95 %) where the camera saw the target"
    by_others = f"each view predicted by the others: {left_out.rms_px:.2g} px, {left_out.rms_mm:.2g} mm at the target"
    look_at = "look at whether target and camera are tight, at the joints' zeros, the arm's calibration, the intrinsics"
    if found.scale > 1:
        times = found.scale**0.5
        return "fail", (
            f"the views do not fit the stated noise: they show {times:.1f} times as much",
            by_others,
            look_at,
        )
    if proof is None:
        return "unverified", ("no verification views: nothing shows that the noise is as stated", by_others, error)
    said = (
        f"{proof.found.rms_px:.2g} px, {proof.found.rms_mm:.2g} mm at the target, chi-square {proof.chi_square:.0f} of "
        f"{proof.degrees_of_freedom}, probability {proof.probability:.2g}"
    )
    if proof.probability < LEAST_PROBABILITY:
        what = (
            f"the {len(proof.views)} verification views are not where they are predicted, for the stated noise: {said}"
        )
        return "fail", (what, by_others, look_at)
    reasons = (f"the {len(proof.views)} verification views are where they are predicted: {said}", by_others)
    if reached > required:
        return "coarse", (f"{error}, above the {required:g} mm required", *reasons)
    return "ok", (f"{error}, within the {required:g} mm required", *reasons)


def _result(
    config: OneArmConfig,
    found: OneArm,
    calibration: Sequence[CaptureRecord],
    left_out: LeftOut,
    accuracy: PredictedRecord,
    proof: OneArmVerificationRecord | None,
    *,
    verdict: Verdict,
    reasons: tuple[str, ...],
) -> OneArmResult:
    limits, names = Limits(), found.placement.names
    return OneArmResult(
        placement=found.placement.value,
        transforms={name: TransformRecord.of(T) for name, T in found.transforms.items()},
        covariance=CovarianceRecord(
            order=tuple(f"{name}: {component}" for name in names for component in _COMPONENTS),
            matrix=tuple(map(tuple, found.covariance.tolist())),
        ),
        directions=tuple(_directions(found)),
        limits=LimitsRecord(translation_mm=1e3 * limits.translation, rotation_deg=float(np.degrees(limits.rotation))),
        condition=found.condition if np.isfinite(found.condition) else None,
        noise=OneArmNoiseRecord(pixel_px=found.pixel_sigma, joint_mrad=1e3 * found.arm_sigma),
        stated_noise=OneArmNoiseRecord(pixel_px=config.camera.sigma_px, joint_mrad=1e3 * joint_sigma(config)),
        found_noise=_found_noise(found),
        fit=OneArmFitRecord(
            chi_square=found.cost, degrees_of_freedom=found.freedom, scale=found.scale, rms_px=found.rms
        ),
        predicted_error=accuracy,
        left_out=_off(left_out, found.used),
        views=tuple(_view_records(found, calibration, left_out)),
        verification=proof,
        knowns=known_records(found.known),
        captures_used=tuple(c.id for c, used in zip(calibration, found.used, strict=True) if used),
        captures_rejected=tuple(Rejected(calibration[one.capture].id, one.reason) for one in found.dropped),
        verdict=verdict,
        reasons=reasons,
    )


def _directions(found: OneArm) -> Iterator[DirectionRecord]:
    for index, one in enumerate(found.directions):
        if index % 6 < 3:
            yield DirectionRecord(name=one.name, sigma_mm=1e3 * one.sigma, observable=one.observable)
        else:
            yield DirectionRecord(name=one.name, sigma_deg=float(np.degrees(one.sigma)), observable=one.observable)


def _found_noise(found: OneArm) -> tuple[FoundSigmaRecord, ...] | None:
    if found.found is None:
        return None
    return tuple(
        FoundSigmaRecord(
            name=name,
            value=scale * sigma.value,
            lower=scale * sigma.lower,
            upper=scale * sigma.upper,
            identified=sigma.identified,
        )
        for name, sigma, scale in (("pixel_px", found.found.pixel, 1.0), ("joint_mrad", found.found.joint, 1e3))
    )


def _view_records(found: OneArm, captures: Sequence[CaptureRecord], left_out: LeftOut) -> Iterator[OneArmViewRecord]:
    for k, capture in enumerate(captures):
        known = bool(np.isfinite(found.distances[k]))
        yield OneArmViewRecord(
            id=capture.id,
            used=bool(found.used[k]),
            rms_px=float(np.sqrt(np.nanmean(found.residuals[k] ** 2))),
            left_out=_off(left_out, np.arange(len(captures)) == k),
            chi_square=float(found.distances[k]) if known else None,
            degrees_of_freedom=float(found.freedoms[k]) if known else None,
            residuals_px=_corners(found.residuals[k]),
        )


def _corners(residuals: Array) -> tuple[tuple[float, float] | None, ...]:
    return tuple((float(u), float(v)) if np.isfinite(u) and np.isfinite(v) else None for u, v in residuals)
