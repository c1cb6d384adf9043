"""What poor light and a lopsided lens do to an image."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from backends.simulator.pattern import Values

if TYPE_CHECKING:
    from dualcal_hal.config.image_errors import CornerBiasConfig, LightingConfig


class Light:
    """The light on everything in view; ``middle`` is the grey value that a loss of contrast draws all towards."""

    def __init__(self, config: LightingConfig, size: tuple[int, int], middle: float) -> None:
        kept = 1.0 - config.contrast_loss_percent / 100.0
        brightness = _brightness(config, size)
        self._changes_nothing = kept == 1.0 and bool(np.all(brightness == 1.0)) and config.glare_grey == 0.0
        self._gain = np.asarray(kept * brightness, dtype=np.float32)
        self._offset = np.asarray((1.0 - kept) * middle * brightness + _glare(config, size), dtype=np.float32)

    def on(self, image: Values) -> Values:
        """The grey values (height, width) of ``image``, taken in even light, as this light gives them."""
        if self._changes_nothing:
            return image
        return np.asarray(cv2.add(cv2.multiply(image, self._gain), self._offset), dtype=np.float32)


def smeared(image: Values, bias: CornerBiasConfig) -> Values:
    """The image after each pixel has passed on shares of its light to the right and downwards."""
    if bias.right_px == bias.down_px == 0.0:
        return image
    along_u, along_v = (np.array([share, 1.0 - share, 0.0]) for share in (bias.right_px, bias.down_px))
    smeared = cv2.sepFilter2D(image, cv2.CV_32F, along_u, along_v, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(smeared, dtype=np.float32)


def _brightness(config: LightingConfig, size: tuple[int, int]) -> Values:
    """(height, width): 1 on the brightest side."""
    u, v = _grid(size)
    across = np.cos(config.gradient_direction) * u + np.sin(config.gradient_direction) * v
    return np.asarray(1.0 - config.gradient_percent / 100.0 * (across - across.min()) / np.ptp(across))


def _glare(config: LightingConfig, size: tuple[int, int]) -> Values:
    """(height, width) grey levels to add."""
    u, v = _grid(size)
    middle_u, middle_v = np.array(size) * config.glare_position_percent / 100.0
    sigma = size[0] * config.glare_radius_percent / 100.0
    return np.asarray(config.glare_grey * np.exp(-0.5 * ((u - middle_u) ** 2 + (v - middle_v) ** 2) / sigma**2))


def _grid(size: tuple[int, int]) -> tuple[Values, Values]:
    width, height = size
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return u, v
