"""Whether anything stands between the camera and the target."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualcal_hal.errors import UsageError
from dualcal_hal.geometry import ArmBody, segment_distance
from dualcal_hal.transforms import Array, Mask, apply, inverse
from procedures.planning.belief import Belief
from procedures.planning.model import CellModel

LEAST_SQUARE_PX = 3.0
"""Width of a square in the image below which no corner can be told from noise."""

SIGHT_MARGIN = 0.010
"""m that lines of sight keep from what could hide the target."""

ROUND_END = 2.0
"""Link radii along a line of sight by which the links that carry the target may stand before it."""


def require_visible(model: CellModel) -> None:
    """UsageError where no pose can show the target: squares of next to no pixels, or a pattern larger than the image.

    Most often a length is in another unit than its key says.
    """
    focal = float(np.sqrt(np.linalg.det(model.intrinsics.matrix[:2, :2])))
    near, far = model.distance
    square = model.board.square
    if focal * square / far < LEAST_SQUARE_PX:
        raise UsageError(
            f"target.square_mm: a square of {square * 1e3:g} mm is {focal * square / far:.2g} px wide at the largest "
            f"distance, {far * 1e3:g} mm, of {LEAST_SQUARE_PX:g} px at the least; are both in mm?"
        )
    smaller = focal * float(np.min(np.ptp(model.board.outline[:, :2], axis=0))) / near
    if smaller > max(model.intrinsics.size):
        raise UsageError(
            f"procedure.distance_mm: at {near * 1e3:g} mm the target is {smaller:.0f} px wide, wider than the image; "
            "is the distance in mm, and target.square_mm?"
        )


def in_sight(model: CellModel, q_a: ArrayLike, q_p: ArrayLike, belief: Belief) -> Mask:
    """Which of the joint angles (k, n) rad of both arms leave every line from the lens to the plate free.

    Judged by lines to the plate's centre, its corners and the middles of its sides, against the links of both arms and
    all fixtures. Of the last two links the active arm's do not count, as they carry the camera; the passive arm's do
    not within ROUND_END of the plate: there the round ends of their capsules stick out where the links do not.
    """
    q_a, q_p = (np.atleast_2d(np.asarray(q, dtype=float)) for q in (q_a, q_p))
    if len(q_a) == 0 or len(q_p) == 0:
        return np.zeros(0, dtype=bool)
    lens = model.active.chain.forward(q_a) @ belief.T_H_E
    T_A_P = inverse(belief.T_P_A)
    plate = apply(T_A_P @ model.target_in_passive(q_p), _seen_of_plate(model))
    lines = np.stack([np.broadcast_to(lens[:, None, :3, 3], plate.shape), plate], axis=2)  # (k, lines, 2, 3)
    active, passive = model.geometry.active, model.geometry.passive
    active_segments, passive_segments = active.segments(q_a), passive.segments(q_p)
    passive_segments = apply(T_A_P, passive_segments.reshape(-1, 3)).reshape(passive_segments.shape)
    arm, wrist = _arm_and_wrist(passive)
    least = np.minimum.reduce(
        [
            _least_distance(lines[:, :, None], active_segments, active, _arm_and_wrist(active)[0]),
            _least_distance(lines[:, :, None], passive_segments, passive, arm),
            _least_distance(_shortened(lines, passive.links.radius[wrist]), passive_segments, passive, wrist),
        ]
    )
    for body, T_A_base in ((active, np.eye(4)), (passive, T_A_P)):
        for fixture in body.fixtures:
            least = np.minimum(least, fixture.separation_from_afar(T_A_base, lines, 0.0, 0.0).min(axis=1))
    return np.asarray(least >= SIGHT_MARGIN)


def _seen_of_plate(model: CellModel) -> Array:
    """(9, 3) points in T: centre, corners and middles of the sides of the pattern."""
    corners = model.board.outline
    return np.concatenate([corners.mean(axis=0)[None], corners, (corners + np.roll(corners, 1, axis=0)) / 2])


def _arm_and_wrist(body: ArmBody) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The numbers of its links' capsules: those before the last two links, and those of these two."""
    wrist = body.links.frame > body.chain.joints - 2
    return np.flatnonzero(~wrist), np.flatnonzero(wrist)


def _shortened(lines: Array, radius: Array) -> Array:
    """The lines (k, l, 2, 3) without what is within ROUND_END of where they end, for each radius (c,): (k, l, c, 2, 3).

    One that is no longer is its beginning.
    """
    lens, plate = lines[:, :, None, 0], lines[:, :, None, 1]
    length = np.linalg.norm(lens - plate, axis=-1)
    end = plate + np.minimum(ROUND_END * radius / length, 1.0)[..., None] * (lens - plate)
    return np.stack([np.broadcast_to(lens, end.shape), end], axis=-2)


def _least_distance(lines: Array, segments: Array, body: ArmBody, links: NDArray[np.intp]) -> Array:
    """(k,) m from lines, (k, l, c, 2, 3) or the same for all, to c of the body's links, placed at segments."""
    distance = segment_distance(lines, segments[:, None, links]) - body.links.radius[links]
    return np.asarray(distance.min(axis=(1, 2), initial=np.inf))
