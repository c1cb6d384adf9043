"""What the camera sees besides the target's pattern: PyBullet's bodies, by its TinyRenderer at reduced size."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from backends.simulator.pattern import Values
from dualcal_hal.transforms import Array, Mask, inverse, rotation_from_quaternion, transform

if TYPE_CHECKING:
    from backends.simulator.bullet.bodies import BulletBodies
    from dualcal_hal.config import CellConfig

Part = tuple[int, int]
"""A body's unique id and a link's index; -1 is its base."""

SIZE = (256, 192)
"""Width and height of the reduced picture, px."""
NEAREST, FARTHEST = 0.01, 20.0
"""What is seen lies at these depths, m: nothing of the camera's own housing, which may hold the optical centre."""

SKY, FLOOR = 110, 80
"""Grey values where there is nothing, and of infinite planes."""

ROUND_END = 2.0
"""Link radii along the line of sight by which the last two links of the arm that carries the target may stand before
it without hiding it: they are behind it, though their capsules' round ends stick out."""

_IN_FRONT = 0.003  # m before the target's plane hides it: less is the picture's depth resolution
_SOFTNESS = 0.6  # sigma of the blur, px of the reduced picture
_FILL = 4.0  # the same for what is filled in behind the plate
_LIGHT = (0.5, 0.3, 1.0)  # where it comes from, in the world


@dataclass(frozen=True, eq=False)
class View:
    """grey: (height, width) grey values without the target's plate; hidden: the share (height, width) of each pixel
    that shows something nearer than it, None if nothing is."""

    grey: Values
    hidden: Values | None


@dataclass(frozen=True, eq=False)
class Frustum:
    """The pinhole camera of a picture, ``low`` and ``high`` being the normalised coordinates (x, y) of its first and
    last pixel's centre."""

    low: tuple[float, float]
    high: tuple[float, float]
    size: tuple[int, int] = SIZE

    @classmethod
    def around(cls, rays: Values) -> Frustum:
        """The least that holds all ``rays`` (height, width, 2)."""
        low, high = rays.min(axis=(0, 1)).tolist(), rays.max(axis=(0, 1)).tolist()
        return cls((low[0], low[1]), (high[0], high[1]))

    @property
    def focal(self) -> Array:
        """(2,) px."""
        return (np.array(self.size) - 1.0) / (np.array(self.high) - self.low)

    @property
    def principal_point(self) -> Array:
        """(2,) px."""
        return -np.array(self.low) * self.focal

    @property
    def rays(self) -> Array:
        """(height, width, 2): the normalised coordinates of each pixel's centre."""
        (left, top), (right, bottom), (width, height) = self.low, self.high, self.size
        return np.stack(np.meshgrid(np.linspace(left, right, width), np.linspace(top, bottom, height)), axis=-1)

    @property
    def projection(self) -> Array:
        """(4, 4): OpenGL's projection matrix.

        TinyRenderer draws one row higher than OpenGL does and pixels' centres are integers, hence + 1 for v and
        nothing for u.
        """
        (width, height), (fx, fy), (cx, cy) = self.size, self.focal, self.principal_point
        depth = FARTHEST - NEAREST
        return np.array(
            [
                [2 * fx / width, 0.0, (width - 2 * cx) / width, 0.0],
                [0.0, 2 * fy / height, (2 * (cy + 1) - height) / height, 0.0],
                [0.0, 0.0, -(FARTHEST + NEAREST) / depth, -2 * FARTHEST * NEAREST / depth],
                [0.0, 0.0, -1.0, 0.0],
            ]
        )


@dataclass(frozen=True, eq=False)
class Picture:
    """(height, width) each; grey: 0 to 255; depth: m along the optical axis; part: which one is seen, by
    :func:`part_code`, negative for none."""

    grey: NDArray[np.uint8]
    depth: Array
    part: NDArray[np.int32]


def part_code(part: Part) -> int:
    """How PyBullet writes a part into a segmentation mask."""
    body, link = part
    return body + ((link + 1) << 24)


def render_scene(client: int, T_world_E: Array, frustum: Frustum) -> Picture:
    """What stands in PyBullet's world ``client``, seen from ``T_world_E`` (4, 4)."""
    from backends.simulator.bullet.client import pybullet

    width, height = frustum.size
    world_to_opengl = np.diag([1.0, -1.0, -1.0, 1.0]) @ inverse(T_world_E)
    _, _, colours, buffer, parts = pybullet.getCameraImage(
        width,
        height,
        world_to_opengl.T.ravel().tolist(),
        frustum.projection.T.ravel().tolist(),
        lightDirection=_LIGHT,
        lightAmbientCoeff=0.25,
        lightDiffuseCoeff=0.45,
        lightSpecularCoeff=0.0,
        shadow=0,
        renderer=pybullet.ER_TINY_RENDERER,
        flags=pybullet.ER_SEGMENTATION_MASK_OBJECT_AND_LINKINDEX,
        physicsClientId=client,
    )
    part = np.asarray(parts, dtype=np.int32).reshape(height, width)
    grey = cv2.cvtColor(np.asarray(colours, dtype=np.uint8).reshape(height, width, 4), cv2.COLOR_RGBA2GRAY)
    grey[part < 0] = SKY
    from_far = (FARTHEST - NEAREST) * np.asarray(buffer, dtype=float).reshape(height, width)
    return Picture(np.asarray(grey, dtype=np.uint8), FARTHEST * NEAREST / (FARTHEST - from_far), part)


class Scene:
    """The surroundings of the target in PyBullet, for a camera with ``rays`` (height, width, 2)."""

    def __init__(self, bodies: BulletBodies, cell: CellConfig, rays: Values) -> None:
        self._bodies = bodies
        self._planes = list(_take_over_planes(bodies.client))
        self._camera = bodies.tool(cell.active_name)
        self._frustum = Frustum.around(rays)
        self._rays = self._frustum.rays
        self._ray_lengths = np.sqrt(1.0 + np.sum(self._rays**2, axis=-1))  # m a metre of depth
        pixels = (rays * self._frustum.focal + self._frustum.principal_point).astype(np.float32)
        self._maps = cv2.convertMaps(pixels[..., 0], pixels[..., 1], cv2.CV_16SC2)
        body, plate = bodies.tool(cell.passive_name)
        self._plate = part_code((body, plate))
        self._plate_radius = float(np.linalg.norm(cell.target.plate_outline, axis=1).max())
        # Each arm has a floor under its own base: where the bases stand unlike it passes through the other arm.
        self._floors = [part_code((body, -1)) for body in bodies.floors]
        self._spared = dict.fromkeys([self._plate, *self._floors], np.inf)
        links, numbers = bodies.shapes[cell.passive_name].links, bodies.links[cell.passive_name]
        for i in np.flatnonzero(links.frame >= cell.passive.chain.joints - 1).tolist():
            self._spared[part_code((body, numbers[i]))] = ROUND_END * float(links.radius[i])

    def view(self, T_E_T: Array) -> View:
        """As things stand, with the target at ``T_E_T`` (4, 4)."""
        T_world_E = self._bodies.link_pose(*self._camera)
        picture = render_scene(self._bodies.client, T_world_E, self._frustum)
        for body, T_world_plane in self._planes:
            self._lay(picture, body, inverse(T_world_E) @ T_world_plane)
        grey = picture.grey
        if inverse(T_E_T)[2, 3] > 0:
            grey = _filled_in(grey, picture.part == self._plate)
        hidden = self._hidden(picture, T_E_T)
        share = self._enlarged(255 * hidden.astype(np.uint8)) / np.float32(255) if hidden.any() else None
        return View(self._enlarged(grey), share)

    def _hidden(self, picture: Picture, T_E_T: Array) -> Mask:
        """Where (height, width) something is seen that stands before the plate."""
        before = self._plate_depth(T_E_T) - picture.depth
        hidden = before > _IN_FRONT
        for part, spared in self._spared.items():
            hidden &= (picture.part != part) | (before * self._ray_lengths > spared)
        return np.asarray(hidden)

    def _lay(self, picture: Picture, body: int, T_E_plane: Array) -> None:
        """Draw an infinite plane z = 0 whose front is seen where nothing else is nearer; a floor behind all else."""
        depth, plane = self._plane_depth(T_E_plane), part_code((body, -1))
        seen = (depth > 0) & (depth < picture.depth) & bool(inverse(T_E_plane)[2, 3] > 0)
        if plane in self._floors:
            seen &= (picture.part < 0) | np.isin(picture.part, self._floors)
        picture.grey[seen], picture.depth[seen], picture.part[seen] = FLOOR, depth[seen], plane

    def _plane_depth(self, T_E_plane: Array) -> Array:
        """Depth (height, width) in m at which the plane z = 0 is met; 0 where that is not before the camera."""
        normal = T_E_plane[:3, 2]
        level, cosine = normal @ T_E_plane[:3, 3], self._rays @ normal[:2] + normal[2]
        return np.asarray(np.divide(level, cosine, out=np.zeros_like(cosine), where=cosine * level > 0))

    def _plate_depth(self, T_E_T: Array) -> Array:
        """The same for the plate; 0 also for what is farther off the optical axis through its feature point than any of
        the plate."""
        depth = self._plane_depth(T_E_T)
        x, y = (depth * self._rays[..., axis] - T_E_T[axis, 3] for axis in (0, 1))
        return np.where(x * x + y * y < self._plate_radius**2, depth, 0.0)

    def _enlarged(self, values: NDArray[np.uint8]) -> Values:
        """From the reduced picture to the camera's image, with soft edges."""
        soft = cv2.GaussianBlur(values, (0, 0), _SOFTNESS)
        enlarged = cv2.remap(soft, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(enlarged, dtype=np.float32)


def _take_over_planes(client: int) -> Iterator[tuple[int, Array]]:
    """Bodies that are infinite planes, and their poses (4, 4); TinyRenderer, slow with them, sees them no more."""
    from backends.simulator.bullet.client import pybullet

    for body in range(pybullet.getNumBodies(physicsClientId=client)):
        shapes = pybullet.getVisualShapeData(body, physicsClientId=client)
        if any(shape[2] == pybullet.GEOM_PLANE for shape in shapes):
            pybullet.changeVisualShape(body, -1, rgbaColor=(0, 0, 0, 0), physicsClientId=client)
            position, quaternion = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
            yield body, transform(rotation_from_quaternion(quaternion), position)


def _filled_in(grey: NDArray[np.uint8], gap: Mask) -> NDArray[np.uint8]:
    """The picture with the ``gap`` filled by the mean of what is around it."""
    kept = (~gap).astype(np.float32)
    weight, total = (cv2.GaussianBlur(values, (0, 0), _FILL) for values in (kept, kept * grey))
    return np.where(gap, total / np.maximum(weight, 1e-3), grey).astype(np.uint8)
