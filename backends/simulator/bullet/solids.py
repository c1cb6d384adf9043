"""What arms and their tools are made of: capsules and boxes of one density."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dualcal_hal.transforms import Array, transform

DENSITY = 2000.0
"""kg/m^3: castings of aluminium with motors inside; the paper's arms come to about 20 kg each."""


@dataclass(frozen=True, eq=False)
class Solid:
    """A homogeneous body on a link.

    shape, sizes: its name and measures (m) as URDF has them; T: (4, 4) its centre and main axes in the link's frame;
    volume in m^3; gyration: (3,) m^2, its moments of inertia about the main axes by its mass.
    """

    shape: str
    sizes: Mapping[str, str]
    T: Array
    volume: float
    gyration: Array

    @property
    def mass(self) -> float:
        """kg."""
        return DENSITY * self.volume

    @property
    def inertia(self) -> Array:
        """(3, 3) kg m^2 about its centre, along the axes of the link's frame."""
        R = self.T[:3, :3]
        return np.asarray(self.mass * (R @ np.diag(self.gyration) @ R.T))


def capsule(ends: Array, radius: float) -> Solid:
    """About a segment (2, 3); it resists turning like the cylinder of its radius and volume."""
    way = ends[1] - ends[0]
    length = float(np.linalg.norm(way))
    volume = np.pi * radius**2 * (length + 4 / 3 * radius)
    across = radius**2 / 4 + (length + 4 / 3 * radius) ** 2 / 12
    sizes = {"radius": repr(float(radius)), "length": repr(length)}
    T = transform(_z_along(way), ends.mean(axis=0))
    return Solid("capsule", sizes, T, volume, np.array([across, across, radius**2 / 2]))


def box(size: Array, T: Array) -> Solid:
    """With edges (3,) in m along the axes of T (4, 4), about its origin."""
    squares = size**2
    return Solid("box", {"size": numbers(size)}, T, float(np.prod(size)), (squares.sum() - squares) / 12)


def ball(radius: float) -> Solid:
    """About the origin."""
    sizes = {"radius": repr(radius)}
    return Solid("sphere", sizes, np.eye(4), 4 / 3 * np.pi * radius**3, np.full(3, 0.4 * radius**2))


def numbers(values: Array) -> str:
    """As URDF has them, to the last bit."""
    return " ".join(repr(float(value)) for value in values)


def _z_along(way: Array) -> Array:
    """A rotation (3, 3) whose z points along ``way`` (3,)."""
    length = np.linalg.norm(way)
    if length == 0.0:
        return np.eye(3)
    z = way / length
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
