"""The camera's image of the checkerboard, without noise.

Each pixel looks along its undistorted ray at the plane of the board; its grey value is the mean over its area,
in closed form where one edge crosses it and from parts of it where two do.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from dualcal_hal.camera import Intrinsics
from dualcal_hal.errors import UsageError
from dualcal_hal.target import Checkerboard
from dualcal_hal.transforms import Array, apply, inverse

WHITE, BLACK = 225.0, 30.0
BACKGROUND = (95.0, 125.0)  # from the top left to the bottom right of the image

Values = NDArray[np.float32]
Region = tuple[slice, slice]

_COARSE = 8  # px
_PARTS = 6  # per pixel in each direction, where edges cross


class Renderer:
    """One camera and one board; ``margin`` in m of white beyond the outer squares, ``blur``: sigma in px.

    Raises UsageError for a distortion that cannot be undone over the whole image.
    """

    def __init__(self, board: Checkerboard, margin: float, intrinsics: Intrinsics, blur: float) -> None:
        self._board = board
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
        plate, darkness = self._paint(x / clipped, y / clipped)
        plate = plate * (reciprocal > bound)
        background = self._background[region]
        image: Values = background + plate * (WHITE - (WHITE - BLACK) * darkness - background)
        if self._blur > 0:
            cv2.GaussianBlur(image, (0, 0), self._blur, dst=image, borderType=cv2.BORDER_REPLICATE)
        return image

    def _paint(self, x: Values, y: Values) -> tuple[Values, Values]:
        """How much of each pixel, seen at (x, y) m in T, is plate, and how much of that is black."""
        board, (left, top) = self._board, self._board.outline[0, :2].tolist()
        margin = self._margin / board.square
        across = _Stripes.of_image((x - left) / board.square, board.columns + 1)
        down = _Stripes.of_image((top - y) / board.square, board.rows + 1)
        pattern = across.within(0.0) * down.within(0.0)
        return across.within(margin) * down.within(margin), pattern * (0.5 + 0.5 * _parity(across, down))


def _extent(near: NDArray[np.bool_], pad: int) -> slice:
    """The pixels along one direction that belong to the coarse ones, with ``pad`` more on both sides."""
    indices = _COARSE * np.flatnonzero(near)
    return slice(max(0, indices[0] - pad), indices[-1] + pad + 1) if len(indices) else slice(0, 0)


def _parity(across: _Stripes, down: _Stripes) -> Values:
    """The mean over each pixel of +1 in the black squares and -1 in the white ones."""
    sign_across, sign_down = across.sign(), down.sign()
    parity = sign_across * sign_down
    # Where two edges cross in one pixel, the mean of the product is not the product of the means.
    crossing = np.nonzero((np.abs(sign_across) < 1.0) & (np.abs(sign_down) < 1.0))
    parity[crossing] = np.mean(across.divided(crossing).sign() * down.divided(crossing).sign(), axis=0)
    return np.asarray(parity)


@dataclass(frozen=True, eq=False)
class _Stripes:
    """The board's squares along one of its directions, of which there are ``squares``.

    position: where each pixel's centre is, in squares from the outer edge; along_u, along_v: the change of
    that over the pixel.
    """

    position: Values
    along_u: Values
    along_v: Values
    squares: int

    @classmethod
    def of_image(cls, position: Values, squares: int) -> _Stripes:
        """``position``: (height, width)."""
        along_v, along_u = (np.asarray(np.gradient(position, axis=axis)) for axis in (0, 1))
        return cls(position, along_u, along_v, squares)

    def divided(self, pixels: tuple[NDArray[np.intp], ...]) -> _Stripes:
        """Parts of the chosen (n,) pixels as pixels of their own, (parts, n)."""
        offset = (np.arange(_PARTS) + 0.5) / _PARTS - 0.5
        v, u = (grid.reshape(-1, 1) for grid in np.meshgrid(offset, offset))
        along_u, along_v = self.along_u[pixels], self.along_v[pixels]
        position = np.asarray(self.position[pixels] + u * along_u + v * along_v, dtype=np.float32)
        part_u: Values = np.broadcast_to(along_u / _PARTS, position.shape)
        part_v: Values = np.broadcast_to(along_v / _PARTS, position.shape)
        return _Stripes(position, part_u, part_v, self.squares)

    def within(self, margin: float) -> Values:
        """The share of each pixel that is inside the outer edges moved outwards by ``margin`` squares."""
        half = self.squares / 2
        return self._share(half + margin - np.abs(self.position - half))

    def sign(self) -> Values:
        """The mean over each pixel of +1 in the first, third, ... stripe and -1 in the others.

        The outer stripes go on beyond the outer edges, which :meth:`within` cuts off.
        """
        inner = np.clip(self.position, 0.5, self.squares - 0.5)
        in_pair = inner + 0.5 - 2.0 * np.floor(0.5 * inner + 0.25)
        return 2.0 * self._share(0.5 - np.abs(in_pair - 1.0)) - 1.0

    def _share(self, distance: Values) -> Values:
        """The share of each pixel on the inner side of an edge ``distance`` squares away from its centre.

        Exact for a straight edge: a step, averaged over the pixel's width and over its height.
        """
        longer, shorter = self._spans
        share = (distance > 0.0).astype(np.float32)
        edge = np.flatnonzero(2.0 * np.abs(distance) < longer + shorter)
        d, p, q = (np.take(values, edge) for values in (distance, longer, shorter))
        beyond = 0.5 * (p - q) - np.abs(d)
        tail = np.clip(beyond + q, 0.0, q) ** 2 / (2.0 * p * q) + np.maximum(beyond, 0.0) / p
        np.put(share, edge, np.where(d > 0.0, 1.0 - tail, tail))
        return share

    @cached_property
    def _spans(self) -> tuple[Values, Values]:
        """How far the position runs along the pixel's two sides, the longer way first; never 0."""
        u, v = np.abs(self.along_u), np.abs(self.along_v)
        longer = np.maximum(u, v)
        return longer, np.maximum(np.minimum(u, v), 1e-9 * longer)


def undistorted_rays(intrinsics: Intrinsics) -> Array:
    """(height, width, 2): the undistorted normalised coordinates of each pixel's centre, exact to 1e-9 px.

    OpenCV stops at its count of iterations without a word, so the result is checked, and iterated on.
    Raises UsageError if the distortion cannot be undone in some pixel.
    """
    width, height = intrinsics.size
    focal = np.diag(intrinsics.matrix)[:2]
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2).astype(float)
    seen = (pixels - intrinsics.principal_point) / focal
    if not intrinsics.distortion.any():
        return seen.reshape(height, width, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    ideal = cv2.undistortImagePoints(pixels, intrinsics.matrix, intrinsics.distortion, None, criteria)
    rays = (np.asarray(ideal, dtype=float).reshape(-1, 2) - intrinsics.principal_point) / focal
    worst = np.inf
    while True:
        missing = seen - _distorted(rays, intrinsics.distortion)
        previous, worst = worst, float(np.abs(missing * focal).max())
        if worst < 1e-9:
            return rays.reshape(height, width, 2)
        if not worst < 0.9 * previous:
            break
        rays += missing
    raise UsageError("camera.distortion: cannot be undone everywhere in the image; check its coefficients")


def _distorted(rays: Array, distortion: Array) -> Array:
    """Normalised image coordinates (n, 2) as the lens bends them, by OpenCV's k1, k2, p1, p2, k3."""
    k1, k2, p1, p2, k3 = distortion
    x, y = rays[:, 0], rays[:, 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xy = 2.0 * x * y
    return np.stack(
        [x * radial + p1 * xy + p2 * (r2 + 2.0 * x * x), y * radial + p1 * (r2 + 2.0 * y * y) + p2 * xy], axis=-1
    )
