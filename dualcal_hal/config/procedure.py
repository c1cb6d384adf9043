"""How poses are chosen, aligned and estimated from."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, ValidationInfo, field_validator

from dualcal_hal.config.values import (
    AtLeast1,
    AtLeast3,
    Natural,
    NotNegative,
    Number,
    Positive,
    Range,
    Section,
    Tolerance,
    Vector,
)
from dualcal_hal.transforms import Array

METHODS = ("refined", "paper")
"""The estimators a cell file may name."""

FEWEST_FOR_PAPER = 3
"""Positions of a constraint that the paper's line fit needs."""


class RegionConfig(Section):
    """A box in the passive base."""

    low_mm: Vector
    """Its lowest corner, mm."""
    high_mm: Vector
    """Its highest corner, mm."""

    @field_validator("high_mm")
    @classmethod
    def _is_above(cls, value: tuple[float, float, float], info: ValidationInfo) -> tuple[float, float, float]:
        for axis, low, high in zip("xyz", info.data.get("low_mm", value), value, strict=True):
            if high < low:
                raise ValueError(f"{axis}: {high:g} is below low_mm, {low:g}")
        return value

    @property
    def corners(self) -> Array:
        """(2, 3) m: lowest and highest."""
        return np.array([self.low_mm, self.high_mm]) / 1000


class VerificationConfig(Section):
    """The poses that prove the result; the estimate does not use them."""

    constraints: Natural = 6
    """How many directions of the optical axis; 0 leaves the result unverified. An arrival of the active arm is worth
    about one independent look, however many positions it has."""
    positions: AtLeast1 = 2
    """How many positions of the feature point on each axis."""
    limit_mm: Positive = 0.5
    """Method paper: the largest mean mismatch that passes, mm."""
    required_accuracy_mm: Positive | None = None
    """Method refined: what the predicted 3D error (95 %) may be all over the region, mm; 1 where left out, which only
    a cell that is simulated may."""
    region: RegionConfig | None = None
    """Method refined: where the accuracy is required; where left out the box of the verification points, and without
    these that of the points calibrated with."""

    @property
    def limit(self) -> float:
        """Metres."""
        return self.limit_mm / 1000


def _known_method(value: str) -> str:
    if value not in METHODS:
        raise ValueError(f"unknown method '{value}'; there are: {', '.join(METHODS)}")
    return value


def _none_or_three(value: int) -> int:
    if value not in (0, *range(3, value + 1)):
        raise ValueError(f"must be 0 or at least 3, not {value}")
    return value


def _above_zero(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] <= 0:
        raise ValueError(f"must be greater than 0, not {value[0]:g}")
    return value


Looks = Annotated[Natural, AfterValidator(_none_or_three)]
Distances = Annotated[Range, AfterValidator(_above_zero)]
Tilt = Annotated[Number, Field(gt=0, lt=90)]


class StandOffConfig(Section):
    """Joint angles of both arms for the first look, one entry a joint."""

    active_deg: tuple[Number, ...]
    """Of the arm with the camera, degrees."""
    passive_deg: tuple[Number, ...]
    """Of the arm with the target, degrees."""

    @property
    def active(self) -> Array:
        """(n,) rad."""
        return np.radians(self.active_deg)

    @property
    def passive(self) -> Array:
        """(n,) rad."""
        return np.radians(self.passive_deg)


class ProcedureConfig(Section):
    """How poses are chosen, aligned and estimated from."""

    seed: Natural
    """Of the choice of poses."""
    method: Annotated[str, AfterValidator(_known_method), Field(json_schema_extra={"enum": list(METHODS)})] = "paper"
    """The estimator: refined uses all corners and says what the result is worth; paper is the two steps of the paper,
    and what a file means that names none."""
    constraints: AtLeast3
    """How many directions of the optical axis."""
    positions: AtLeast1
    """How many positions of the feature point on each axis; method paper needs 3."""
    first_looks: Looks = 5
    """How many images to plan from, at least 3; 0 plans from the nominal transforms, on simulated cells only."""
    stand_off: StandOffConfig | None = None
    """Where the first look is taken from; found where left out."""
    distance_mm: Distances
    """Smallest and largest distance between camera and feature point, mm."""
    tilt_max_deg: Tilt
    """Largest angle between the target's normal and the optical axis, degrees."""
    tolerance_px: Tolerance
    """Largest offset of an aligned feature point in each axis, px; auto follows the scatter of arrivals."""
    clearance_mm: NotNegative = 20.0
    """Smallest distance kept between arms, camera, target and floor, mm."""
    knowns: Literal["estimate", "propagate"] = "estimate"
    """Method refined: what knowns that carry a sigma are: estimated with it as what is known of them, or left as they
    are and only reckoned with in the result's uncertainty."""
    verification: VerificationConfig = VerificationConfig()
    """The proof."""

    @field_validator("positions")
    @classmethod
    def _enough_for_a_line(cls, value: int, info: ValidationInfo) -> int:
        if info.data.get("method") == "paper" and value < FEWEST_FOR_PAPER:
            raise ValueError(f"must be at least {FEWEST_FOR_PAPER} for method paper, which fits a line, not {value}")
        return value

    @property
    def distance(self) -> tuple[float, float]:
        """Metres."""
        return self.distance_mm[0] / 1000, self.distance_mm[1] / 1000

    @property
    def tilt_max(self) -> float:
        """Radians."""
        return float(np.radians(self.tilt_max_deg))

    @property
    def clearance(self) -> float:
        """Metres."""
        return self.clearance_mm / 1000
