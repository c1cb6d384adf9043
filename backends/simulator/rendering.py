"""The camera's image of the target, without noise.

Each pixel looks along its undistorted ray at the plane of the board; its grey value is the mean over its area.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from backends.simulator.light import Light, smeared
from backends.simulator.markers import pattern_of
from backends.simulator.optics import true_intrinsics, true_rays
from backends.simulator.pattern import Values
from backends.simulator.scene import View
from backends.simulator.surface import Surface
from dualcal_hal.camera import Intrinsics
from dualcal_hal.config.image_errors import ImageErrorsConfig
from dualcal_hal.target import Target
from dualcal_hal.transforms import Array, apply, inverse

WHITE, BLACK = 225.0, 30.0
WALL = (95.0, 125.0)  # from the top left to the bottom right of the image

Region = tuple[slice, slice]

_COARSE = 8  # px
_BAND = 2**17  # px
_STILL = 0.01  # px: what moves less during an exposure stands still
_NO_ERRORS = ImageErrorsConfig()


class Renderer:
    """One camera and one board as the cell file describes them; ``margin`` in m of white beyond the outer squares,
    ``blur``: sigma in px, ``errors``: what is otherwise in truth.

    Raises UsageError for a distortion that cannot be undone over the whole image.
    """

    def __init__(
        self,
        board: Target,
        margin: float,
        intrinsics: Intrinsics,
        blur: float,
        errors: ImageErrorsConfig = _NO_ERRORS,
    ) -> None:
        self._board = board
        self._pattern = pattern_of(board, margin)
        self._margin = margin
        self._surface = Surface.of(board, errors)
        self._intrinsics = true_intrinsics(intrinsics, errors)
        self._blur = blur
        self._errors = errors
        self._light = Light(errors.lighting, intrinsics.size, (WHITE + BLACK) / 2)
        # Single precision: it moves no corner by 1e-4 px, and halves memory and traffic.
        self.rays = true_rays(intrinsics, errors).astype(np.float32)
        self._ray_planes = cv2.split(self.rays)
        self._coarse_rays = self.rays[::_COARSE, ::_COARSE].copy()
        self._coarse_spacing = max(np.abs(np.diff(self._coarse_rays, axis=axis)).max() for axis in (0, 1))

    def render(self, T_E_T: Array, view: View | None = None) -> Values:
        """(height, width) grey values for the board at ``T_E_T`` (4, 4); only its front is drawn.

        ``view``: what else there is to see; an even wall where left out.
        """
        return self.expose([T_E_T], view)

    def expose(self, poses: Sequence[Array], view: View | None = None) -> Values:
        """The mean of the images of a board that goes through ``poses`` (4, 4) while the shutter is open."""
        if len(poses) > 1 and self._shift(poses) < _STILL:
            poses = poses[:1]
        image = self._sharp(poses[0], view)
        for pose in poses[1:]:
            image += self._sharp(pose, view)
        image /= len(poses)
        sigma = float(np.hypot(self._blur, self._errors.defocus.sigma(poses[0][2, 3])))
        if sigma > 0:
            cv2.GaussianBlur(image, (0, 0), sigma, dst=image, borderType=cv2.BORDER_REPLICATE)
        return self._light.on(smeared(image, self._errors.corner_bias))

    def _shift(self, poses: Sequence[Array]) -> float:
        """How far the plate's corners move in the image from the first of ``poses``, px; inf behind the camera."""
        corners = np.array([apply(pose, self._plate) for pose in poses])
        if corners[..., 2].min() <= 0:
            return np.inf
        ideal = corners[..., :2] / corners[..., 2:]
        return float(np.abs((ideal - ideal[0]) * np.diag(self._intrinsics.matrix)[:2]).max())

    def _sharp(self, T_E_T: Array, view: View | None) -> Values:
        image = (self._wall if view is None else view.grey).copy()
        hidden = None if view is None else view.hidden
        plate_in_camera = apply(T_E_T, self._plate)
        faces_camera = inverse(T_E_T)[2, 3] > 0
        farthest = float(plate_in_camera[:, 2].max())
        if faces_camera and farthest > 0:
            for region in _bands(self._region(plate_in_camera)):
                self._draw(image[region], T_E_T, farthest, region, None if hidden is None else hidden[region])
        return image

    @cached_property
    def _wall(self) -> Values:
        width, height = self._intrinsics.size
        diagonal = np.add.outer(np.linspace(0.0, 0.5, height), np.linspace(0.0, 0.5, width))
        return np.asarray(WALL[0] + diagonal * (WALL[1] - WALL[0]), dtype=np.float32)

    @cached_property
    def _plate(self) -> Array:
        """(8, 3): the corners of the flat plate, and where they are on the surface; it bulges no further."""
        outwards = np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
        flat = self._board.outline + self._margin * outwards
        bent = self._surface.points(flat)
        return np.concatenate([bent * (1.0, 1.0, 0.0), bent])

    def _region(self, plate_in_camera: Array) -> Region:
        """A rectangle of pixels that holds the plate, found by the rays of every eighth pixel.

        The plate is not projected for this: beyond the image the distortion's polynomial may fold back.
        """
        if plate_in_camera[:, 2].min() <= 0:
            return slice(0, self._intrinsics.size[1]), slice(0, self._intrinsics.size[0])
        ideal = plate_in_camera[:, :2] / plate_in_camera[:, 2:]
        above_lowest = self._coarse_rays >= ideal.min(axis=0) - self._coarse_spacing
        below_highest = self._coarse_rays <= ideal.max(axis=0) + self._coarse_spacing
        near = np.all(above_lowest & below_highest, axis=-1)
        width, height = self._intrinsics.size
        return _extent(near.any(axis=1), height), _extent(near.any(axis=0), width)

    def _draw(self, image: Values, T_E_T: Array, farthest: float, region: Region, hidden: Values | None) -> None:
        """Draw the plate over what ``image``, the ``region`` of a whole one, shows behind it."""
        x, y, on_plane = self._plane(T_E_T, farthest, region)
        reach = float(np.linalg.norm(self._plate[:, :2], axis=1).max())
        plate, darkness = self._pattern.paint(*self._surface.printed(x, y, inverse(T_E_T)[:3, 3], reach))
        plate *= on_plane
        if hidden is not None:
            plate *= 1.0 - hidden
        image += plate * (WHITE - (WHITE - BLACK) * darkness - image)

    def _plane(self, T_E_T: Array, farthest: float, region: Region) -> tuple[Values, Values, NDArray[np.bool_]]:
        """Where each pixel's ray meets the plane z = 0 of T: x and y in m, and whether it does where plate may be."""
        plane_from_ray = np.linalg.inv(T_E_T[:3, [0, 1, 3]])
        # The plane's (x, y, 1) / depth for each ray. On the plate 1 / depth is at least 1 / farthest; what
        # lies below half of that is no plate, and behind the camera it is negative.
        ray_x, ray_y = (plane[region] for plane in self._ray_planes)
        x, y, reciprocal = (cv2.addWeighted(ray_x, a, ray_y, b, c) for a, b, c in plane_from_ray.tolist())
        bound = 0.5 / farthest
        depth = 1.0 / np.maximum(reciprocal, np.float32(bound))
        return np.asarray(x * depth), np.asarray(y * depth), np.asarray(reciprocal > bound)


def _extent(near: NDArray[np.bool_], count: int) -> slice:
    """Of ``count`` pixels along one direction those that belong to the coarse ones, and as many more on both sides."""
    indices = _COARSE * np.flatnonzero(near)
    return slice(max(0, indices[0] - _COARSE), min(count, indices[-1] + _COARSE + 1)) if len(indices) else slice(0, 0)


def _bands(region: Region) -> Iterator[Region]:
    """The region in parts that fit into the processor's cache; none if it is empty."""
    rows, columns = region
    width = columns.stop - columns.start
    count = -(-(rows.stop - rows.start) * width // _BAND)
    edges = np.linspace(rows.start, rows.stop, count + 1).astype(int).tolist()
    yield from ((slice(top, bottom), columns) for top, bottom in itertools.pairwise(edges))
