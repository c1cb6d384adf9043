"""The target's corners in an image, in the board's order, or the reason why not."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np

from dualcal_hal.camera import Image
from dualcal_hal.errors import UsageError
from dualcal_hal.target import Charuco, Checkerboard, Target
from dualcal_hal.transforms import Array
from procedures.detection.charuco import CharucoFinder
from procedures.detection.checkerboard import CheckerboardFinder
from procedures.detection.corners import inside, spacing
from procedures.detection.exposure import raise_blur, raise_light_problem
from procedures.detection.outcome import Detection, Faint, Miss, Missed, Refused, Region

_ROOM = 2.5
"""Squares around the predicted corners that are searched first: what the prediction may be off, and a rim."""
_SMALLEST_REGION = 40  # px
_STRIDE = 4  # px; a sixteenth of the pixels tells how bright a part of the image is


class Finder(Protocol):
    """How one kind of target is found."""

    def searches(self, size: tuple[int, int], near: Region | None, step: float) -> Iterator[tuple[Region, int]]:
        """Regions to search, each with the scale for it, the quickest first.

        size: of the image; near: where the target is expected, with ``step`` px between its corners, or None.
        """

    def find(self, image: Image, region: Region, scale: int, predicted: Array | None) -> Detection:
        """The target within the region; raises Refused if there is none, or none that is usable."""


class Detector:
    """Finds one target in images of one size, (width, height) px. It keeps nothing from image to image."""

    def __init__(self, target: Target, size: tuple[int, int]) -> None:
        self.target = target
        self.size = size
        self._finder = _finder_of(target)

    def detect(self, image: Image, predicted: Array | None = None) -> Detection | Missed:
        """The target's corners in a grey ``image`` (height, width).

        predicted: (n, 2) px where the corners are expected, in the board's order (a projection, or the corners
        of the frame before). The target is searched around it first, then in the whole image, so its position may be
        off by any amount. Of a checkerboard the prediction's shape decides among the orders in which it looks alike;
        its roll may be off by up to about 35 deg. Raises UsageError for an image of another size or type, or a
        prediction of another shape.
        """
        self._check(image, predicted)
        near = None if predicted is None else self._around(predicted)
        step = 0.0 if predicted is None else self._step(predicted)
        refused = Refused(Miss.NOT_FOUND, "")
        for region, scale in self._finder.searches(self.size, near, step):
            try:
                return self._finder.find(image, region, scale, predicted)
            except Refused as then:
                # What is cut by the region's edge, or too small at this scale, may yet be found.
                refused = _more_telling(refused, then)
        missed = refused.missed
        return missed if missed.reason is not Miss.NOT_FOUND else self._explained(image, near, predicted, refused)

    def _check(self, image: Image, predicted: Array | None) -> None:
        if image.shape != self.size[::-1] or image.dtype != np.uint8:
            raise UsageError(
                f"expected a grey 8-bit image of {self.size[0]} x {self.size[1]} px,"
                f" got {image.dtype} of shape {image.shape}"
            )
        n = self.target.rows * self.target.columns
        if predicted is not None and (predicted.shape != (n, 2) or not np.all(np.isfinite(predicted))):
            raise UsageError(f"expected finite predictions of {n} corners, got shape {predicted.shape}")

    def _step(self, predicted: Array) -> float:
        """About how far in px the corners are from each other, and the pattern's rim from the outer ones."""
        return spacing(predicted.reshape(self.target.rows, self.target.columns, 2))

    def _is_well_inside(self, predicted: Array) -> bool:
        """Whether the board's rim is expected in the image too."""
        return bool(np.all(inside(predicted, self.size, self._step(predicted))))

    def _around(self, predicted: Array) -> Region | None:
        """The part of the image where the target should be; None if that is outside."""
        room = _ROOM * self._step(predicted)
        x0, y0 = (int(edge) for edge in np.clip(predicted.min(axis=0) - room, 0, self.size))
        x1, y1 = (int(edge) for edge in np.clip(predicted.max(axis=0) + room, 0, self.size))
        return (x0, y0, x1, y1) if min(x1 - x0, y1 - y0) >= _SMALLEST_REGION else None

    def _explained(self, image: Image, near: Region | None, predicted: Array | None, refused: Refused) -> Missed:
        """The reason, as far as the grey values and the prediction tell more than that there is no target."""
        x0, y0, x1, y1 = near or (0, 0, *self.size)
        try:
            raise_light_problem(image[y0:y1:_STRIDE, x0:x1:_STRIDE])
            if near is not None:
                raise_blur(image[y0:y1, x0:x1])
        except Refused as explained:
            return explained.missed
        missed, cut = refused.missed, predicted is not None and not self._is_well_inside(predicted)
        if cut and not isinstance(refused, Faint):
            return Missed(
                Miss.AT_BORDER,
                f"{missed.detail}, and part of it was expected outside the image;"
                " bring the target nearer to the middle of the image",
            )
        return missed


def _finder_of(target: Target) -> Finder:
    match target:
        case Charuco():
            return CharucoFinder(target)
        case Checkerboard():
            return CheckerboardFinder(target)
    raise UsageError(f"no detector for a {type(target).__name__}")


def _more_telling(first: Refused, then: Refused) -> Refused:
    """Of two refusals of one image the later one, unless it says less."""
    return first if then.missed.reason is Miss.NOT_FOUND and first.missed.detail else then
