"""What a refined result is worth, as ``result.json`` has it: the keys ``accuracy`` and ``verification``.

Fields are named as in the file, unit included.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

ORDER = tuple(
    f"{transform}: {what} {axis}"
    for transform in ("active_base_in_passive_base", "camera_in_active_flange")
    for what in ("translation", "rotation")
    for axis in "xyz"
)
"""Of the twelve numbers of the error."""

ERROR = "log(estimate^-1 truth) of each transform, in its child frame; translation in m, rotation in rad"
"""What the covariance is of."""

Finite = Annotated[float, Field(allow_inf_nan=False)]
Point = tuple[Finite, Finite, Finite]


class Record(BaseModel):
    """A part of the file; keys of later versions are passed over."""

    model_config = ConfigDict(frozen=True, extra="ignore", use_attribute_docstrings=True)


class DirectionRecord(Record):
    """One of the twelve directions."""

    name: str
    sigma_mm: Finite | None = None
    """1 sigma of a translation."""
    sigma_deg: Finite | None = None
    """1 sigma of a rotation."""
    observable: bool
    """Whether that is below the limit."""


class LimitsRecord(Record):
    """Sigmas above which a direction counts as not observable."""

    translation_mm: Finite
    rotation_deg: Finite


class SpreadRecord(Record):
    """What one input brings into the result: root sums over three axes, 1 sigma, and the predicted 3D error (rms) that
    it makes in the middle of the region.
    """

    input: str
    base_translation_mm: Finite
    base_rotation_deg: Finite
    camera_translation_mm: Finite
    camera_rotation_deg: Finite
    error_mm: Finite


class NoiseRecord(Record):
    """1 sigma of a corner in each axis, and of the joints of both arms."""

    pixel_px: Finite
    active_joint_mrad: Finite
    passive_joint_mrad: Finite


class FoundSigmaRecord(Record):
    """A sigma found from the captures: the most likely value, in the unit of its name, and its 95 % interval, of which
    only the upper end counts where it is not identified.
    """

    name: str
    value: Finite
    lower: Finite
    upper: Finite
    identified: bool


class FitRecord(Record):
    """How the captures fit: squares in units of the noise reckoned with, and scale, by how much they exceed it where
    that cannot be chance (the covariance is then that of the noise they show).
    """

    chi_square: Finite
    degrees_of_freedom: int
    between_arrivals: Finite
    between_arrivals_degrees_of_freedom: int
    scale: Finite


class CaptureFitRecord(Record):
    """One capture that was estimated from: its squared distance from where the others put it, in units of sigma, and
    the residual of each corner, in units of the pixel sigma, None for one not seen.
    """

    id: str
    chi_square: Finite
    degrees_of_freedom: Finite
    residuals_sigma: tuple[tuple[Finite, Finite] | None, ...]
    turned: bool
    """Whether its corners were taken from the other end."""


class AlternativeRecord(Record):
    """Another optimum, m, and its cost over the best one's."""

    active_base_in_passive_base: tuple[tuple[Finite, ...], ...]
    camera_in_active_flange: tuple[tuple[Finite, ...], ...]
    cost_ratio: Finite


class KnownRecord(Record):
    """A known that is not exact: by how much it was found off, in ``unit``, its sigma before (None where it was free)
    and after, and whether the captures see it at all.
    """

    name: str
    unit: str
    value: Finite
    prior_sigma: Finite | None
    sigma: Finite
    seen: bool


class HiddenRecord(Record):
    """What no capture can show, and what an error of so much does to a point of the region, mm."""

    what: str
    by: str
    error_mm: Finite


class RegionRecord(Record):
    """A box in the passive base."""

    low_mm: Point
    high_mm: Point


class MapRecord(Record):
    """Predicted 3D error over the shared workspace: at points of the passive base, 1 sigma (rms) and 95 %."""

    points_mm: tuple[Point, ...]
    rms_mm: tuple[Finite, ...]
    p95_mm: tuple[Finite, ...]


class Error3dRecord(Record):
    """Predicted distance between where a point is and where the result puts it."""

    region: RegionRecord
    rms_mm: Finite
    """The largest in the region, 1 sigma."""
    p95_mm: Finite
    """The largest in the region, 95 %."""
    required_mm: Finite
    map: MapRecord


class Accuracy(Record):
    """The key ``accuracy``: what the estimate is worth, by itself."""

    order: tuple[str, ...] = ORDER
    error: str = ERROR
    covariance: tuple[tuple[Finite, ...], ...]
    """12 x 12; of what, and in which order, say the keys above."""
    directions: tuple[DirectionRecord, ...]
    limits: LimitsRecord
    would_help: tuple[str, ...]
    """Which captures, or known measured better, would make the directions seen that are not observable."""
    condition: Finite | None
    """Of the whitened problem, None where it is infinite."""
    budget: tuple[SpreadRecord, ...]
    noise: NoiseRecord
    """Reckoned with."""
    stated_noise: NoiseRecord
    """Of the cell file."""
    found_noise: tuple[FoundSigmaRecord, ...] | None
    fit: FitRecord
    captures: tuple[CaptureFitRecord, ...]
    alternatives: tuple[AlternativeRecord, ...]
    knowns: tuple[KnownRecord, ...]
    cannot_be_seen: tuple[HiddenRecord, ...]
    error_3d: Error3dRecord


class VerifiedCaptureRecord(Record):
    """One verification capture: squares of what is between it and its prediction, in units of all uncertainty."""

    id: str
    chi_square: Finite
    degrees_of_freedom: Finite


class PartRecord(Record):
    """Squares in units of all uncertainty, and the probability of as many or more by chance: the chi-square
    distribution's beyond it.
    """

    chi_square: Finite
    degrees_of_freedom: int
    probability: Finite


class Verification(Record):
    """The key ``verification``: whether the other captures are as predicted, by two chi-squares with all uncertainty.
    Both parts are None in files of before they were told apart.
    """

    poses: PartRecord | None = None
    """How far the boards are from where they are predicted."""
    corners: PartRecord | None = None
    """How far the corners are from one board each, wherever that is."""
    probability: Finite
    """That either part is as large or larger by chance: twice the smaller of both probabilities (Bonferroni), at most
    1; that of the one part where the other has no degrees of freedom."""
    least_probability: Finite
    """Below it the result fails, or is coarse where one cell fits these captures with those of the calibration."""
    arrivals: int | None = None
    """Of the active arm, at which the captures were taken."""
    captures: tuple[VerifiedCaptureRecord, ...]
    look_at: tuple[str, ...]
    """What to look at next, in this order, where it fails."""
