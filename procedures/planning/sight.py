"""Whether anything stands between the camera and the target."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.geometry import ArmBody, segment_distance
from dualcal_hal.transforms import Array, Mask, apply, inverse
from procedures.planning.belief import Belief
from procedures.planning.model import CellModel

SIGHT_MARGIN = 0.010
"""m that lines of sight keep from what could hide the target."""


def in_sight(model: CellModel, q_a: ArrayLike, q_p: ArrayLike, belief: Belief) -> Mask:
    """Which of the joint angles (k, n) rad of both arms leave every line from the lens to the plate free.

    Judged by lines to the plate's centre, its corners and the middles of its sides, against the links of both arms and
    all fixtures. The last two links do not count: the one arm's carry the camera, the other's are behind the plate,
    and the round ends of their capsules stick out where the links do not.
    """
    q_a, q_p = (np.atleast_2d(np.asarray(q, dtype=float)) for q in (q_a, q_p))
    if len(q_a) == 0 or len(q_p) == 0:
        return np.zeros(0, dtype=bool)
    lens = model.active.chain.forward(q_a) @ belief.T_H_E
    T_A_P = inverse(belief.T_P_A)
    plate = apply(T_A_P @ model.target_in_passive(q_p), _seen_of_plate(model))
    lines = np.stack([np.broadcast_to(lens[:, None, :3, 3], plate.shape), plate], axis=2)  # (k, lines, 2, 3)
    passive = model.geometry.passive.segments(q_p)
    passive = apply(T_A_P, passive.reshape(-1, 3)).reshape(passive.shape)
    least = np.minimum(
        _least_distance(lines, model.geometry.active.segments(q_a), model.geometry.active),
        _least_distance(lines, passive, model.geometry.passive),
    )
    for body, T_A_base in ((model.geometry.active, np.eye(4)), (model.geometry.passive, T_A_P)):
        for fixture in body.fixtures:
            least = np.minimum(least, fixture.separation_from_afar(T_A_base, lines, 0.0, 0.0).min(axis=1))
    return np.asarray(least >= SIGHT_MARGIN)


def _seen_of_plate(model: CellModel) -> Array:
    """(9, 3) points in T: centre, corners and middles of the sides of the pattern."""
    corners = model.board.outline
    return np.concatenate([corners.mean(axis=0)[None], corners, (corners + np.roll(corners, 1, axis=0)) / 2])


def _least_distance(lines: Array, segments: Array, body: ArmBody) -> Array:
    """(k,) m from the lines (k, l, 2, 3) to the body's links, placed at segments (k, c, 2, 3)."""
    hiding = np.flatnonzero(body.links.frame <= body.chain.joints - 2)
    if len(hiding) == 0:
        return np.full(len(lines), np.inf)
    distance = segment_distance(lines[:, :, None], segments[:, None, hiding]) - body.capsules.radius[hiding]
    return np.asarray(distance.min(axis=(1, 2)))
