"""``result.json`` of a cell with one arm: the public format ``dualcal.one-arm-result/1``.

Fields are named as in the file, unit included.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import ValidationError

from dualcal_hal.errors import FormatError, Problem
from dualcal_hal.session.accuracy import (
    DirectionRecord,
    Finite,
    FoundSigmaRecord,
    HiddenRecord,
    KnownRecord,
    LimitsRecord,
    Record,
)
from dualcal_hal.session.files import read_document, write_document
from dualcal_hal.session.result import Rejected, Verdict, transform_document
from dualcal_hal.transforms import Array, rotation_angle

FORMAT: Literal["dualcal.one-arm-result/1"] = "dualcal.one-arm-result/1"

ERROR = "log(estimate^-1 truth) of each transform, in its child frame; translation in m, rotation in rad"
"""What the covariance is of."""

Matrix = tuple[tuple[Finite, Finite, Finite, Finite], ...]
Corner = tuple[Finite, Finite]


class TransformRecord(Record):
    """A transform, the same in several forms."""

    matrix: Matrix
    """4 x 4, m."""
    translation_mm: tuple[Finite, Finite, Finite]
    quaternion_xyzw: tuple[Finite, Finite, Finite, Finite]
    rotation_vector_deg: tuple[Finite, Finite, Finite]

    @staticmethod
    def of(T: Array) -> TransformRecord:
        return TransformRecord.model_validate(transform_document(T))

    @property
    def T(self) -> Array:
        """(4, 4), m."""
        return np.array(self.matrix)


class CovarianceRecord(Record):
    """Of camera and target together."""

    order: tuple[str, ...]
    error: str = ERROR
    matrix: tuple[tuple[Finite, ...], ...]
    """12 x 12; of what, and in which order, say the keys above."""


class OneArmNoiseRecord(Record):
    """1 sigma of a corner in each axis, and of the joints."""

    pixel_px: Finite
    joint_mrad: Finite


class OneArmFitRecord(Record):
    """How the views fit: squares in units of the noise reckoned with, the probability of as large ones, of corners and
    of the arm, or larger, scale, by how much they exceed it where that cannot be chance, and the rms of all corners
    with the arm as it was read.
    """

    chi_square: Finite
    degrees_of_freedom: int
    probability: Finite
    scale: Finite
    rms_px: Finite


class PredictedErrorRecord(Record):
    """Predicted distance between where a point is and where the result puts it, 1 sigma (rms) and 95 %."""

    rms_mm: Finite
    p95_mm: Finite


class PredictedRecord(Record):
    """Predicted errors: of the camera's own position, and the largest of points where the camera saw the target."""

    camera: PredictedErrorRecord
    at_target: PredictedErrorRecord
    required_mm: Finite
    """Of the latter, 95 %."""


class OffRecord(Record):
    """How far corners are from where they are predicted: rms, px in each axis, and mm at the target."""

    rms_px: Finite
    rms_mm: Finite


class OneArmViewRecord(Record):
    """A view that was estimated from. left_out: by an estimate without it; chi_square: its squared distance from where
    the others put it, in units of sigma, None for a view that was dropped. rms_px and left_out are None where the
    target should be behind the camera.
    """

    id: str
    used: bool
    turned: bool = False
    """Whether its corners, whose order is not known, were taken to be listed from the other end."""
    rms_px: Finite | None
    left_out: OffRecord | None
    chi_square: Finite | None
    degrees_of_freedom: Finite | None
    residuals_px: tuple[Corner | None, ...]
    """Of each corner, found minus seen, with the arm as it was read; None for one not seen."""


class VerifiedViewRecord(Record):
    """A view that was not estimated from: how far it is from its prediction, and that in units of all uncertainty.

    off is None where the target should be behind the camera; chi_square where that is so of any view.
    """

    id: str
    off: OffRecord | None
    chi_square: Finite | None
    degrees_of_freedom: Finite
    residuals_px: tuple[Corner | None, ...]


class OneArmVerificationRecord(Record):
    """Whether the other views are as predicted, by a chi-square with all uncertainty.

    Where the target should be behind the camera at any of them there is no nominal or no found, and chi_square is the
    largest number that a file has.
    """

    nominal: OffRecord | None
    """With the nominal transforms."""
    found: OffRecord | None
    chi_square: Finite
    degrees_of_freedom: int
    probability: Finite
    """Of as large a value or a larger one, were all as reckoned with."""
    least_probability: Finite
    """Below it the result fails."""
    views: tuple[VerifiedViewRecord, ...]


class TransformErrorRecord(Record):
    """Against a known truth."""

    rotation_deg: Finite
    translation_mm: Finite


class OneArmResult(Record):
    """One analysis of the views of one arm."""

    format: Literal["dualcal.one-arm-result/1"] = FORMAT
    method: Literal["refined"] = "refined"
    placement: Literal["eye-in-hand", "eye-to-hand"]
    transforms: dict[str, TransformRecord]
    """The camera's, then the target's, by their names in the cell file."""
    truth_error: dict[str, TransformErrorRecord] | None = None
    covariance: CovarianceRecord
    directions: tuple[DirectionRecord, ...]
    limits: LimitsRecord
    condition: Finite | None
    """Of the whitened problem, None where it is infinite."""
    noise: OneArmNoiseRecord
    """Reckoned with."""
    stated_noise: OneArmNoiseRecord
    """Of the cell file."""
    found_noise: tuple[FoundSigmaRecord, ...] | None
    fit: OneArmFitRecord
    predicted_error: PredictedRecord
    cannot_be_seen: tuple[HiddenRecord, ...] = ()
    """What no view can show, and what it does to a point."""
    left_out: OffRecord | None
    """Over all used views, each predicted by an estimate without it; None where that has the target behind the camera.
    """
    views: tuple[OneArmViewRecord, ...]
    verification: OneArmVerificationRecord | None
    knowns: tuple[KnownRecord, ...]
    captures_used: tuple[str, ...]
    captures_rejected: tuple[Rejected, ...]
    verdict: Verdict
    reasons: tuple[str, ...]

    def to_document(self) -> dict[str, Any]:
        """The public document."""
        return self.model_dump(mode="json")


def write_one_arm_result(path: Path, result: OneArmResult) -> None:
    """Write the public file atomically."""
    write_document(path, result.to_document())


def read_one_arm_result(path: Path) -> OneArmResult:
    """Read the public file; FormatError if it is not one, of another version or incomplete."""
    document = read_document(path, FORMAT)
    try:
        return OneArmResult.model_validate(document)
    except ValidationError as error:
        problems = [
            Problem(str(path), f"is not a result: {'.'.join(map(str, each['loc']))}: {each['msg']}")
            for each in error.errors()
        ]
        raise FormatError(problems) from error


def with_errors_against(result: OneArmResult, truth: Mapping[str, Array]) -> OneArmResult:
    """The same result with its error against true transforms (4, 4), m, by their names in the file."""
    errors = {}
    for name, found in result.transforms.items():
        T, true = found.T, truth[name]
        errors[name] = TransformErrorRecord(
            rotation_deg=float(np.degrees(rotation_angle(T[:3, :3], true[:3, :3]))),
            translation_mm=1e3 * float(np.linalg.norm(T[:3, 3] - true[:3, 3])),
        )
    return result.model_copy(update={"truth_error": errors})
