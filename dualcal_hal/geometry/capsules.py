"""The arms' shapes as capsules: segments with a radius.

The link of a Denavit-Hartenberg row runs along the joint's axis by ``d`` and from there to the next frame's origin;
the camera is a capsule behind the lens, the plate of the target a row of thin capsules.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualcal_hal.kinematics import Chain
from dualcal_hal.transforms import Array, apply, inverse, transform

SHORTEST_LINK = 0.01
"""Offsets below this length (m) are covered by the neighbours' round ends."""

PLATE_THICKNESS = 0.01
"""m; the pattern is on the front."""

PLATE_RADIUS = 0.015
"""Radius (m) of the capsules that cover the target's plate."""

_WIDEST_STRIP = 0.025  # m of the plate's height that one capsule covers


@dataclass(frozen=True, eq=False)
class Capsules:
    """Capsules fixed to frames of a chain.

    frame: (c,) index of the frame (0 base, n flange); ends: (c, 2, 3) in that frame, m; radius: (c,) m.
    """

    frame: NDArray[np.int64]
    ends: Array
    radius: Array

    def __len__(self) -> int:
        return len(self.radius)

    def joined(self, other: Capsules) -> Capsules:
        """These, then the others."""
        return Capsules(
            np.concatenate([self.frame, other.frame]),
            np.concatenate([self.ends, other.ends]),
            np.concatenate([self.radius, other.radius]),
        )


def link_capsules(chain: Chain, radii: ArrayLike) -> Capsules:
    """The links of a chain; ``radii``: (n,) m, one a row."""
    frame, ends, radius = [], [], []
    for i, (row, r) in enumerate(zip(chain.rows, np.asarray(radii, dtype=float), strict=True)):
        along_axis = np.array([0.0, 0.0, row.d])
        if abs(row.d) > SHORTEST_LINK:
            frame.append(i)
            ends.append([np.zeros(3), along_axis])
            radius.append(r)
        if abs(row.a) > SHORTEST_LINK:
            start = apply(inverse(row.after_joint()), along_axis[None])[0]
            frame.append(i + 1)
            ends.append([start, np.zeros(3)])
            radius.append(r)
    return Capsules(np.array(frame, dtype=np.int64), np.array(ends).reshape(-1, 2, 3), np.array(radius))


def camera_capsule(flange: int, T_H_E: Array, radius: float, length: float) -> Capsules:
    """The camera's housing: from one radius behind the lens backwards by ``length``, on frame number ``flange``."""
    back = np.array([[0.0, 0.0, -radius], [0.0, 0.0, -radius - length]])
    return Capsules(np.array([flange]), apply(T_H_E, back)[None], np.array([radius]))


def camera_box(radius: float, length: float) -> tuple[Array, Array]:
    """The housing as the square box that its capsule just holds: sizes (3,) in m, and its centre's T_E_box."""
    side = radius * np.sqrt(2.0)
    return np.array([side, side, length]), transform(np.eye(3), [0.0, 0.0, -radius - length / 2])


def plate_capsules(flange: int, T_F_T: Array, outline: Array) -> Capsules:
    """Capsules that contain a rectangular plate; ``outline``: (4, 3) its corners in T, on frame number ``flange``."""
    (width, height, thickness), T_T_box = plate_box(outline)
    count = int(np.ceil(height / _WIDEST_STRIP))
    strip = height / count
    # The corner of each strip lies on the round end of its capsule.
    inset = np.sqrt(PLATE_RADIUS**2 - (thickness / 2) ** 2 - (strip / 2) ** 2)
    reach = max(width / 2 - inset, 0.0)
    levels = (np.arange(count) + 0.5) * strip - height / 2
    ends = np.array([[[-reach, y, 0.0], [reach, y, 0.0]] for y in levels])
    placed = apply(T_F_T @ T_T_box, ends.reshape(-1, 3)).reshape(ends.shape)
    return Capsules(np.full(count, flange), placed, np.full(count, PLATE_RADIUS))


def plate_box(outline: Array) -> tuple[Array, Array]:
    """The plate as a box behind the pattern: sizes (3,) in m, and its centre's T_T_box."""
    low, high = outline.min(axis=0), outline.max(axis=0)
    sizes = np.array([*(high - low)[:2], PLATE_THICKNESS])
    middle = (low + high) / 2
    return sizes, transform(np.eye(3), [*middle[:2], -PLATE_THICKNESS / 2])
