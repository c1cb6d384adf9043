"""What stands about the arms: tables, posts, walls, machines."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, ValidationInfo, model_validator

from dualcal_hal.config.values import Positive, Section, TransformConfig
from dualcal_hal.geometry import Block, Cylinder, HalfSpace, Mesh, Solid, read_mesh
from dualcal_hal.transforms import Array

FOLDER = "folder"
"""Key of the validation's context: the folder that a mesh's file is relative to; where left out the current one."""

MESHES_ARE_READ = "meshes are read"
"""Key of the validation's context: False where nobody needs them."""


class CylinderConfig(Section):
    """A cylinder along z, its middle in the origin."""

    radius: Positive
    """Radius, mm."""
    length: Positive
    """Length, mm."""


class PlaneConfig(Section):
    """Everything with z below 0."""


def _readable(value: str, info: ValidationInfo) -> str:
    context = info.context or {}
    path = Path(context.get(FOLDER, "")).joinpath(value).absolute()
    if context.get(MESHES_ARE_READ, True):
        read_mesh(path, 1.0)
    return str(path)


class MeshConfig(Section):
    """A surface of triangles with what it encloses."""

    file: Annotated[str, AfterValidator(_readable)]
    """STL or OBJ file, absolute or relative to the cell file's folder."""
    scale: Positive = 0.001
    """Metres that a unit of the file stands for."""


class SolidConfig(Section):
    """A solid that stands in the base's frame: one of `box_mm`, `cylinder_mm`, `plane`, `mesh`."""

    model_config = ConfigDict(
        json_schema_extra={"oneOf": [{"required": [shape]} for shape in ("box_mm", "cylinder_mm", "plane", "mesh")]}
    )

    at: TransformConfig
    """The solid's frame in the base's; boxes and cylinders have their middle in its origin."""
    box_mm: tuple[Positive, Positive, Positive] | None = None
    """Sides of a box along x, y, z, mm."""
    cylinder_mm: CylinderConfig | None = None
    """Radius and length of a cylinder along z, mm."""
    plane: PlaneConfig | None = None
    """{} for everything below z = 0."""
    mesh: MeshConfig | None = None
    """A surface of triangles with what it encloses."""

    @model_validator(mode="after")
    def _has_one_shape(self) -> Self:
        if sum(shape is not None for shape in (self.box_mm, self.cylinder_mm, self.plane, self.mesh)) != 1:
            raise ValueError("must have exactly one of box_mm, cylinder_mm, plane, mesh")
        return self

    @property
    def T(self) -> Array:
        """The solid's frame in its base's, (4, 4), m."""
        return self.at.T

    @cached_property
    def solid(self) -> Solid:
        """Its shape, in m; a mesh is read from its file once, ValueError if that can no longer be."""
        if self.box_mm is not None:
            return Block(np.array(self.box_mm) / 1000)
        if self.cylinder_mm is not None:
            return Cylinder(self.cylinder_mm.radius / 1000, self.cylinder_mm.length / 1000)
        if self.mesh is not None:
            return Mesh(read_mesh(Path(self.mesh.file), self.mesh.scale))
        return HalfSpace()


class FixtureConfig(SolidConfig):
    """A solid that stands in one base's frame: one of `box_mm`, `cylinder_mm`, `plane`, `mesh`."""

    base: Annotated[Literal["active_base", "passive_base"], Field(alias="in")]
    """The base in whose frame it stands."""
