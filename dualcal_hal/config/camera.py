"""The camera on the active arm."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import AfterValidator

from dualcal_hal.camera import Intrinsics
from dualcal_hal.config.values import AtLeast1, Matrix3, NotNegative, Number, Positive, Section


def _camera_matrix(matrix: Matrix3) -> Matrix3:
    (fx, skew, _), (below_fx, fy, _), last = matrix
    if fx <= 0 or fy <= 0 or skew != 0 or below_fx != 0 or last != (0.0, 0.0, 1.0):
        raise ValueError("is no camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0")
    return matrix


class IntrinsicsSigma(Section):
    """How exact the camera's intrinsics are, 1 sigma each."""

    focal_px: NotNegative = 0.0
    """Of fx and of fy, px."""
    centre_px: NotNegative = 0.0
    """Of cx and of cy, px."""
    distortion: tuple[NotNegative, NotNegative, NotNegative, NotNegative, NotNegative] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """Of k1, k2, p1, p2, k3."""


class CameraBody(Section):
    """A capsule about the camera's optical axis, for clearance."""

    radius_mm: Positive = 35.0
    """Radius, mm."""
    length_mm: NotNegative = 20.0
    """Length between the centres of its ends, mm."""


class CameraConfig(Section):
    """The camera on the active arm, calibrated before."""

    backend: str
    """The entry under backends that grabs its frames."""
    mount: str
    """The arm that carries it: the active one. In a cell of one arm that arm, or fixed: it watches a target on the
    arm."""
    matrix: Annotated[Matrix3, AfterValidator(_camera_matrix)]
    """[[fx, 0, cx], [0, fy, cy], [0, 0, 1]], px; pixel centres are integers."""
    distortion: tuple[Number, Number, Number, Number, Number]
    """OpenCV's k1, k2, p1, p2, k3."""
    intrinsics_sigma: IntrinsicsSigma | None = None
    """How exact matrix and distortion are; exact where left out."""
    size_px: tuple[AtLeast1, AtLeast1]
    """Width and height, px."""
    sigma_px: NotNegative
    """Standard deviation of a detected corner in each axis, px."""
    body: CameraBody = CameraBody()
    """Its housing."""

    @property
    def intrinsics(self) -> Intrinsics:
        return Intrinsics(np.array(self.matrix), np.array(self.distortion), self.size_px)

    @property
    def body_radius(self) -> float:
        """Metres."""
        return self.body.radius_mm / 1000

    @property
    def body_length(self) -> float:
        """Metres."""
        return self.body.length_mm / 1000
