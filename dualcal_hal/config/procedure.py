"""How poses are chosen, aligned and estimated from."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field

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
)
from dualcal_hal.transforms import Array

METHODS = ("paper",)
"""The estimators a cell file may name."""


class VerificationConfig(Section):
    """The poses that prove the result; the estimate does not use them."""

    constraints: Natural
    """How many directions of the optical axis; 0 leaves the result unverified."""
    positions: AtLeast1
    """How many positions of the feature point on each axis."""
    limit_mm: Positive
    """Largest mean mismatch that passes, mm."""

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
    method: Annotated[str, AfterValidator(_known_method), Field(json_schema_extra={"enum": list(METHODS)})]
    """The estimator."""
    constraints: AtLeast3
    """How many directions of the optical axis."""
    positions: AtLeast3
    """How many positions of the feature point on each axis."""
    first_looks: Annotated[Natural, AfterValidator(_none_or_three)] = 5
    """How many images to plan from, at least 3; 0 plans from the nominal transforms, on simulated cells only."""
    stand_off: StandOffConfig | None = None
    """Where the first look is taken from; found where left out."""
    distance_mm: Annotated[Range, AfterValidator(_above_zero)]
    """Smallest and largest distance between camera and feature point, mm."""
    tilt_max_deg: Annotated[Number, Field(gt=0, lt=90)]
    """Largest angle between the target's normal and the optical axis, degrees."""
    tolerance_px: Tolerance
    """Largest offset of an aligned feature point in each axis, px; auto follows the scatter of arrivals."""
    clearance_mm: NotNegative = 20.0
    """Smallest distance kept between arms, camera, target and floor, mm."""
    verification: VerificationConfig
    """The proof."""

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
