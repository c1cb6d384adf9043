"""What the operator knows before the calibration."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from dualcal_hal.config.values import NotNegative, Section, TransformConfig
from dualcal_hal.geometry import Placement
from dualcal_hal.transforms import Array


class TransformsConfig(Section):
    """Where the bases stand to each other and the camera to its flange."""

    active_base_in_passive_base: TransformConfig
    """T_P_A."""
    camera_in_active_flange: TransformConfig
    """T_H_E; the camera's frame has z out of the lens, x right, y down."""

    @property
    def T_P_A(self) -> Array:
        """(4, 4), m."""
        return self.active_base_in_passive_base.T

    @property
    def T_H_E(self) -> Array:
        """(4, 4), m."""
        return self.camera_in_active_flange.T


class UncertaintyConfig(Section):
    """How wrong the nominal position of the bases to each other may be, at most."""

    translation_mm: NotNegative
    """Length of the translation's error, mm."""
    rotation_deg: Annotated[NotNegative, Field(le=180)]
    """Angle of the rotation's error, degrees; 180 where nothing is known of it."""

    @property
    def translation(self) -> float:
        """Metres."""
        return self.translation_mm / 1000

    @property
    def rotation(self) -> float:
        """Radians."""
        return float(np.radians(self.rotation_deg))


class NominalConfig(TransformsConfig):
    """What the operator knows before the calibration."""

    uncertainty: UncertaintyConfig = UncertaintyConfig(translation_mm=120.0, rotation_deg=12.0)
    """Of active_base_in_passive_base: paths before the first look are clear whatever the error within it. Must be given
    on a cell that is not simulated."""

    @property
    def placement(self) -> Placement:
        """The active base in the passive one, with its uncertainty."""
        return Placement(self.T_P_A, self.uncertainty.translation, self.uncertainty.rotation)
