"""What comes of looking for a target in an image."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from dualcal_hal.transforms import Array

Region = tuple[int, int, int, int]
"""Part of an image: left, top, and the first px right of it and below it."""


class Miss(StrEnum):
    """Why there is no detection, or not a usable one."""

    NOT_FOUND = "not found"
    AT_BORDER = "at the border"
    BLURRED = "blurred"
    SATURATED = "saturated"
    TOO_DARK = "too dark"
    OCCLUDED = "occluded"
    AMBIGUOUS_ORDER = "ambiguous order"


@dataclass(frozen=True)
class Missed:
    """An expected outcome: no usable corners in this image, with what the operator can do about it in ``detail``."""

    reason: Miss
    detail: str

    def __str__(self) -> str:
        return f"{self.reason}: {self.detail}"


class Refused(Exception):
    """A candidate is not the target, or not usable."""

    def __init__(self, reason: Miss, detail: str) -> None:
        self.missed = Missed(reason, detail)


class Faint(Refused):
    """A candidate lies like the target, but its black and white are hardly different."""


@dataclass(frozen=True, eq=False)
class Detection:
    """corners: (n, 2) px in the distorted image, in the board's order, NaN where one was not seen; order_known:
    whether this order could be told from the others in which the target looks alike; blur: Gaussian sigma of the
    edges, px; contrast: of the weakest corner, grey levels; feature_index: of the feature point."""

    corners: Array
    order_known: bool
    blur: float
    contrast: float
    feature_index: int

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(n,): which corners were seen."""
        return np.asarray(np.isfinite(self.corners[:, 0]))

    @property
    def feature(self) -> Array:
        """(2,) px: the feature point, NaN if it was not seen."""
        return np.asarray(self.corners[self.feature_index])
