"""Which constraints to take: those that together tell most of both transforms, on axes that spread well."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dualcal_hal.transforms import Array, inverse, skew, vector_from_rotation
from procedures.planning.belief import Belief

LEAST_TURN = float(np.deg2rad(30.0))
"""Flange orientations of the calibration's constraints are turned by this much about two axes (rad)."""

LEAST_SPREAD = 0.1
"""Smallest eigenvalue of the mean of z z^T over the calibration's optical axes z; 1/3 where they point everywhere."""

_PRIOR = 1e-3  # m^-2, so that a determinant exists before ten directions have been seen
_ROUNDS = 10


@dataclass(frozen=True, eq=False)
class Knowledge:
    """What k constraints tell of both transforms.

    axes: (k, 3) optical axes in P; flanges: (k, 3, 3) orientations of the active flange; information: (12, 12), m^-2.
    """

    axes: Array
    flanges: Array
    information: Array

    @staticmethod
    def of(T_A_H: Array, belief: Belief, distances: Array) -> Knowledge:
        """Of one constraint with the active flange at ``T_A_H`` and the feature at distances (m,) along the axis."""
        T_P_E = belief.T_P_A @ T_A_H @ belief.T_H_E
        points = T_P_E[:3, 3] + distances[:, None] * T_P_E[:3, 2]
        return Knowledge(T_P_E[None, :3, 2], T_A_H[None, :3, :3], _information(T_P_E, belief, points))

    @staticmethod
    def together(constraints: Sequence[Knowledge]) -> Knowledge:
        """Of all of these constraints; there may be none."""
        return Knowledge(
            np.concatenate([np.zeros((0, 3)), *(c.axes for c in constraints)]),
            np.concatenate([np.zeros((0, 3, 3)), *(c.flanges for c in constraints)]),
            np.sum([np.zeros((12, 12)), *(c.information for c in constraints)], axis=0),
        )

    @property
    def spread(self) -> float:
        """Smallest eigenvalue of the mean of z z^T over the axes."""
        return spread_of(self.axes)

    @property
    def turn(self) -> float:
        """How far the flanges are turned about a second axis, rad."""
        return turned_about_two_axes(self.flanges)

    @property
    def well_spread(self) -> bool:
        """Whether axes and flanges are spread as a calibration's have to be."""
        return self.spread >= LEAST_SPREAD and self.turn >= LEAST_TURN


def most_informative(pool: Sequence[Knowledge], count: int, known: Knowledge, *, well_spread: bool) -> list[int]:
    """Which ``count`` of the pool to take on top of what is known: D-optimal, and well spread before all if told so.

    Chosen greedily, by what they tell and by how wide their axes are, then one is exchanged for another as long as
    that helps; the better of both. Where none is found that is well spread, the choice that comes nearest to it.
    """
    starts = (_worth, _width) if well_spread else (_worth,)
    choices = [_improved(pool, _greedy(pool, count, known, gain), known, well_spread=well_spread) for gain in starts]

    def merit(numbers: Sequence[int]) -> tuple[float, float]:
        together = Knowledge.together([known, *(pool[i] for i in numbers)])
        nearness = 1.0 if together.well_spread or not well_spread else together.spread
        return nearness, float(_worth(together, [Knowledge.together([])])[0])

    return max(choices, key=merit)


def _worth(have: Knowledge, left: Sequence[Knowledge]) -> Array:
    """Logarithm of the information's determinant with one more, for each of those left."""
    information = have.information + np.stack([one.information for one in left])
    return np.asarray(np.linalg.slogdet(information + _PRIOR * np.eye(12))[1])


def _width(have: Knowledge, left: Sequence[Knowledge]) -> Array:
    """The same of the sum of z z^T over the axes."""
    return np.asarray(np.linalg.slogdet(_outer(have, left) + _PRIOR * np.eye(3))[1])


def _outer(have: Knowledge, left: Sequence[Knowledge]) -> Array:
    """Sums of z z^T over the axes with one more, (k, 3, 3)."""
    return np.asarray(have.axes.T @ have.axes + np.stack([one.axes.T @ one.axes for one in left]))


def _greedy(
    pool: Sequence[Knowledge], count: int, known: Knowledge, gain: Callable[[Knowledge, Sequence[Knowledge]], Array]
) -> list[int]:
    chosen: list[int] = []
    left = list(range(len(pool)))
    for _ in range(min(count, len(pool))):
        have = Knowledge.together([known, *(pool[i] for i in chosen)])
        chosen.append(left.pop(int(np.argmax(gain(have, [pool[i] for i in left])))))
    return chosen


def _improved(pool: Sequence[Knowledge], chosen: list[int], known: Knowledge, *, well_spread: bool) -> list[int]:
    """The choice after exchanges of one for another that is better."""
    for _ in range(_ROUNDS):
        before = list(chosen)
        for i in before:
            rest = [j for j in chosen if j != i]
            chosen = [*rest, _best_addition(pool, rest, known, well_spread=well_spread)]
        if set(chosen) == set(before):
            break
    return chosen


def _best_addition(pool: Sequence[Knowledge], chosen: Sequence[int], known: Knowledge, *, well_spread: bool) -> int:
    """The number of the one that is best added to those chosen."""
    have = Knowledge.together([known, *(pool[i] for i in chosen)])
    left = [i for i in range(len(pool)) if i not in chosen]
    worth = _worth(have, [pool[i] for i in left])
    if not well_spread:
        return left[int(np.argmax(worth))]
    spread = np.linalg.eigvalsh(_outer(have, [pool[i] for i in left]))[:, 0] / (len(have.axes) + 1)
    nearness = np.minimum(1.0, spread / LEAST_SPREAD)
    if have.turn < LEAST_TURN:  # one more never takes a turn away
        nearness += [min(1.0, Knowledge.together([have, pool[i]]).turn / LEAST_TURN) for i in left]
    return left[int(np.lexsort((worth, nearness))[-1])]


def spread_of(axes: Array) -> float:
    """Smallest eigenvalue of the mean of z z^T over optical axes (k, 3); zero where there are none."""
    return float(np.linalg.eigvalsh(axes.T @ axes)[0] / max(len(axes), 1))


def turned_about_two_axes(R: Array) -> float:
    """How far flange orientations (k, 3, 3) are turned about a second axis, in rad.

    The largest angle, over pairs of relative rotations, that is left of one perpendicular to the other's axis: zero
    if all relative rotations share one axis, when the rotation step is singular.
    """
    first, second = np.triu_indices(len(R), 1)
    vectors = vector_from_rotation(np.swapaxes(R[first], 1, 2) @ R[second])
    angles = np.linalg.norm(vectors, axis=1)
    if not np.any(angles > 0):
        return 0.0
    axes = vectors / np.maximum(angles, 1e-12)[:, None]
    sideways = np.linalg.norm(np.cross(axes[:, None], vectors[None]), axis=2)
    return float(np.max(np.minimum(sideways, angles[:, None])))


def _information(T_P_E: Array, belief: Belief, points: Array) -> Array:
    """What points (m, 3) in P, aligned with one axis, tell of both transforms: (12, 12), per m^2.

    Rows are the feature's offsets across the axis; columns right perturbations of T_P_A, then of T_H_E
    (translation in m, rotation in rad). Ten directions are seen; the paper's gauge is the other two.
    """
    in_camera = (points - T_P_E[:3, 3]) @ T_P_E[:3, :3]
    T_E_A = inverse(T_P_E) @ belief.T_P_A
    in_base = in_camera @ T_E_A[:3, :3] - T_E_A[:3, :3].T @ T_E_A[:3, 3]
    base = np.concatenate([np.broadcast_to(-np.eye(3), (len(points), 3, 3)), skew(in_base)], axis=2)
    camera = np.concatenate([np.broadcast_to(-np.eye(3), (len(points), 3, 3)), skew(in_camera)], axis=2)
    J = np.concatenate([T_E_A[:3, :3] @ base, camera], axis=2)[:, :2].reshape(-1, 12)
    return np.asarray(J.T @ J)
