"""From the captures of a cell with one arm to a result. No device, repeatable on any session."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy import stats

from dualcal_hal.config import OneArmCell, OneArmConfig
from dualcal_hal.errors import DegenerateCaptures
from dualcal_hal.session.accuracy import DirectionRecord, FoundSigmaRecord, HiddenRecord, LimitsRecord
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
from dualcal_hal.session.plain import LARGEST
from dualcal_hal.session.result import Rejected, Verdict
from dualcal_hal.transforms import Array, Mask, apply, inverse
from procedures.analysis import Choices
from procedures.analysis.accuracy import known_records, required_accuracy_mm
from procedures.analysis.board_poses import refuse_two_kinds_of_noise, refuse_what_poses_hide
from procedures.analysis.verification import words_for
from procedures.estimation import Degenerate
from procedures.estimation.refined import Limits, Refined
from procedures.estimation.refined.data import CaptureArrays
from procedures.estimation.refined.hidden import hidden_of_one_arm
from procedures.estimation.refined.left_out import LeftOut, leave_one_out, predicted
from procedures.estimation.refined.one_arm import OneArm, as_captures, described
from procedures.estimation.refined.verification import LEAST_PROBABILITY, Consistency, in_order, verify
from procedures.figures import chance, two_digits
from procedures.one_arm.fit import estimate, inexact_of, joint_sigma, placement_of, views_of_captures
from procedures.one_arm.sorting import Sorted, joints_of, sort_out

_FEWEST_MOVED = 2
"""Views in a row at either end that are elsewhere, from where something is said to have moved."""

_FEWEST_OTHERS = 5
"""Views that fit each other by more than chance."""

_LEAST_PROBABILITY = LEAST_PROBABILITY / 2
"""Verification views and those calibrated with may either fail a result: each has half of the level."""

_COMPONENTS = tuple(f"{what} {axis}" for what in ("translation", "rotation") for axis in "xyz")


def analyse_one_arm(captures: Captures, cell: OneArmCell, choices: Choices | None = None) -> OneArmResult:
    """Estimate from the calibration captures, each of them predicted by the others; verify on the rest.

    Raises DegenerateCaptures for captures that do not determine camera and target, UsageError where captures or cell do
    not have what the choices need.
    """
    config, choices = cell.one_arm, choices or Choices()
    refuse_what_poses_hide(captures, cell, choices.free)
    if choices.find_noise:
        refuse_two_kinds_of_noise(captures)
    kinds = sort_out(captures.captures, config)
    if not kinds.calibration:
        raise DegenerateCaptures(_nothing_left(kinds))
    placement, inexact = placement_of(config), inexact_of(config, choices.free)
    estimated = config.procedure.knowns == "estimate"
    views = views_of_captures(cell, kinds.calibration)
    try:
        result = estimate(
            config,
            views,
            keep_all=choices.keep_all,
            find_noise=choices.find_noise,
            inexact=inexact,
            estimate_inexact=estimated,
        )
        found = described(views, placement, result)
        left_out = leave_one_out(views, found, [one for one in inexact if estimated or one.is_free])
    except Degenerate as error:
        raise DegenerateCaptures(f"the views do not tell where camera and target are: {error}") from error
    proof, lone = _verification(cell, result, kinds.verification) if kinds.verification else (None, ())
    accuracy = _accuracy(cell, found, (*kinds.calibration, *kinds.verification))
    fit = _fit_record(found, result)
    moved = tuple(_moved(cell, found, kinds.calibration))
    verdict, reasons = _judge(moved, fit, proof, accuracy, _off(left_out, found.used), lone)
    reasons = (*reasons, *found.warnings, *words_for(kinds.rejected))
    return _result(config, found, kinds, fit, left_out, accuracy, proof, verdict=verdict, reasons=reasons)


def _nothing_left(kinds: Sorted) -> str:
    why = [f"; {one.id}: {one.reason}" for one in kinds.rejected[:1]]
    return f"there are no calibration captures that can be used{''.join(why)}"


def _moved(cell: OneArmCell, found: OneArm, calibration: Sequence[CaptureRecord]) -> Iterator[str]:
    """What is said where it is the last views, or the first, that do not belong to the others; else nothing."""
    views, dropped = len(calibration), np.flatnonzero(~found.used)
    last = first = 0
    if found.scale > 1:
        last = _elsewhere(cell, calibration[::-1])
        first = 0 if last else _elsewhere(cell, calibration)
    elif len(dropped) >= _FEWEST_MOVED:
        last = len(dropped) if dropped[0] == views - len(dropped) else 0
        first = len(dropped) if dropped[-1] == len(dropped) - 1 else 0
    if last:
        yield f"the views from {calibration[-last].id} on are elsewhere: target or camera may have moved then"
    elif first:
        yield f"the views up to {calibration[first - 1].id} are elsewhere: target or camera may have moved then"


def _elsewhere(cell: OneArmCell, calibration: Sequence[CaptureRecord]) -> int:
    """How many of the first are not where the others put them, if these are more and fit the stated noise."""
    for count in range(_FEWEST_MOVED, min((len(calibration) + 1) // 2, len(calibration) - _FEWEST_OTHERS + 1)):
        try:
            rest = estimate(cell.one_arm, views_of_captures(cell, calibration[count:]), keep_all=True)
        except Degenerate:
            return 0
        if rest.scale == 1.0:
            others, _ = as_captures(views_of_captures(cell, calibration[:count]), placement_of(cell.one_arm))
            return 0 if verify(rest, others).fits else count
    return 0


def _accuracy(cell: OneArmCell, found: OneArm, captures: Sequence[CaptureRecord]) -> PredictedRecord:
    """Of points where the camera saw the target."""
    there = found.spatial_error(_targets(cell.one_arm, found, captures)[0])
    camera = found.spatial_error(np.zeros(3))
    return PredictedRecord(
        camera=PredictedErrorRecord(rms_mm=1e3 * float(camera.rms), p95_mm=1e3 * float(camera.p95)),
        at_target=PredictedErrorRecord(rms_mm=1e3 * float(there.rms.max()), p95_mm=1e3 * float(there.p95.max())),
        required_mm=required_accuracy_mm(cell),
    )


def _targets(config: OneArmConfig, found: OneArm, captures: Sequence[CaptureRecord]) -> tuple[Array, Array]:
    """(k, 3) m: where the target was at each capture, in the camera and in the arm's base."""
    flange = config.arm.chain.forward([joints_of(capture) for capture in captures])
    if config.camera_on_arm:
        in_base = np.tile(found.target, (len(captures), 1, 1))
        return (inverse(flange @ found.camera) @ in_base)[:, :3, 3], in_base[:, :3, 3]
    in_base = flange @ found.target
    return (inverse(found.camera) @ in_base)[:, :3, 3], in_base[:, :3, 3]


def _cannot_be_seen(config: OneArmConfig, found: OneArm, captures: Sequence[CaptureRecord]) -> Iterator[HiddenRecord]:
    """Against the base where the target was, against the flange at the camera or the target's corners."""
    carried = found.camera[None, :3, 3] if config.camera_on_arm else apply(found.target, config.target.board.corners)
    in_base = _targets(config, found, captures)[1]
    for one in hidden_of_one_arm(config.arm.chain, in_base, carried, found.known):
        yield HiddenRecord(what=one.what, by=one.by, error_mm=1e3 * one.error)


def _verification(
    cell: OneArmCell, result: Refined, captures: Sequence[CaptureRecord]
) -> tuple[OneArmVerificationRecord, tuple[str, ...]]:
    """And what is said of the one view that alone is off, if it is one."""
    config = cell.one_arm
    listed, knowns = as_captures(views_of_captures(cell, captures), placement_of(config))
    data = in_order(result, listed)
    turned = ~np.all(np.nan_to_num(data.pixels) == np.nan_to_num(listed.pixels), axis=(1, 2))
    looked_at = verify(result, data)
    off = predicted(data, result.knowns, result.T_P_A, result.T_H_E)
    before = predicted(data, knowns, inverse(config.nominal.target), config.nominal.camera)
    every = np.ones(len(captures), dtype=bool)
    record = OneArmVerificationRecord(
        nominal=_off(before, every),
        found=_off(off, every),
        chi_square=min(looked_at.statistic, LARGEST),
        degrees_of_freedom=looked_at.freedom,
        probability=looked_at.probability,
        least_probability=_LEAST_PROBABILITY,
        views=tuple(_verified(captures, off, looked_at, turned)),
    )
    return record, tuple(_lone(result, data, looked_at, [capture.id for capture in captures]))


def _lone(result: Refined, data: CaptureArrays, looked_at: Consistency, ids: Sequence[str]) -> Iterator[str]:
    """The view that is farthest off, where the others are as predicted without it."""
    if looked_at.probability >= _LEAST_PROBABILITY or len(data) == 1:
        return
    worst = np.arange(len(data)) == np.nanargmax(looked_at.captures / np.maximum(looked_at.freedoms, 1))
    if verify(result, data.only(~worst)).probability < _LEAST_PROBABILITY:
        return
    words = f"it is {ids[int(np.argmax(worst))]} alone that is off, the other verification views are as predicted"
    if verify(result, data.turned(worst)).probability >= _LEAST_PROBABILITY:
        yield f"{words}; so is this one with its corners listed from the other end"
    else:
        yield f"{words}: look first at its image, and whether arm, camera and target stood still there"


def _verified(
    captures: Sequence[CaptureRecord], off: LeftOut, looked_at: Consistency, turned: Mask
) -> Iterator[VerifiedViewRecord]:
    for k, capture in enumerate(captures):
        square = float(looked_at.captures[k])
        yield VerifiedViewRecord(
            id=capture.id,
            off=_off(off, np.arange(len(captures)) == k),
            chi_square=square if np.isfinite(square) else None,
            degrees_of_freedom=float(looked_at.freedoms[k]),
            residuals_px=_corners(off.pixels[k], turned=bool(turned[k])),
        )


def _off(left_out: LeftOut, chosen: Mask) -> OffRecord | None:
    """Over all corners of the chosen (k,) views; of one that should be behind the camera there is nothing to tell."""
    pixels, at_target = left_out.pixels[chosen], left_out.at_target[chosen]
    seen = np.isfinite(at_target)
    if not seen.any() or not np.isfinite(pixels[seen]).all():
        return None
    rms = float(np.sqrt(np.mean(pixels[seen] ** 2))), float(np.sqrt(np.mean(at_target[seen] ** 2)))
    return OffRecord(rms_px=rms[0], rms_mm=1e3 * rms[1])


def _judge(
    moved: tuple[str, ...],
    fit: OneArmFitRecord,
    proof: OneArmVerificationRecord | None,
    accuracy: PredictedRecord,
    left_out: OffRecord | None,
    lone: tuple[str, ...],
) -> tuple[Verdict, tuple[str, ...]]:
    """A misfit widens the covariance, behind which verification views that are off could hide: so it counts too. And
    where something moved, what holds for the rest of the views need not hold for what comes after.
    """
    reached, required = accuracy.at_target.p95_mm, accuracy.required_mm
    error = f"predicted 3D error of at most {two_digits(reached)} mm (95 %) where the camera saw the target"
    by_others = f"each view predicted by the others: {_said(left_out)}"
    misfit = _misfit(fit)
    if proof is None:
        nothing = "no verification views: nothing shows that the noise is as stated"
        return "unverified", (*moved, nothing, *misfit, by_others, error)
    is_off = proof.probability < _LEAST_PROBABILITY
    said = f"{_said(proof.found)}, {_chance(proof)}"
    if moved or is_off or fit.probability < _LEAST_PROBABILITY:
        are = "not where they are predicted, for the stated noise" if is_off else "where they are predicted"
        verified = f"the {len(proof.views)} verification views are {are}: {said}"
        look_at = (
            "look at whether target and camera are tight, at the joints' zeros, the arm's calibration, the intrinsics"
        )
        return "fail", (*moved, *((verified, *lone, *misfit) if is_off else (*misfit, verified)), by_others, look_at)
    reasons = (f"the {len(proof.views)} verification views are where they are predicted: {said}", *misfit, by_others)
    if reached > required:
        return "coarse", (f"{error}, above the {required:g} mm required", *reasons)
    return "ok", (f"{error}, within the {required:g} mm required", *reasons)


def _misfit(fit: OneArmFitRecord) -> tuple[str, ...]:
    if fit.scale == 1:
        return ()
    times = fit.scale**0.5
    return (f"the views do not fit the stated noise: they show {times:.1f} times as much; the covariance is widened",)


def _said(off: OffRecord | None) -> str:
    if off is None:
        return "the target should be behind the camera"
    return f"{two_digits(off.rms_px)} px, {two_digits(off.rms_mm)} mm at the target"


def _chance(proof: OneArmVerificationRecord) -> str:
    probability = f"probability {chance(proof.probability)}"
    if proof.chi_square >= LARGEST:
        return probability
    return f"chi-square {proof.chi_square:.0f} of {proof.degrees_of_freedom}, {probability}"


def _fit_record(found: OneArm, result: Refined) -> OneArmFitRecord:
    """Corners and arm together, and the arm by itself, may either give a misfit away: Bonferroni's for two."""
    parts = ((result.cost, result.freedom), (result.between, result.between_freedom))
    chances = [float(stats.chi2.sf(value, freedom)) for value, freedom in parts if freedom > 0]
    return OneArmFitRecord(
        chi_square=found.cost,
        degrees_of_freedom=found.freedom,
        probability=min(1.0, len(chances) * min(chances, default=1.0)),
        scale=found.scale,
        rms_px=found.rms,
    )


def _result(
    config: OneArmConfig,
    found: OneArm,
    kinds: Sorted,
    fit: OneArmFitRecord,
    left_out: LeftOut,
    accuracy: PredictedRecord,
    proof: OneArmVerificationRecord | None,
    *,
    verdict: Verdict,
    reasons: tuple[str, ...],
) -> OneArmResult:
    limits, names, calibration = Limits(), found.placement.names, kinds.calibration
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
        fit=fit,
        predicted_error=accuracy,
        cannot_be_seen=tuple(_cannot_be_seen(config, found, (*calibration, *kinds.verification))),
        left_out=_off(left_out, found.used),
        views=tuple(_view_records(found, calibration, left_out)),
        verification=proof,
        knowns=known_records(found.known),
        captures_used=tuple(c.id for c, used in zip(calibration, found.used, strict=True) if used),
        captures_rejected=(
            *kinds.rejected,
            *(Rejected(calibration[one.capture].id, one.reason) for one in found.dropped),
        ),
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
        known, turned = bool(np.isfinite(found.distances[k])), bool(found.flipped[k])
        yield OneArmViewRecord(
            id=capture.id,
            used=bool(found.used[k]),
            turned=turned,
            rms_px=_rms(found.residuals[k]),
            left_out=_off(left_out, np.arange(len(captures)) == k),
            chi_square=float(found.distances[k]) if known else None,
            degrees_of_freedom=float(found.freedoms[k]) if known else None,
            residuals_px=_corners(found.residuals[k], turned=turned),
        )


def _rms(residuals: Array) -> float | None:
    """Of those (n, 2) that there are, in each axis; none are of a target that should be behind the camera."""
    there = residuals[np.isfinite(residuals)]
    return float(np.sqrt(np.mean(there**2))) if len(there) else None


def _corners(residuals: Array, *, turned: bool) -> tuple[tuple[float, float] | None, ...]:
    """In the order of the capture's corners, from the other end of those that were turned for the estimate."""
    listed = residuals[::-1] if turned else residuals
    return tuple((float(u), float(v)) if np.isfinite(u) and np.isfinite(v) else None for u, v in listed)
