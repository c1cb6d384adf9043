"""Both arms' bodies in one cell."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualcal_hal.geometry.body import ArmBody
from dualcal_hal.geometry.capsules import camera_capsule, link_capsules, plate_capsules
from dualcal_hal.geometry.distance import length, segment_gap, unit
from dualcal_hal.geometry.placement import Placement, farthest_along, largest_motion
from dualcal_hal.geometry.solids import Fixture
from dualcal_hal.transforms import Array, apply, inverse

if TYPE_CHECKING:
    from dualcal_hal.config import CellConfig


@dataclass(frozen=True, eq=False)
class CellGeometry:
    """Both arms' bodies, with what stands about their bases."""

    active: ArmBody
    passive: ArmBody

    @staticmethod
    def of(cell: CellConfig, T_H_E: Array | None = None, camera_error: float = 0.0) -> CellGeometry:
        """The arms of a cell file with camera and plate.

        The camera's housing stands where ``T_H_E`` (4, 4) says, or the nominal one, and is thicker by ``camera_error``
        (m) all around.
        """
        active, passive, clearance = cell.active, cell.passive, cell.clearance
        T_H_E = cell.nominal.T_H_E if T_H_E is None else T_H_E
        housing = camera_capsule(active.chain.joints, T_H_E, cell.camera.body_radius, cell.camera.body_length)
        housing = replace(housing, radius=housing.radius + camera_error)
        plate = plate_capsules(passive.chain.joints, passive.target_mount_transform, cell.target.plate_outline)
        about = {
            base: [Fixture(name, f.solid, f.T) for name, f in cell.fixtures.items() if f.base == base]
            for base in ("active_base", "passive_base")
        }
        links_a = link_capsules(active.chain, active.link_radius)
        links_p = link_capsules(passive.chain, passive.link_radius)
        return CellGeometry(
            ArmBody(active.chain, links_a, housing, cell.floor, about["active_base"], clearance),
            ArmBody(passive.chain, links_p, plate, cell.floor, about["passive_base"], clearance),
        )

    def between(self, q_a: ArrayLike, q_p: ArrayLike, placement: Placement) -> Array:
        """Least distance (k,) in m between either arm and the other with its fixtures, whatever the bases' error.

        Joint angles (k, n) or (1, n).
        """
        active = self.active.segments(np.atleast_2d(np.asarray(q_a, dtype=float)))
        passive = self.passive.segments(np.atleast_2d(np.asarray(q_p, dtype=float)))
        return self.between_at(active, passive, placement)

    def between_at(self, active: Array, passive: Array, placement: Placement, enough: float = np.inf) -> Array:
        """The same, (k,) in m, with the capsules' ends at (k or 1, c, 2, 3), those of each arm in its base.

        More than ``enough`` (m) may be said to be less, but not than that: it is quicker.
        """
        T_A_P = inverse(placement.T_P_A)
        passive = apply(T_A_P, passive.reshape(-1, 3)).reshape(passive.shape)
        least = self._between_arms(active, passive, placement)
        for standing, T_A_base, body, segments in (
            (self.passive, T_A_P, self.active, active),
            (self.active, np.eye(4), self.passive, passive),
        ):
            near, radius = body.above_floor, body.capsules.radius[body.above_floor]
            for fixture in standing.fixtures if len(near) else ():  # of a stand nothing is
                distance = fixture.separation_from_afar(
                    T_A_base, segments[:, near], placement.translation, placement.rotation, enough + radius
                )
                least = np.minimum(least, (distance - radius).min(axis=1))
        return least

    def clearance(self, q_a: ArrayLike, q_p: ArrayLike, placement: Placement) -> Array:
        """Least of all distances (k,) in m: between the arms, to floor and fixtures, of each arm to itself."""
        own = np.minimum(self.active.own_clearance(q_a), self.passive.own_clearance(q_p))
        return np.minimum(self.between(q_a, q_p, placement), own)

    def _between_arms(self, active: Array, passive: Array, placement: Placement) -> Array:
        """Least distance (k,) between the arms' capsules, their ends (k or 1, c, 2, 3) in the active base."""
        k, a, p = self._near_pairs(active, passive, placement)
        first, second = active[k % len(active), a], passive[k % len(passive), p]
        n = unit(segment_gap(first, second))
        moving = farthest_along(n[:, None], first, placement.rotation).max(axis=1)
        standing = np.einsum("mi,mei->me", n, second).min(axis=1)
        radii = self.active.capsules.radius[a] + self.passive.capsules.radius[p]
        distance = standing - moving - placement.translation - radii
        return np.asarray(np.minimum.reduceat(distance, np.searchsorted(k, np.arange(k[-1] + 1))))

    def _near_pairs(self, active: Array, passive: Array, placement: Placement) -> tuple[NDArray[np.intp], ...]:
        """Indices (m,) of configuration, active and passive capsule, without the pairs that cannot be the closest."""
        centre_a, centre_p = active.mean(axis=2), passive.mean(axis=2)
        squares = (centre_a**2).sum(axis=2)[:, :, None] + (centre_p**2).sum(axis=2)[:, None]
        squares = squares - 2 * centre_a @ np.swapaxes(centre_p, 1, 2)
        radii = self.active.capsules.radius[:, None] + self.passive.capsules.radius
        at_most = np.sqrt(np.maximum(squares, 0.0)) - radii - placement.translation
        half_a, half_p = (length(s[..., 1, :] - s[..., 0, :]) / 2 for s in (active, passive))
        reach = largest_motion(active, 0.0, placement.rotation).max(axis=2) + half_a
        at_least = at_most - reach[:, :, None] - half_p[:, None]
        return np.nonzero(at_least <= at_most.min(axis=(1, 2), keepdims=True))
