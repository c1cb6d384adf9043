"""The target on the passive arm."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, ValidationInfo, field_validator

from dualcal_hal.config.values import AtLeast3, Natural, NotNegative, Positive, Section
from dualcal_hal.target import Checkerboard


class TargetConfig(Section):
    """The checkerboard on the passive arm."""

    kind: Literal["checkerboard"]
    """The pattern."""
    corners: tuple[AtLeast3, AtLeast3]
    """Rows and columns of inner corners, at least 3 each: with fewer no detector works."""
    square_mm: Positive
    """Side of a square, mm."""
    feature_corner: tuple[Natural, Natural] | None = Field(default=None, validate_default=True)
    """Row and column of the feature point, from 0; the middlemost corner where left out and there is one."""
    margin_mm: NotNegative = 10.0
    """Width of the plate beyond the outer squares, mm."""

    @field_validator("feature_corner")
    @classmethod
    def _is_on_board(cls, value: tuple[int, int] | None, info: ValidationInfo) -> Any:
        corners = info.data.get("corners")
        if corners is None:
            return value
        rows, columns = corners
        if value is None and (rows % 2 == 0 or columns % 2 == 0):
            raise ValueError(f"missing key: {rows} x {columns} corners have no middlemost one")
        if value is not None and (value[0] >= rows or value[1] >= columns):
            raise ValueError(f"is outside rows 0 to {rows - 1} and columns 0 to {columns - 1}")
        return value

    @property
    def board(self) -> Checkerboard:
        rows, columns = self.corners
        row, column = self.feature_corner or (rows // 2, columns // 2)
        return Checkerboard(rows, columns, self.square_mm / 1000, row * columns + column)

    @property
    def margin(self) -> float:
        """Metres."""
        return self.margin_mm / 1000
