"""What the refined estimate works on: captures as arrays, what is known of the cell, and the noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualcal_hal.transforms import Array, Mask
from procedures.estimation.refined.arms import Arm

Indices = NDArray[np.intp]


@dataclass(frozen=True)
class CaptureArrays:
    """k captures of a target with n corners.

    active (k, na), passive (k, np): joint angles as read, rad; arrivals (k,): captures with one number share one
    arrival of the active arm; pixels (k, n, 2): measured corners in the distorted image, NaN for one not seen;
    order_known (k,): False where the corners may as well be listed from the other end; None: all are known;
    board_poses: T_E_T of each capture, (4, 4) or its candidates (c, 4, 4), or None; None: none are known.
    weights (k, 2n, 2n): what the errors of the pixels, counted in sigmas, are multiplied with; None: with nothing.
    """

    active: Array
    passive: Array
    arrivals: Indices
    pixels: Array
    order_known: Mask | None = None
    board_poses: Sequence[ArrayLike | None] | None = None
    weights: Array | None = None

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def order(self) -> Mask:
        """(k,) order_known in full."""
        return np.ones(len(self), dtype=bool) if self.order_known is None else np.asarray(self.order_known, dtype=bool)

    def only(self, chosen: Mask) -> CaptureArrays:
        """The captures where ``chosen`` (k,) is True."""
        poses = self.board_poses
        return CaptureArrays(
            active=self.active[chosen],
            passive=self.passive[chosen],
            arrivals=self.arrivals[chosen],
            pixels=self.pixels[chosen],
            order_known=None if self.order_known is None else self.order_known[chosen],
            board_poses=None if poses is None else [pose for pose, kept in zip(poses, chosen, strict=True) if kept],
            weights=None if self.weights is None else self.weights[chosen],
        )

    def followed_by(self, other: CaptureArrays) -> CaptureArrays:
        """With captures of the same board and arms after them, at arrivals of their own."""
        both, n = (self, other), 2 * self.pixels.shape[1]
        apart = int(self.arrivals.max(initial=-1)) - int(other.arrivals.min(initial=0)) + 1
        poses = [[None] * len(each) if each.board_poses is None else each.board_poses for each in both]
        weights = [np.tile(np.eye(n), (len(each), 1, 1)) if each.weights is None else each.weights for each in both]
        return CaptureArrays(
            active=np.concatenate([self.active, other.active]),
            passive=np.concatenate([self.passive, other.passive]),
            arrivals=np.concatenate([self.arrivals, other.arrivals + apart]),
            pixels=np.concatenate([self.pixels, other.pixels]),
            order_known=np.concatenate([self.order, other.order]),
            board_poses=[*poses[0], *poses[1]],
            weights=None if self.weights is None and other.weights is None else np.concatenate(weights),
        )

    def turned(self, flipped: Mask) -> CaptureArrays:
        """With the corners of the captures where ``flipped`` (k,) is True listed from the other end: the board
        looked at upside down.
        """
        pixels = np.where(flipped[:, None, None], self.pixels[:, ::-1], self.pixels)
        return replace(self, pixels=pixels)


@dataclass(frozen=True)
class Words:
    """What messages call the flange that the arrivals are of, and captures."""

    flange: str = "active flange"
    captures: str = "captures"


@dataclass(frozen=True)
class Knowns:
    """Both arms; T_F_T (4, 4): target on the passive flange; corners (n, 3) in T, m; matrix (3, 3), px, and
    distortion (5,) of the camera.
    """

    active: Arm
    passive: Arm
    T_F_T: Array
    corners: Array
    matrix: Array
    distortion: Array
    words: Words = Words()


@dataclass(frozen=True)
class Noise:
    """1 sigma: pixel, px per axis; active and passive joints, rad, by which an arm misses its reading."""

    pixel: float
    active: float
    passive: float

    def __post_init__(self) -> None:
        if not (self.pixel > 0 and self.active >= 0 and self.passive >= 0):
            raise ValueError("the pixel sigma must be positive, the joint sigmas not negative")
