"""How the target's print, the lens and the light differ from what the cell file says; all are off by default."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from dualcal_hal.config.values import NotNegative, Number, PartsPerMillion, Positive, Section

Share = Annotated[Number, Field(ge=0, le=1)]
Percent = Annotated[Number, Field(ge=0, le=100)]

_NEAREST = 0.1  # m: the blur of a target in the lens, or behind it, has no meaning


class SquareScaleConfig(Section):
    """The pattern is printed too large, about the feature point."""

    x_ppm: PartsPerMillion = 0.0
    """Along the target's x, parts per million; within 100 000."""
    y_ppm: PartsPerMillion = 0.0
    """Along the target's y, parts per million; within 100 000."""

    @property
    def factors(self) -> tuple[float, float]:
        """True length by nominal length along x and y."""
        return 1.0 + self.x_ppm * 1e-6, 1.0 + self.y_ppm * 1e-6


class FlatnessConfig(Section):
    """The plate is a bowl about the feature point, z = bow (r / R)^2, with R half the diagonal of the pattern."""

    bow_mm: Number = 0.0
    """Height of the pattern's outer corners above the feature point, towards the viewer, mm."""

    @property
    def bow(self) -> float:
        """Metres."""
        return self.bow_mm / 1000


class FocalConfig(Section):
    """The focal lengths are longer than the cell file says."""

    x_ppm: PartsPerMillion = 0.0
    """fx, parts per million; within 100 000."""
    y_ppm: PartsPerMillion = 0.0
    """fy, parts per million; within 100 000."""


class PrincipalPointConfig(Section):
    """The optical axis meets the image elsewhere than the cell file says; the lens's distortion goes with it."""

    right_px: Number = 0.0
    """Further to the right, px."""
    down_px: Number = 0.0
    """Further down, px."""


class DistortionResidualConfig(Section):
    """Radial distortion that the cell file's coefficients leave out: it grows with the cube of the distance from the
    axis, as k1 does."""

    corner_px: Number = 0.0
    """Displacement in the farthest corner of the image, outwards, px."""


class CornerBiasConfig(Section):
    """Each pixel passes a share of its light on to its neighbours (smear of charge, a lopsided lens): corners appear
    displaced by as many pixels, the same in the whole image."""

    right_px: Share = 0.0
    """To the right, px."""
    down_px: Share = 0.0
    """Downwards, px."""


class LightingConfig(Section):
    """Uneven or poor light."""

    gradient_percent: Percent = 0.0
    """Brightness lost evenly across the image, from none on the one side to this share on the other, percent."""
    gradient_direction_deg: Number = 0.0
    """Where it gets darker: 0 to the right, 90 downwards, degrees."""
    glare_grey: NotNegative = 0.0
    """A bright blob (a reflection): grey levels of 255 that it adds in its middle; the sensor saturates at 255."""
    glare_position_percent: tuple[Number, Number] = (50.0, 50.0)
    """Its middle, of the image's width and height, percent."""
    glare_radius_percent: Positive = 10.0
    """Its sigma, of the image's width, percent."""
    contrast_loss_percent: Percent = 0.0
    """How far black and white draw near to each other (haze, faded print): 100 leaves one grey, percent."""

    @property
    def gradient_direction(self) -> float:
        """Radians."""
        return float(np.radians(self.gradient_direction_deg))


class DefocusConfig(Section):
    """The lens is focused on one distance; the blur is that of the feature point, for the whole image.

    Nearer than 100 mm it grows no more.
    """

    px_per_dioptre: NotNegative = 0.0
    """Sigma of the blur for each 1/m between the reciprocal distances of the target and of the focus, px m."""
    focus_mm: Positive = 400.0
    """Distance in focus, mm."""

    def sigma(self, distance: float) -> float:
        """Sigma in px at ``distance`` m, in proportion to a thin lens's circle of confusion."""
        return self.px_per_dioptre * abs(1.0 / max(distance, _NEAREST) - 1000.0 / self.focus_mm)


class MotionBlurConfig(Section):
    """The shutter stays open while things move or tremble; the frame's time is that of its opening."""

    exposure_ms: Annotated[Number, Field(ge=0, le=1000)] = 0.0
    """Time of exposure, ms; at most 1000."""

    @property
    def exposure(self) -> float:
        """Seconds."""
        return self.exposure_ms / 1000


class ImageErrorsConfig(Section):
    """What is wrong with the images of the simulated camera."""

    square_scale: SquareScaleConfig = SquareScaleConfig()
    flatness: FlatnessConfig = FlatnessConfig()
    focal: FocalConfig = FocalConfig()
    principal_point: PrincipalPointConfig = PrincipalPointConfig()
    distortion_residual: DistortionResidualConfig = DistortionResidualConfig()
    corner_bias: CornerBiasConfig = CornerBiasConfig()
    lighting: LightingConfig = LightingConfig()
    defocus: DefocusConfig = DefocusConfig()
    motion_blur: MotionBlurConfig = MotionBlurConfig()
