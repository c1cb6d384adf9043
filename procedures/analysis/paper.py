"""A result by the two steps of the paper."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from dualcal_hal.config import CellConfig
from dualcal_hal.errors import DegenerateCaptures
from dualcal_hal.robot import Joints
from dualcal_hal.session.captures import CaptureRecord, Captures, Use
from dualcal_hal.session.result import Rejected, Result, Unobservable
from dualcal_hal.transforms import Array
from procedures.analysis.verification import CalibratedPlaces, mismatch_of, mismatch_record, poses, words_for
from procedures.estimation import Degenerate, Estimate, Iteration, estimate, judge

FARTHEST_ALIGNED = 1.0
"""px in each axis; a feature point farther from the principal point than this does not count as aligned, one within
it is a capture even where the alignment did not converge."""

FEWEST_POSITIONS = 3
"""Positions that make a line; a constraint that loses more to rejected captures is left out as a whole."""

FARTHEST_ARRIVED = 5e-3
"""rad; an active joint farther than this from where the constraint's others have it stands on another axis."""


def analyse_as_paper(captures: Captures, cell: CellConfig) -> Result:
    """Estimate from the calibration captures, verify on the others.

    Rejected is a verification capture on a constraint or arrival that was calibrated with, a capture whose feature
    point is not aligned, and one for which the active arm stood elsewhere than for its constraint's others. Raises
    DegenerateCaptures for captures that do not determine the transforms.
    """
    used, rejected = _sort_out(captures.captures, cell)
    calibration = [capture for capture in used if capture.use == "calibration"]
    verification = [capture for capture in used if capture.use == "verification"]
    try:
        found = _estimate(calibration, cell)
    except Degenerate as error:
        reasons = "; ".join([str(error), *words_for(rejected)])
        raise DegenerateCaptures(f"the captures do not determine the transforms: {reasons}") from error
    before = mismatch_of(verification, cell, cell.nominal.T_P_A, cell.nominal.T_H_E)
    after = mismatch_of(verification, cell, found.T_P_A, found.T_H_E)
    verdict, reason = judge(after, cell.procedure.verification.limit)
    return Result(
        method="paper",
        T_P_A=found.T_P_A,
        T_H_E=found.T_H_E,
        optical_axis=found.optical_axis,
        unobservable=tuple(Unobservable(**asdict(direction)) for direction in found.unobservable),
        iterations=tuple(_iteration_record(iteration) for iteration in found.iterations),
        mismatch_before=mismatch_record(before),
        mismatch_after=mismatch_record(after),
        captures_used=tuple(capture.id for capture in calibration),
        captures_rejected=rejected,
        verdict=verdict,
        reasons=(reason, *found.warnings, *words_for(rejected)),
    )


def _active_joints(captures: Sequence[CaptureRecord]) -> dict[tuple[Use, str], Array]:
    """Where the active arm stood for most captures of each constraint, (n,) rad: the median of each joint."""
    joints: dict[tuple[Use, str], list[Joints]] = {}
    for capture in captures:
        joints.setdefault((capture.use, capture.constraint), []).append(capture.active_joints)
    return {constraint: np.median(angles, axis=0) for constraint, angles in joints.items()}


def _sort_out(captures: Sequence[CaptureRecord], cell: CellConfig) -> tuple[list[CaptureRecord], tuple[Rejected, ...]]:
    calibrated = CalibratedPlaces.of(captures)
    stands = _active_joints(captures)
    used, rejected = [], []
    thinned: set[tuple[Use, str]] = set()
    for capture in captures:
        away = np.array(capture.active_joints) - stands[capture.use, capture.constraint]
        moved = float(np.max(np.abs(np.angle(np.exp(1j * away)))))  # whole turns are the same place
        offset = np.abs(np.array(capture.feature) - cell.camera.intrinsics.principal_point)
        if np.any(offset > FARTHEST_ALIGNED):
            reason = f"not aligned: the feature point is {offset[0]:.2f} and {offset[1]:.2f} px off the optical axis"
        elif moved > FARTHEST_ARRIVED:
            degrees = np.rad2deg(moved)
            reason = f"the active arm stands {degrees:.2f} deg from where the others of {capture.constraint} have it"
        elif capture.use == "verification" and calibrated.has(capture):
            reason = calibrated.reason(capture)
        else:
            used.append(capture)
            continue
        rejected.append(Rejected(capture.id, reason))
        thinned.add((capture.use, capture.constraint))
    left = Counter((capture.use, capture.constraint) for capture in used)
    kept = []
    for capture in used:
        place = capture.use, capture.constraint
        if capture.use == "calibration" and place in thinned and left[place] < FEWEST_POSITIONS:
            rejected.append(
                Rejected(capture.id, f"only {left[place]} usable positions are left of {capture.constraint}")
            )
        else:
            kept.append(capture)
    return kept, tuple(rejected)


def _estimate(captures: Sequence[CaptureRecord], cell: CellConfig) -> Estimate:
    T_A_H, T_P_T = poses(captures, cell)
    constraints = [capture.constraint for capture in captures]
    return estimate(T_A_H, T_P_T, constraints, cell.nominal.T_P_A, cell.nominal.T_H_E)


def _iteration_record(iteration: Iteration) -> dict[str, float | list[float]]:
    return {
        "rotation_update": iteration.rotation_update,
        "axis_update": iteration.axis_update,
        "rotation_error": iteration.rotation_error.tolist(),
        "optical_axis_in_active_flange": iteration.optical_axis.tolist(),
    }
