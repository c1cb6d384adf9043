"""Meshes: read from a file, and kept clear of by a grid of distances."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from dualcal_hal.geometry.distance import length
from dualcal_hal.geometry.placement import largest_motion
from dualcal_hal.geometry.solids import Solid
from dualcal_hal.transforms import Array

FINEST_VOXEL = 0.005
"""Side (m) of a voxel; larger where a mesh would fill more than MOST_VOXELS."""

MOST_VOXELS = 1_000_000

_SPACING = 0.02  # m between the points of a segment at which the grid is looked up


@dataclass(frozen=True, eq=False)
class Mesh(Solid):
    """A surface of triangles, what it encloses included; ``corners``: (t, 3, 3) m.

    Distances are understated by at most two and a half voxels and half the spacing of the points on a segment,
    23 mm for meshes of up to half a metre.
    """

    corners: Array

    def separation(self, segments: Array, pivot: Array, translation: float, rotation: float) -> Array:
        longest = float(length(segments[..., 1, :] - segments[..., 0, :]).max())
        count = 2 + int(longest / _SPACING)
        fractions = np.linspace(0.0, 1.0, count)[:, None]
        points = segments[..., :1, :] + fractions * (segments[..., 1:, :] - segments[..., :1, :])
        moved = largest_motion(segments - pivot, translation, rotation).max(axis=-1)
        return np.asarray(self._grid.distance(points).min(axis=-1) - longest / (count - 1) / 2 - moved)

    def away(self, points: Array) -> Array:
        # Not more than what is told of a segment through them.
        return np.asarray(self._grid.distance(points) - 2.5 * self._grid.voxel - _SPACING / 2)

    @cached_property
    def _grid(self) -> _Grid:
        return _Grid.about(self.corners)


@dataclass(frozen=True, eq=False)
class _Grid:
    """Distances (x, y, z) in m from the centres of voxels to the nearest voxel's that the solid touches."""

    low: Array
    voxel: float
    distances: Array

    @staticmethod
    def about(corners: Array) -> _Grid:
        from scipy.ndimage import binary_fill_holes, distance_transform_edt

        low, high = corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)
        voxel = max(FINEST_VOXEL, float(np.cbrt(np.prod(high - low + FINEST_VOXEL) / MOST_VOXELS)))
        touched = np.zeros(2 + ((high - low) / voxel).astype(int), dtype=bool)
        low = low - voxel / 2
        reach = voxel / 3
        points = _scattered(corners, reach)
        # Every point of the surface is within `reach` of one of these, so these corners meet each voxel it crosses.
        for offset in np.ndindex(2, 2, 2):
            index = ((points + (2 * np.array(offset) - 1) * reach - low) / voxel).astype(int)
            touched[tuple(index.T)] = True
        distances = distance_transform_edt(~np.asarray(binary_fill_holes(touched))) * voxel
        return _Grid(low, voxel, np.asarray(distances))

    def distance(self, points: Array) -> Array:
        """At most the distance (...) in m from points (..., 3) to the solid.

        A point outside the grid is at least as far as its nearest point on the grid and that one's distance at a
        right angle.
        """
        size = np.array(self.distances.shape)
        inside = np.clip(points, self.low, self.low + size * self.voxel)
        index = np.minimum(((inside - self.low) / self.voxel).astype(int), size - 1)
        centre = self.low + (index + 0.5) * self.voxel
        to_touched = self.distances[tuple(np.moveaxis(index, -1, 0))] - length(inside - centre)
        within = np.maximum(to_touched - self.voxel * np.sqrt(0.75), 0.0)
        return np.asarray(np.hypot(within, length(points - inside)))


def read_mesh(path: Path, scale: float) -> Array:
    """Triangles (t, 3, 3) in m of an STL or OBJ file whose unit is ``scale`` metres.

    Raises ValueError with the reason for a file that cannot be read or holds none.
    """
    import coal

    if path.suffix.lower() not in (".stl", ".obj"):
        raise ValueError("must be an STL or OBJ file")
    try:
        path.open("rb").close()
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror}") from error
    try:
        model = coal.MeshLoader(coal.BV_OBBRSS).load(str(path), np.full(3, scale))
    except ValueError as error:
        raise ValueError("holds no mesh that can be read") from error
    faces = [[model.tri_indices(i)[corner] for corner in range(3)] for i in range(model.num_tris)]
    return np.asarray(np.asarray(model.vertices())[np.array(faces)])


def _scattered(corners: Array, reach: float) -> Array:
    """Points (n, 3) on triangles (t, 3, 3) such that each point of them is within ``reach`` of one."""
    longest = length(corners - np.roll(corners, 1, axis=1)).max(axis=1)
    # No point of a triangle is further from the nearest corner than the longest side over the root of three.
    counts = 1 + np.ceil(longest / (reach * np.sqrt(3.0))).astype(int)
    counts = np.maximum(counts, 2)
    points = []
    for count in np.unique(counts):
        i, j = np.triu_indices(count)
        weights = np.stack([i, j - i, count - 1 - j], axis=1) / (count - 1)
        points.append((weights @ corners[counts == count]).reshape(-1, 3))
    return np.concatenate(points)
