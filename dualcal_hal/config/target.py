"""The target on the passive arm."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from pydantic import ConfigDict, Field, ValidationInfo, field_validator

from dualcal_hal.config.values import AtLeast3, Natural, NotNegative, Positive, Section
from dualcal_hal.target import Charuco, Checkerboard
from dualcal_hal.transforms import Array

Dictionary = Literal[
    "DICT_4X4_50",
    "DICT_4X4_100",
    "DICT_4X4_250",
    "DICT_4X4_1000",
    "DICT_5X5_50",
    "DICT_5X5_100",
    "DICT_5X5_250",
    "DICT_5X5_1000",
    "DICT_6X6_50",
    "DICT_6X6_100",
    "DICT_6X6_250",
    "DICT_6X6_1000",
    "DICT_7X7_50",
    "DICT_7X7_100",
    "DICT_7X7_250",
    "DICT_7X7_1000",
]
_OF_CHARUCO = ("marker_mm", "dictionary")


class TargetConfig(Section):
    """The checkerboard on the passive arm, plain or with a marker in each white square (ChArUco)."""

    model_config = ConfigDict(
        json_schema_extra={
            "if": {"properties": {"kind": {"const": "charuco"}}},
            "then": {"required": list(_OF_CHARUCO)},
            "else": {"properties": {name: False for name in (*_OF_CHARUCO, "legacy")}},
        }
    )

    kind: Literal["checkerboard", "charuco"]
    """The pattern; of charuco a part in view is enough, and its corners are never mistaken for one another."""
    corners: tuple[AtLeast3, AtLeast3]
    """Rows and columns of inner corners, at least 3 each: with fewer no detector works."""
    square_mm: Positive
    """Side of a square, mm."""
    square_sigma_mm: NotNegative = 0.0
    """How exact square_mm is, 1 sigma, common to all squares, mm."""
    feature_corner: tuple[Natural, Natural] | None = Field(default=None, validate_default=True)
    """Row and column of the feature point, from 0; the middlemost corner where left out and there is one."""
    margin_mm: NotNegative = 10.0
    """Width of the plate beyond the outer squares, mm."""
    marker_mm: Positive | None = Field(default=None, validate_default=True)
    """Side of a marker with its black border, mm; charuco alone. At the farthest a bit of it (a sixth of the side with
    a 4X4 dictionary, a ninth with a 7X7 one) must be 2 px wide in a sharp image, 4 px in one blurred by 1.5 px."""
    dictionary: Dictionary | None = Field(default=None, validate_default=True)
    """The markers' dictionary, by OpenCV's name; charuco alone."""
    legacy: bool = False
    """Whether the board was made for OpenCV before 4.6: with an even number of rows of squares white comes first."""

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

    @field_validator(*_OF_CHARUCO)
    @classmethod
    def _belongs_to_charuco(cls, value: Any, info: ValidationInfo) -> Any:
        kind = info.data.get("kind")
        if kind == "charuco" and value is None:
            raise ValueError("missing key: a charuco board's markers have it")
        if kind == "checkerboard" and value is not None:
            raise ValueError("must be left out: a checkerboard has no markers")
        return value

    @field_validator("marker_mm")
    @classmethod
    def _fits_into_square(cls, value: float | None, info: ValidationInfo) -> float | None:
        square = info.data.get("square_mm")
        if value is not None and square is not None and value >= square:
            raise ValueError(f"must be less than square_mm, {square:g}: white is needed around a marker")
        return value

    @field_validator("dictionary")
    @classmethod
    def _has_enough_markers(cls, value: Dictionary | None, info: ValidationInfo) -> Dictionary | None:
        corners = info.data.get("corners")
        if value is not None and corners is not None:
            needed, there = (corners[0] + 1) * (corners[1] + 1) // 2, int(value.rpartition("_")[2])
            if needed > there:
                raise ValueError(f"has {there} markers, the board needs {needed}")
        return value

    @field_validator("legacy")
    @classmethod
    def _is_of_charuco(cls, value: bool, info: ValidationInfo) -> bool:
        if value and info.data.get("kind") == "checkerboard":
            raise ValueError("must be left out: a checkerboard has no markers")
        return value

    @property
    def board(self) -> Checkerboard | Charuco:
        rows, columns = self.corners
        row, column = self.feature_corner or (rows // 2, columns // 2)
        size = rows, columns, self.square_mm / 1000, row * columns + column
        if self.marker_mm is None or self.dictionary is None:
            return Checkerboard(*size)
        white_first = self.legacy and (rows + 1) % 2 == 0
        return Charuco(*size, self.marker_mm / 1000, self.dictionary, white_first)

    @property
    def margin(self) -> float:
        """Metres."""
        return self.margin_mm / 1000

    @property
    def plate_outline(self) -> Array:
        """(4, 3): the corners of the plate's front in T, m."""
        outline = self.board.outline
        return np.asarray(outline + np.sign(outline - outline.mean(axis=0)) * self.margin)
