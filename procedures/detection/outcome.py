"""What comes of looking for a target in an image."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualcal_hal.session.plain import Fields, expect, finites
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


def found_to_record(found: Detection | Missed) -> dict[str, Any]:
    """What came of looking for a target, as plain JSON."""
    if isinstance(found, Missed):
        return {"missed": str(found.reason), "detail": found.detail}
    return {
        "corners_px": corners_to_record(found.corners),
        "order_known": found.order_known,
        "blur_px": found.blur,
        "contrast": found.contrast,
        "feature_index": found.feature_index,
    }


def found_from_record(record: dict[str, Any], corners: int) -> Detection | Missed:
    """And back, to the last bit; ValueError for what is none of a target with so many corners."""
    fields = Fields(record, "the detection")
    if "missed" in fields:
        return Missed(Miss(fields.text("missed")), fields.text("detail"))
    index = fields.whole("feature_index")
    if index >= corners:
        raise ValueError(f"feature_index: there are {corners} corners")
    return Detection(
        corners_from_record(fields.any("corners_px"), corners),
        fields.flag("order_known"),
        fields.finite("blur_px"),
        fields.finite("contrast"),
        index,
    )


def corners_to_record(corners: Array) -> tuple[tuple[float, float] | None, ...]:
    """Corners (n, 2) px as they are recorded: None for one that was not seen."""
    return tuple((float(u), float(v)) if np.isfinite(u) else None for u, v in corners)


def corners_from_record(record: Any, count: int | None = None) -> Array:
    """And back: (n, 2) px, NaN for one that was not seen; ValueError for anything else, or not ``count`` of them."""
    pixels = expect(record, list, "corners_px")
    if not pixels or len(pixels) != (count or len(pixels)):
        raise ValueError(f"corners_px: {len(pixels)} corners where there are {count or 'some'}")
    unseen = (np.nan, np.nan)
    return np.array([unseen if each is None else finites(each, "corners_px", 2) for each in pixels], dtype=float)
