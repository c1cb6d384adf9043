"""Shapes of the arms as capsules, and how far they stay clear of each other, of themselves and of the floor.

A capsule is a segment with a radius. The link of a Denavit-Hartenberg row runs along the joint's axis by
``d`` and from there to the next frame's origin; the camera is a capsule behind the lens, the plate of the
target a row of thin capsules. Metres and radians.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.kinematics import Chain
from dualcal_hal.transforms import Array, apply, inverse

if TYPE_CHECKING:
    from dualcal_hal.config import CellConfig

SHORTEST_LINK = 0.01
"""Offsets below this length (m) are covered by the neighbours' round ends."""

PLATE_RADIUS = 0.015
"""Radius (m) of the capsules that cover the target's plate."""

LARGEST_STEP = 0.05
"""Joint step (rad) between two checks along a path; overestimates clearance by at most 1.3 mm on arms of 0.8 m."""


@dataclass(frozen=True, eq=False)
class Capsules:
    """Capsules fixed to frames of a chain.

    frame: (c,) index of the frame (0 base, n flange); ends: (c, 2, 3) in that frame, m; radius: (c,) m.
    """

    frame: np.ndarray[tuple[int], np.dtype[np.int64]]
    ends: Array
    radius: Array

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
    return Capsules(np.array(frame), np.array(ends), np.array(radius))


def camera_capsule(flange: int, T_H_E: Array, radius: float, length: float) -> Capsules:
    """The camera's housing: from one radius behind the lens backwards by ``length``, on frame number ``flange``."""
    back = np.array([[0.0, 0.0, -radius], [0.0, 0.0, -radius - length]])
    return Capsules(np.array([flange]), apply(T_H_E, back)[None], np.array([radius]))


def plate_capsules(flange: int, T_F_T: Array, outline: Array) -> Capsules:
    """Capsules that cover a rectangular plate; ``outline``: (4, 3) its corners in T, on frame number ``flange``."""
    low, high = outline.min(axis=0), outline.max(axis=0)
    width, height = (high - low)[:2]
    count = max(2, int(np.ceil(height / (2 * PLATE_RADIUS))))
    inset = min(PLATE_RADIUS, height / 2)
    levels = np.linspace(low[1] + inset, high[1] - inset, count)
    reach = max(width / 2 - PLATE_RADIUS, 0.0)
    middle = (low[0] + high[0]) / 2
    ends = np.array([[[middle - reach, y, 0.0], [middle + reach, y, 0.0]] for y in levels])
    return Capsules(
        np.full(count, flange), apply(T_F_T, ends.reshape(-1, 3)).reshape(-1, 2, 3), np.full(count, PLATE_RADIUS)
    )


class ArmBody:
    """An arm with what it carries, to be placed at joint angles."""

    def __init__(self, chain: Chain, links: Capsules, tool: Capsules, floor: float | None) -> None:
        self.chain = chain
        self.capsules = links.joined(tool)
        self._floor = floor
        self._above_floor = np.flatnonzero(self.capsules.frame >= 2)
        self._pairs = _own_pairs(chain, links, tool)

    def segments(self, q: ArrayLike) -> Array:
        """Joint angles (k, n) to the capsules' ends in the arm's base, (k, c, 2, 3)."""
        frames = self.chain.frames(q)[:, self.capsules.frame]
        ends = self.capsules.ends
        turned = np.einsum("kcij,cej->kcei", frames[..., :3, :3], ends)
        return np.asarray(turned + frames[..., None, :3, 3])

    def own_clearance(self, q: ArrayLike) -> Array:
        """Least distance (k,) in m to the floor and between parts of the arm that may meet; inf if there are none."""
        q = np.atleast_2d(np.asarray(q, dtype=float))
        segments, radius = self.segments(q), self.capsules.radius
        least = np.full(len(q), np.inf)
        if self._floor is not None:
            heights = segments[..., 2][:, self._above_floor].min(axis=2) - radius[self._above_floor]
            least = np.minimum(least, heights.min(axis=1) - self._floor)
        if len(self._pairs):
            first, second = self._pairs.T
            distance = segment_distance(segments[:, first], segments[:, second]) - radius[first] - radius[second]
            least = np.minimum(least, distance.min(axis=1))
        return np.asarray(least)


@dataclass(frozen=True, eq=False)
class Placement:
    """Where the active arm's base stands in the passive one's, ``T_P_A`` (4, 4), and how wrong that may be.

    The error is T_true = T_P_A exp(xi): its parts are at most ``translation`` (m) and ``rotation`` (rad), turning
    about the active base's origin.
    """

    T_P_A: Array
    translation: float = 0.0
    rotation: float = 0.0


@dataclass(frozen=True, eq=False)
class CellGeometry:
    """Both arms' bodies."""

    active: ArmBody
    passive: ArmBody

    @staticmethod
    def of(cell: CellConfig) -> CellGeometry:
        """The arms of a cell file with camera and plate.

        The camera's housing stands where the nominal hand-eye transform says: that is known to a centimetre, and what
        a few pictures say of it is not better at first.
        """
        active, passive, board = cell.active, cell.passive, cell.target.board
        rim = np.sign(board.outline - board.outline.mean(axis=0)) * cell.target.margin
        body = cell.camera.body_radius, cell.camera.body_length
        housing = camera_capsule(active.chain.joints, cell.nominal.T_H_E, *body)
        plate = plate_capsules(passive.chain.joints, passive.target_mount_transform, board.outline + rim)
        return CellGeometry(
            ArmBody(active.chain, link_capsules(active.chain, active.link_radius), housing, cell.floor),
            ArmBody(passive.chain, link_capsules(passive.chain, passive.link_radius), plate, cell.floor),
        )

    def between(self, q_a: ArrayLike, q_p: ArrayLike, placement: Placement) -> Array:
        """Least distance (k,) in m between the arms at joint angles (k, n) or (1, n), whatever the bases' error."""
        active = self.active.segments(np.atleast_2d(np.asarray(q_a, dtype=float)))
        passive = self.passive.segments(np.atleast_2d(np.asarray(q_p, dtype=float)))
        reach = np.linalg.norm(active, axis=3).max(axis=2)
        active = apply(placement.T_P_A, active.reshape(-1, 3)).reshape(active.shape)
        distance = segment_distance(active[:, :, None], passive[:, None])
        moved = placement.translation + 2 * np.sin(placement.rotation / 2) * reach
        radii = self.active.capsules.radius[:, None] + self.passive.capsules.radius
        return np.asarray((distance - radii - moved[:, :, None]).min(axis=(1, 2)))

    def clearance(self, q_a: ArrayLike, q_p: ArrayLike, placement: Placement) -> Array:
        """Least of all distances (k,) in m: between the arms, to the floor, of each arm to itself."""
        own = np.minimum(self.active.own_clearance(q_a), self.passive.own_clearance(q_p))
        return np.minimum(self.between(q_a, q_p, placement), own)


def segment_distance(first: Array, second: Array) -> Array:
    """Distance between segments (..., 2, 3), broadcast (C. Ericson, Real-Time Collision Detection, 5.1.9)."""
    d1 = first[..., 1, :] - first[..., 0, :]
    d2 = second[..., 1, :] - second[..., 0, :]
    r = first[..., 0, :] - second[..., 0, :]
    a, e = _dot(d1, d1), _dot(d2, d2)
    b, c, f = _dot(d1, d2), _dot(d1, r), _dot(d2, r)
    tiny = 1e-12
    determinant = a * e - b * b
    s = np.where(determinant > tiny * np.maximum(a * e, tiny), (b * f - c * e) / np.maximum(determinant, 1e-30), 0.0)
    s = np.clip(s, 0.0, 1.0)
    t = np.where(e > tiny, (b * s + f) / np.maximum(e, 1e-30), 0.0)
    t = np.clip(t, 0.0, 1.0)
    s = np.where(a > tiny, np.clip((b * t - c) / np.maximum(a, 1e-30), 0.0, 1.0), 0.0)
    gap = r + s[..., None] * d1 - t[..., None] * d2
    return np.asarray(np.sqrt(_dot(gap, gap)))


def interpolate(waypoints: ArrayLike, largest_step: float = LARGEST_STEP) -> Array:
    """Joint waypoints (w, n) to samples (k, n) on the straight segments, no joint stepping further than told (rad)."""
    points = np.atleast_2d(np.asarray(waypoints, dtype=float))
    samples = [points[:1]]
    for start, end in itertools.pairwise(points):
        count = max(1, int(np.ceil(np.max(np.abs(end - start)) / largest_step)))
        samples.append(start + (end - start) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(samples)


def _dot(u: Array, v: Array) -> Array:
    return np.asarray(np.einsum("...i,...i->...", u, v))


def _own_pairs(chain: Chain, links: Capsules, tool: Capsules) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
    """Pairs of an arm's capsules that can meet: those with more between them than their own radii fill.

    Neighbours along the chain always touch; so do parts with only a short link between them. The tool counts as
    the end of the chain.
    """
    lengths = np.linalg.norm(links.ends[:, 1] - links.ends[:, 0], axis=1)
    count = len(lengths)
    pairs = []
    for i in range(count):
        for j in range(i + 2, count + len(tool.radius)):
            last = min(j, count)
            radius_j = links.radius[j] if j < count else tool.radius[j - count]
            between = lengths[i + 1 : last].sum()
            if between > 1.5 * (links.radius[i] + radius_j):
                pairs.append((i, j))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)
