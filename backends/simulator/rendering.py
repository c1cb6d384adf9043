"""The camera's image of the checkerboard, without noise.

Each pixel looks along its undistorted ray at the plane of the board; its grey value is the mean over its area.
"""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from backends.simulator.optics import undistorted_rays
from backends.simulator.pattern import CheckerPattern, Values
from dualcal_hal.camera import Intrinsics
from dualcal_hal.target import Checkerboard
from dualcal_hal.transforms import Array, apply, inverse

WHITE, BLACK = 225.0, 30.0
BACKGROUND = (95.0, 125.0)  # from the top left to the bottom right of the image

Region = tuple[slice, slice]

_COARSE = 8  # px


class Renderer:
    """One camera and one board; ``margin`` in m of white beyond the outer squares, ``blur``: sigma in px.

    Raises UsageError for a distortion that cannot be undone over the whole image.
    """

    def __init__(self, board: Checkerboard, margin: float, intrinsics: Intrinsics, blur: float) -> None:
        self._board = board
        self._pattern = CheckerPattern(board, margin)
        self._margin = margin
        self._intrinsics = intrinsics
        self._blur = blur
        # Single precision: it moves no corner by 1e-4 px, and halves memory and traffic.
        self._rays = undistorted_rays(intrinsics).astype(np.float32)
        self._coarse_rays = self._rays[::_COARSE, ::_COARSE].copy()
        self._coarse_spacing = max(np.abs(np.diff(self._coarse_rays, axis=axis)).max() for axis in (0, 1))

    def render(self, T_E_T: Array) -> Values:
        """(height, width) grey values for the board at ``T_E_T`` (4, 4); only its front is drawn."""
        image = self._background.copy()
        plate_in_camera = apply(T_E_T, self._plate)
        faces_camera = inverse(T_E_T)[2, 3] > 0
        farthest = float(plate_in_camera[:, 2].max())
        if faces_camera and farthest > 0:
            region = self._region(plate_in_camera)
            if image[region].size:
                image[region] = self._draw(T_E_T, farthest, region)
        return image

    @cached_property
    def _background(self) -> Values:
        width, height = self._intrinsics.size
        diagonal = np.add.outer(np.linspace(0.0, 0.5, height), np.linspace(0.0, 0.5, width))
        return np.asarray(BACKGROUND[0] + diagonal * (BACKGROUND[1] - BACKGROUND[0]), dtype=np.float32)

    @cached_property
    def _plate(self) -> Array:
        outwards = np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
        return self._board.outline + self._margin * outwards

    def _region(self, plate_in_camera: Array) -> Region:
        """A rectangle of pixels that holds the plate, found by the rays of every eighth pixel.

        The plate is not projected for this: beyond the image the distortion's polynomial may fold back.
        """
        if plate_in_camera[:, 2].min() <= 0:
            return slice(None), slice(None)
        ideal = plate_in_camera[:, :2] / plate_in_camera[:, 2:]
        above_lowest = self._coarse_rays >= ideal.min(axis=0) - self._coarse_spacing
        below_highest = self._coarse_rays <= ideal.max(axis=0) + self._coarse_spacing
        near = np.all(above_lowest & below_highest, axis=-1)
        pad = _COARSE + int(np.ceil(4 * self._blur))
        return _extent(near.any(axis=1), pad), _extent(near.any(axis=0), pad)

    def _draw(self, T_E_T: Array, farthest: float, region: Region) -> Values:
        rays = self._rays[region]
        ray_x, ray_y = rays[..., 0], rays[..., 1]
        plane_from_ray = np.linalg.inv(T_E_T[:3, [0, 1, 3]]).tolist()
        # The plane's (x, y, 1) / depth for each ray. On the plate 1 / depth is at least 1 / farthest; what
        # lies below half of that is no plate, and behind the camera it is negative.
        x, y, reciprocal = (ray_x * a + ray_y * b + c for a, b, c in plane_from_ray)
        bound = 0.5 / farthest
        clipped = np.maximum(reciprocal, bound)
        plate, darkness = self._pattern.paint(x / clipped, y / clipped)
        plate = plate * (reciprocal > bound)
        background = self._background[region]
        image: Values = background + plate * (WHITE - (WHITE - BLACK) * darkness - background)
        if self._blur > 0:
            cv2.GaussianBlur(image, (0, 0), self._blur, dst=image, borderType=cv2.BORDER_REPLICATE)
        return image


def _extent(near: NDArray[np.bool_], pad: int) -> slice:
    """The pixels along one direction that belong to the coarse ones, with ``pad`` more on both sides."""
    indices = _COARSE * np.flatnonzero(near)
    return slice(max(0, indices[0] - pad), indices[-1] + pad + 1) if len(indices) else slice(0, 0)
