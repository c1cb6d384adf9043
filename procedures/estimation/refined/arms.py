"""What stands in an arm's place: a chain of joints, the same looked at from its flange, a measured pose, or no arm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.transforms import Array, inverse, rotation_from_vector, transform, vector_from_rotation
from procedures.estimation.refined.motion import adjoint, in_flange


class Arm(Protocol):
    """What brings a flange to where a reading says; errors of its numbers, all of one sigma, move it."""

    @property
    def joints(self) -> int:
        """How many numbers a reading has."""

    def forward(self, q: ArrayLike) -> Array:
        """Readings (..., n) to the flange in the base, (..., 4, 4)."""

    def jacobian(self, q: ArrayLike) -> Array:
        """(..., 6, n) of the flange in the base by unit errors: linear rows, m, then angular, rad."""


@dataclass(frozen=True)
class NoArm:
    """Base and flange are one frame, and nothing is read."""

    @property
    def joints(self) -> int:
        return 0

    def forward(self, q: ArrayLike) -> Array:
        return np.broadcast_to(np.eye(4), (*np.shape(q)[:-1], 4, 4)).copy()

    def jacobian(self, q: ArrayLike) -> Array:
        return np.zeros((*np.shape(q)[:-1], 6, 0))


@dataclass(frozen=True)
class MeasuredFlange:
    """A flange pose as a robot states it: a reading is its translation, m, and its rotation vector, rad.

    The flange stands beside it by six errors about and along its own axes; ``lever``, m: by how much it is off along
    an axis where it is off by 1 rad about one.
    """

    lever: float

    @property
    def joints(self) -> int:
        return 6

    @staticmethod
    def readings(flange: ArrayLike) -> Array:
        """(k, 6) of poses (k, 4, 4)."""
        T = np.asarray(flange, dtype=float)
        return np.concatenate([T[:, :3, 3], vector_from_rotation(T[:, :3, :3])], axis=1)

    def forward(self, q: ArrayLike) -> Array:
        reading = np.asarray(q, dtype=float)
        return transform(rotation_from_vector(reading[..., 3:]), reading[..., :3])

    def jacobian(self, q: ArrayLike) -> Array:
        R = self.forward(q)[..., :3, :3]
        J = np.zeros((*R.shape[:-2], 6, 6))
        J[..., :3, :3], J[..., 3:, 3:] = self.lever * R, R
        return J


@dataclass(frozen=True)
class Inverted:
    """An arm from its flange: the base in the flange."""

    arm: Arm

    @property
    def joints(self) -> int:
        return self.arm.joints

    def forward(self, q: ArrayLike) -> Array:
        return inverse(self.arm.forward(q))

    def jacobian(self, q: ArrayLike) -> Array:
        T = self.arm.forward(q)
        # A motion of the flange in its own frame is the opposite one of the base, as seen in the base.
        of_base = -adjoint(T) @ in_flange(self.arm.jacobian(q), T)
        R = np.swapaxes(T[..., :3, :3], -1, -2)
        return np.concatenate([R @ of_base[..., :3, :], R @ of_base[..., 3:, :]], axis=-2)
