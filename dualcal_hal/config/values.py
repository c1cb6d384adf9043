"""What sections are made of: numbers, ranges and rigid transforms."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    model_validator,
)

from dualcal_hal.transforms import (
    Array,
    is_rotation,
    nearest_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    transform,
)

Number = Annotated[float, Strict()]
Positive = Annotated[Number, Field(gt=0)]
NotNegative = Annotated[Number, Field(ge=0)]
PartsPerMillion = Annotated[Number, Field(ge=-1e5, le=1e5)]


def _whole(value: Any) -> Any:
    return int(value) if isinstance(value, float) and value.is_integer() else value


# The bound comes before the validator: behind it, pydantic would write it into the schema by a wrong name.
Natural = Annotated[int, Strict(), Field(ge=0), BeforeValidator(_whole)]
AtLeast1 = Annotated[int, Strict(), Field(ge=1), BeforeValidator(_whole)]
AtLeast3 = Annotated[int, Strict(), Field(ge=3), BeforeValidator(_whole)]
Vector = tuple[Number, Number, Number]
Vector4 = tuple[Number, Number, Number, Number]
Matrix3 = tuple[Vector, Vector, Vector]
Matrix4 = tuple[Vector4, Vector4, Vector4, Vector4]


class Section(BaseModel):
    """A mapping of the cell file; it forbids unknown keys and numbers that are not finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


def _ascending(pair: tuple[float, float]) -> tuple[float, float]:
    if not pair[0] < pair[1]:
        raise ValueError(f"the lower value {pair[0]:g} must be below the upper one {pair[1]:g}")
    return pair


Range = Annotated[tuple[Number, Number], AfterValidator(_ascending)]


def _rotation(matrix: Matrix3) -> Matrix3:
    _require_rotation(np.array(matrix))
    return matrix


def _rigid(matrix: Matrix4) -> Matrix4:
    _require_rotation(np.array(matrix)[:3, :3])
    if matrix[3] != (0.0, 0.0, 0.0, 1.0):
        raise ValueError("is no rigid transform: its last row must be 0 0 0 1")
    return matrix


def _require_rotation(R: Array) -> None:
    if not is_rotation(R):
        raise ValueError("is no rotation: its columns must be orthonormal and right-handed to 1e-6")


def _unit(quaternion: Vector4) -> Vector4:
    if abs(np.linalg.norm(quaternion) - 1.0) > 1e-6:
        raise ValueError("is no rotation: a quaternion must have length 1 to 1e-6")
    return quaternion


def _number_or_auto(value: Any, handler: ValidatorFunctionWrapHandler) -> Any:
    # The union's own errors would name a branch for each alternative.
    try:
        return handler(value)
    except ValidationError:
        raise ValueError(f"must be a number greater than 0, or auto, not {value!r}") from None


Tolerance = Annotated[Positive | Literal["auto"], WrapValidator(_number_or_auto)]


class TransformConfig(Section):
    """A rigid transform: `translation_mm` and one form of rotation, or `matrix` alone."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [
                {"required": ["translation_mm", "rotation_vector_deg"]},
                {"required": ["translation_mm", "quaternion_xyzw"]},
                {"required": ["translation_mm", "rotation_matrix"]},
                {"required": ["matrix"]},
            ]
        }
    )

    translation_mm: Vector | None = None
    """Origin of the one frame in the other, mm."""
    rotation_vector_deg: Vector | None = None
    """Axis times angle, degrees."""
    quaternion_xyzw: Annotated[Vector4, AfterValidator(_unit)] | None = None
    """Unit quaternion (x, y, z, w)."""
    rotation_matrix: Annotated[Matrix3, AfterValidator(_rotation)] | None = None
    """Three rows of the rotation matrix."""
    matrix: Annotated[Matrix4, AfterValidator(_rigid)] | None = None
    """Four rows of the homogeneous matrix, translation in m, as in result.json."""

    @model_validator(mode="after")
    def _has_one_form(self) -> Self:
        rotations = [self.rotation_vector_deg, self.quaternion_xyzw, self.rotation_matrix]
        given = sum(rotation is not None for rotation in rotations)
        one_form = given == 1 and self.translation_mm is not None
        if self.matrix is not None:
            one_form = given == 0 and self.translation_mm is None
        if not one_form:
            raise ValueError(
                "must have translation_mm and one of rotation_vector_deg, quaternion_xyzw, "
                "rotation_matrix; or matrix alone"
            )
        return self

    @property
    def T(self) -> Array:
        """(4, 4), m; its rotation is the nearest exact one."""
        if self.matrix is not None:
            matrix = np.array(self.matrix)
            return transform(nearest_rotation(matrix[:3, :3]), matrix[:3, 3])
        return transform(self._R, np.array(self.translation_mm) / 1000)

    @property
    def _R(self) -> Array:
        if self.rotation_vector_deg is not None:
            return rotation_from_vector(np.radians(self.rotation_vector_deg))
        if self.quaternion_xyzw is not None:
            return rotation_from_quaternion(self.quaternion_xyzw)
        return nearest_rotation(np.array(self.rotation_matrix))
