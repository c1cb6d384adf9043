"""The target's surface as it is: printed to a wrong scale, on a plate that is bent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from backends.simulator.pattern import Values
from dualcal_hal.transforms import Array

if TYPE_CHECKING:
    from dualcal_hal.config.image_errors import ImageErrorsConfig
    from dualcal_hal.target import Target

_ITERATIONS = 3  # each takes away all but a few percent; a bow of 1 mm seen at 45 degrees is off by 1e-3 px then


@dataclass(frozen=True)
class Surface:
    """A bowl z = ``curvature`` (x^2 + y^2) in T, in 1/m, whose print is larger by ``scale`` along x and y."""

    scale: tuple[float, float]
    curvature: float

    @classmethod
    def of(cls, board: Target, errors: ImageErrorsConfig) -> Surface:
        """The surface of a ``board`` of the cell file."""
        width, height = np.ptp(board.outline[:, :2], axis=0).tolist()
        return cls(errors.square_scale.factors, errors.flatness.bow / ((width**2 + height**2) / 4))

    def points(self, nominal: Array) -> Array:
        """Where points (n, 3) of the target in T truly are, (n, 3) m."""
        x, y = (nominal[:, :2] * self.scale).T
        return np.stack([x, y, nominal[:, 2] + self.curvature * (x * x + y * y)], axis=1)

    def printed(self, x: Values, y: Values, viewpoint: Array, reach: float) -> tuple[Values, Values]:
        """What is printed where the lines of sight through (x, y, 0) meet the surface: its nominal (x, y), in m.

        ``viewpoint``: (3,) the camera in T; beyond ``reach`` m from the middle the surface goes on level.
        """
        if self.curvature:
            x, y = self._met(x, y, viewpoint, reach)
        scale_x, scale_y = self.scale
        return (x / scale_x, y / scale_y) if self.scale != (1.0, 1.0) else (x, y)

    def _met(self, x: Values, y: Values, viewpoint: Array, reach: float) -> tuple[Values, Values]:
        eye_x, eye_y, eye_z = viewpoint.tolist()
        towards_x, towards_y = (eye_x - x) / eye_z, (eye_y - y) / eye_z
        met_x, met_y = x, y
        for _ in range(_ITERATIONS):
            height = self.curvature * np.minimum(met_x * met_x + met_y * met_y, reach**2)
            met_x, met_y = x + height * towards_x, y + height * towards_y
        return met_x, met_y
