"""Whether the grey values where the target should be let it be seen at all."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dualcal_hal.camera import Image
from dualcal_hal.transforms import Array
from procedures.detection.corners import BLUR_LIMIT, CONTRAST_LIMIT
from procedures.detection.outcome import Faint, Miss, Refused

BRIGHTEST = 250
"""Grey level from which on a pixel counts as saturated."""
MOST_SATURATED = 0.6
"""Share of saturated pixels; a board's white squares are half of it."""
DARKEST = 40.0
"""Grey level that the brightest twentieth exceeds where there is light enough."""
_SMOOTHING = 2.0  # px, sigma, that keeps the noise out of the steepest slope


def raise_light_problem(values: NDArray[np.uint8]) -> None:
    """Refused if the grey ``values`` (any shape) of where the target should be are all too bright or too dark."""
    saturated = float(np.mean(values >= BRIGHTEST))
    if saturated > MOST_SATURATED:
        raise Refused(
            Miss.SATURATED,
            f"{100 * saturated:.0f} % of the pixels where the target should be are saturated;"
            " shorten the exposure or remove the glare",
        )
    bright = float(np.percentile(values, 95))
    if bright < DARKEST:
        raise Refused(
            Miss.TOO_DARK,
            f"where the target should be there is hardly a pixel above {bright:.0f} of 255 grey levels;"
            " lengthen the exposure or give more light",
        )


def raise_if_faint(contrast: float) -> None:
    """Faint if the white and black of a candidate differ by fewer grey levels than corners need."""
    if contrast < CONTRAST_LIMIT:
        raise Faint(
            Miss.NOT_FOUND,
            f"the squares of the candidate differ by {contrast:.0f} grey levels, {CONTRAST_LIMIT:g} at least;"
            " give it more light, or more exposure",
        )


def raise_blur(part: Image) -> None:
    """Refused if a part of the image that should show the target has bright and dark but no sharp edge between."""
    smooth = cv2.GaussianBlur(part.astype(np.float32), (0, 0), _SMOOTHING, borderType=cv2.BORDER_REPLICATE)
    height = float(np.subtract(*np.percentile(smooth, [95, 5])))
    if height < CONTRAST_LIMIT:
        return
    slope = float(np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)).max()) / 8
    sigma = height / (np.sqrt(2 * np.pi) * slope)
    if sigma > np.hypot(BLUR_LIMIT, _SMOOTHING):
        raise Refused(Miss.BLURRED, "there is no sharp edge where the target should be; focus the camera")


def around(image: Image, places: Array, radius: float) -> NDArray[np.uint8]:
    """The grey values of squares about ``places`` (n, 2) px in the image, (n, k, k)."""
    offsets = np.arange(-int(radius) - 1, int(radius) + 2)
    centres = np.rint(places).astype(int)
    v = np.clip(centres[:, 1, None] + offsets, 0, image.shape[0] - 1)
    u = np.clip(centres[:, 0, None] + offsets, 0, image.shape[1] - 1)
    return np.asarray(image[v[:, :, None], u[:, None, :]])
