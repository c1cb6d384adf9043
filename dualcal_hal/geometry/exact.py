"""The cell in its true shapes, by the collision library coal: the final check on what the capsules have allowed."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.geometry.body import ArmBody
from dualcal_hal.geometry.capsules import Capsules, camera_box, plate_box
from dualcal_hal.geometry.cell import CellGeometry
from dualcal_hal.geometry.distance import length, unit
from dualcal_hal.geometry.mesh import Mesh
from dualcal_hal.geometry.solids import Block, Cylinder, Solid
from dualcal_hal.transforms import Array, smallest_rotation, transform

if TYPE_CHECKING:
    from dualcal_hal.config import CellConfig


@dataclass(frozen=True, eq=False)
class _Part:
    """A shape of coal's at ``T`` (4, 4) in frame number ``frame`` of its arm."""

    frame: int
    shape: Any
    T: Array


@dataclass(frozen=True, eq=False)
class _Placed:
    """A shape of coal's where it stands in the cell."""

    frame: int
    shape: Any
    place: Any

    def distance(self, other: _Placed) -> float:
        """m; below zero where they overlap."""
        import coal

        request, result = coal.DistanceRequest(), coal.DistanceResult()
        return float(coal.distance(self.shape, self.place, other.shape, other.place, request, result))


class _ExactArm:
    """An arm's links as capsules, what it carries as a box, and what stands about its base."""

    def __init__(self, body: ArmBody, sizes: Array, T_flange_box: Array) -> None:
        import coal

        self._chain = body.chain
        self._parts = [*_links(body.links), _Part(body.chain.joints, coal.Box(sizes), T_flange_box)]
        self._fixtures = [_Part(0, _shape(fixture.solid), fixture.T) for fixture in body.fixtures]
        floor = [] if body.floor is None else [transform(np.eye(3), [0.0, 0.0, body.floor])]
        self._floor = [_Part(0, _half_space(), T) for T in floor]
        parts = [(int(i), min(int(j), len(body.links))) for i, j in body.pairs]
        self.relief = dict(zip(parts, body.relief.tolist(), strict=True))

    def parts(self, q: ArrayLike, T_base: Array) -> list[_Placed]:
        """The arm at joint angles (n,) with its base at ``T_base`` (4, 4)."""
        return _placed(self._parts, T_base @ self._chain.frames(q))

    def fixtures(self, T_base: Array) -> list[_Placed]:
        return _placed(self._fixtures, T_base[None])

    def floor(self, T_base: Array) -> list[_Placed]:
        return _placed(self._floor, T_base[None])


@dataclass(frozen=True, eq=False)
class ExactCell:
    """Both arms with links as capsules, camera housing and target's plate as boxes, and fixtures as they are.

    The capsules of :class:`CellGeometry` contain these shapes, so what is clear there is clear here; the same parts
    are held against each other.
    """

    _active: _ExactArm
    _passive: _ExactArm

    @staticmethod
    def of(cell: CellConfig, T_H_E: Array | None = None) -> ExactCell:
        """The arms of a cell file, the camera at ``T_H_E`` (4, 4) or where the nominal one says."""
        T_H_E = cell.nominal.T_H_E if T_H_E is None else T_H_E
        geometry = CellGeometry.of(cell, T_H_E)
        camera, T_E_box = camera_box(cell.camera.body_radius, cell.camera.body_length)
        plate, T_T_box = plate_box(cell.target.plate_outline)
        return ExactCell(
            _ExactArm(geometry.active, camera, T_H_E @ T_E_box),
            _ExactArm(geometry.passive, plate, cell.passive.target_mount_transform @ T_T_box),
        )

    def clearance(self, q_a: ArrayLike, q_p: ArrayLike, T_P_A: Array) -> float:
        """Least of all distances in m at joint angles (n,) with the bases at ``T_P_A``; below zero where two overlap.

        A part that is wholly inside a mesh is as far from it as from its surface. Parts of one arm have their relief.
        """
        return float(np.min(self.clearances(q_a, q_p, T_P_A), initial=np.inf))

    def clearances(self, q_a: ArrayLike, q_p: ArrayLike, T_P_A: Array) -> Array:
        """The same of each two that are held against each other, (p,), in the same order for all postures."""
        return np.array([a.distance(b) + relief for a, b, relief in self._neighbours(q_a, q_p, T_P_A)])

    def _neighbours(self, q_a: ArrayLike, q_p: ArrayLike, T_P_A: Array) -> Iterator[tuple[_Placed, _Placed, float]]:
        """All that must not come close to each other, and the relief."""
        active, passive = (self._active, T_P_A), (self._passive, np.eye(4))
        parts_a, parts_p = self._active.parts(q_a, T_P_A), self._passive.parts(q_p, np.eye(4))
        yield from itertools.product(parts_a, parts_p, [0.0])
        for parts, (arm, T_base), (other, T_other) in ((parts_a, active, passive), (parts_p, passive, active)):
            moving = [part for part in parts if part.frame >= 1]
            above_floor = [part for part in parts if part.frame >= 2]
            yield from ((parts[i], parts[j], relief) for (i, j), relief in arm.relief.items())
            yield from itertools.product(moving, arm.fixtures(T_base), [0.0])
            yield from itertools.product(above_floor, [*arm.floor(T_base), *other.fixtures(T_other)], [0.0])


def _placed(parts: list[_Part], frames: Array) -> list[_Placed]:
    import coal

    placed = []
    for part in parts:
        T = frames[part.frame] @ part.T
        placed.append(_Placed(part.frame, part.shape, coal.Transform3s(T[:3, :3], T[:3, 3])))
    return placed


def _links(capsules: Capsules) -> list[_Part]:
    import coal

    along = capsules.ends[:, 1] - capsules.ends[:, 0]
    return [
        _Part(
            int(frame),
            coal.Capsule(radius, size),
            transform(smallest_rotation([0.0, 0.0, 1.0], axis), ends.mean(axis=0)),
        )
        for frame, ends, radius, size, axis in zip(
            capsules.frame, capsules.ends, capsules.radius, length(along), unit(along), strict=True
        )
    ]


def _shape(solid: Solid) -> Any:
    import coal

    if isinstance(solid, Block):
        return coal.Box(solid.sizes)
    if isinstance(solid, Cylinder):
        return coal.Cylinder(solid.radius, solid.length)
    return _triangles(solid) if isinstance(solid, Mesh) else _half_space()


def _half_space() -> Any:
    import coal

    return coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)


@lru_cache(maxsize=16)  # a mesh is the same for every belief
def _triangles(mesh: Mesh) -> Any:
    import coal

    model = coal.BVHModelOBBRSS()
    model.beginModel(len(mesh.corners), 3 * len(mesh.corners))
    for triangle in mesh.corners:
        model.addTriangle(*triangle)
    model.endModel()
    return model
