"""Independent walks along ways, in finer steps than the planner's, and the clearance on them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

import numpy as np

from dualcal_hal.geometry import Placement
from dualcal_hal.transforms import Array, inverse
from procedures.planning.belief import Belief
from procedures.planning.model import CellModel, Posture
from procedures.planning.ways import Leg


def walk(model: CellModel, posture: Posture, legs: Iterable[Leg]) -> list[Posture]:
    """The postures along legs, no joint stepping further than 0.02 rad, with both ends."""
    passed = [posture]
    for leg in legs:
        here = passed[-1]
        if leg.arm == model.active.name:
            passed += [Posture.of(q, here.passive) for q in _small_steps([here.active, *leg.waypoints])]
        else:
            passed += [Posture.of(here.active, q) for q in _small_steps([here.passive, *leg.waypoints])]
    return passed


def least_clearance(model: CellModel, postures: Iterable[Posture], placement: Placement) -> float:
    """Of all postures, one after the other, m."""
    return min(float(model.geometry.clearance([p.active], [p.passive], placement)[0]) for p in postures)


def seen_from_camera(model: CellModel, posture: Posture, belief: Belief) -> Array:
    """``T_E_T`` (4, 4)."""
    return inverse(model.camera_in_passive(posture.active, belief)) @ model.target_in_passive(posture.passive)


def _small_steps(waypoints: Sequence[Sequence[float]]) -> Array:
    points = np.array(waypoints)
    counts = [1 + int(np.max(np.abs(b - a)) / 0.02) for a, b in itertools.pairwise(points)]
    steps = [np.linspace(a, b, n, endpoint=False) for (a, b), n in zip(itertools.pairwise(points), counts, strict=True)]
    return np.concatenate([*steps, points[-1:]])
