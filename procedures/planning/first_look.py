"""The first look: a stand-off that is clear whatever the bases' error, and a few images that make planning possible.

The nominal transforms may be off by a decimetre and ten degrees: too much to plan near the other arm. From the
stand-off the camera sees the board from afar; with the board tilted differently in each of a few images, both
transforms follow well enough (about 2 mm and 0.1 deg after five) to plan with and to start the servo from.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dualcal_hal.errors import NoPlan
from dualcal_hal.kinematics import random_joints
from dualcal_hal.transforms import Array, inverse, rotation_from_vector, smallest_rotation, transform
from procedures.planning.belief import Belief
from procedures.planning.model import ArmModel, CellModel, Posture
from procedures.planning.ways import Leg, WayFinder

BOARD_TILT = np.deg2rad(25.0)
"""The board's normal leans by this much (rad) from the camera's, each time in another quarter of its view: between any
two looks it is tilted by at least 20 degrees."""

STAND_OFF_CLEARANCE = 0.25
"""Clearance (m) from which on more is worth nothing: a decimetre of base error and its lever are inside."""

_FORWARD = (0.25, 0.30, 0.20, 0.35)  # m in front of its own base
_HEIGHT = (0.50, 0.45, 0.55, 0.40, 0.60)  # m above its own base
_ROLLS = np.deg2rad([0.0, 90.0, 180.0, -90.0])
_STARTS = 6
STEEPER_TILT = np.deg2rad(45.0)
"""The same (rad) for the looks after the fifth."""

CAMERA_LEAN = np.deg2rad(6.0)
"""The camera looks past the board's centre by this much (rad), in another direction in each look."""

_GOOD_DISTANCE = 0.65  # m between camera and board
_SEARCH_RINGS = np.deg2rad([12.0, 20.0])
_CAMERA_ROLLS = np.deg2rad([40.0, 25.0, 12.0, 60.0])


@dataclass(frozen=True, eq=False)
class StandOff:
    """Where both arms face each other from afar, the legs that lead there, and how far apart the arms are there (m)."""

    posture: Posture
    way: tuple[Leg, ...]
    clearance: float
    distance: float


def find_stand_off(model: CellModel, belief: Belief, ways: WayFinder, start: Posture, seed: int) -> StandOff:
    """The posture, of those tried, with the best clearance and distance that can be reached from ``start``.

    Camera and board are held in front of their own bases, facing each other along the line between the bases.
    Raises NoPlan, which names the arm that does not reach or says that no way is clear.
    """
    rng = np.random.default_rng([seed, 1])
    toward_passive = _level(inverse(belief.T_P_A)[:3, 3], "bases")
    toward_active = _level(belief.T_P_A[:3, 3], "bases")
    q_a = _facing_postures(model.active, toward_passive, inverse(belief.T_H_E), rng)
    q_p = _facing_postures(model.passive, toward_active, inverse(model.T_F_T), rng)
    for arm, q in ((model.active, q_a), (model.passive, q_p)):
        if len(q) == 0:
            raise NoPlan(f"no stand-off: arm '{arm.name}' cannot face the other in front of its base within its limits")
    for i, j in _by_merit(model, belief, ways, q_a, q_p):
        posture = Posture.of(q_a[i], q_p[j])
        way = ways.find(start, posture)
        if way is not None:
            clearance = float(ways.geometry.between([q_a[i]], [q_p[j]], belief.placement)[0])
            T_E_T = inverse(model.camera_in_passive(q_a[i], belief)) @ model.target_in_passive(q_p[j])
            return StandOff(posture, way, clearance, float(T_E_T[2, 3]))
    raise NoPlan(
        "no stand-off: no clear way from where the arms stand to any posture in which they face each other; "
        "jog them apart, each above its own base"
    )


def look_postures(model: CellModel, belief: Belief, ways: WayFinder, at: Posture, number: int) -> Iterator[Posture]:
    """Postures for look ``number``, the preferred first, by wrist moves from the stand-off ``at``.

    Look 0 is the stand-off itself and, should the board not be seen there, the camera tilted about its own lens in
    rings. Later ones tilt the board about its own centre, point the camera at it as now believed, and roll it.
    """
    aimed = model.camera_in_passive(at.active, belief)
    T_P_T = model.target_in_passive(at.passive)
    if number == 0:
        yield at
        for angle, azimuth in itertools.product(_SEARCH_RINGS, np.arange(8) * np.pi / 4):
            posture = _posture(model, belief, _turned(aimed, _about(azimuth, angle)), T_P_T, at)
            if posture is not None and _is_clear(model, belief, ways, posture):
                yield posture
        return
    aimed = _aimed(aimed, T_P_T[:3, 3])
    azimuth = np.pi / 4 + (number - 1) * np.pi / 2
    angle = BOARD_TILT if number <= 4 else STEEPER_TILT
    lean = _about(azimuth + np.pi / 2, CAMERA_LEAN)
    sign = 1.0 if number % 2 else -1.0
    for roll in (*_CAMERA_ROLLS, *-_CAMERA_ROLLS):
        T_P_E = _turned(aimed, lean @ rotation_from_vector([0.0, 0.0, sign * roll]))
        posture = _posture(model, belief, T_P_E, _tilted(T_P_T, T_P_E, azimuth, angle), at)
        if posture is not None and _is_clear(model, belief, ways, posture):
            T_E_T = inverse(model.camera_in_passive(posture.active, belief)) @ model.target_in_passive(posture.passive)
            if model.in_view(T_E_T[None])[0]:
                yield posture


def _posture(model: CellModel, belief: Belief, T_P_E: Array, T_P_T: Array, near: Posture) -> Posture | None:
    flange_a = inverse(belief.T_P_A) @ T_P_E @ inverse(belief.T_H_E)
    flange_p = T_P_T @ inverse(model.T_F_T)
    q_a, reached_a = model.active.chain.inverse(flange_a, [near.active], model.active.lower, model.active.upper)
    q_p, reached_p = model.passive.chain.inverse(flange_p, [near.passive], model.passive.lower, model.passive.upper)
    return Posture.of(q_a[0], q_p[0]) if reached_a[0] and reached_p[0] else None


def _is_clear(model: CellModel, belief: Belief, ways: WayFinder, posture: Posture) -> bool:
    clearance = ways.geometry.clearance([posture.active], [posture.passive], belief.placement)
    return bool(clearance[0] >= model.margin)


def _turned(T: Array, rotation: Array) -> Array:
    """A frame turned about its own origin."""
    return transform(T[:3, :3] @ rotation, T[:3, 3])


def _tilted(T_P_T: Array, T_P_E: Array, azimuth: float, angle: float) -> Array:
    """The board turned about its centre until its normal leans by ``angle`` from the camera, at ``azimuth`` in view."""
    leaning = np.array([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)])
    normal = -T_P_E[:3, :3] @ leaning
    return transform(smallest_rotation(T_P_T[:3, 2], normal) @ T_P_T[:3, :3], T_P_T[:3, 3])


def _level(direction: Array, what: str) -> Array:
    level = np.array([direction[0], direction[1], 0.0])
    length = float(np.linalg.norm(level))
    if length < 1e-3:
        raise NoPlan(f"no stand-off: the {what} stand above each other, there is no direction in which they face")
    return np.asarray(level / length)


def _facing_postures(arm: ArmModel, toward: Array, T_tool_flange: Array, rng: np.random.Generator) -> Array:
    """Joint angles (k, n) that hold the tool in front of the arm's base, its z axis towards the other arm."""
    up = np.array([0.0, 0.0, 1.0])
    facing = np.stack([np.cross(-up, toward), -up, toward], axis=1)
    goals = np.array(
        [
            transform(facing @ rotation_from_vector([0.0, 0.0, roll]), forward * toward + height * up) @ T_tool_flange
            for forward, height, roll in itertools.product(_FORWARD, _HEIGHT, _ROLLS)
        ]
    )
    starts = np.concatenate(
        [random_joints(rng, len(goals) * (_STARTS - 1), arm.lower, arm.upper), np.tile(arm.home, (len(goals), 1))]
    )
    q, reached = arm.chain.inverse(np.tile(goals, (_STARTS, 1, 1)), starts, arm.lower, arm.upper)
    return np.asarray(arm.nearest_turn(q[reached], arm.home))


def _by_merit(model: CellModel, belief: Belief, ways: WayFinder, q_a: Array, q_p: Array) -> Iterator[tuple[int, int]]:
    """Pairs of postures, best first: clear of everything, at a good distance, short of travel, with room at limits."""
    own_a, own_p = ways.geometry.active.own_clearance(q_a), ways.geometry.passive.own_clearance(q_p)
    q_a_index, q_p_index = np.flatnonzero(own_a >= model.margin), np.flatnonzero(own_p >= model.margin)
    merit_a = _ease(model.active, q_a) + np.minimum(own_a, 0.1)
    merit_p = _ease(model.passive, q_p) + np.minimum(own_p, 0.1)
    best_a = q_a_index[np.argsort(-merit_a[q_a_index], kind="stable")][:24]
    best_p = q_p_index[np.argsort(-merit_p[q_p_index], kind="stable")][:24]
    pairs = list(itertools.product(best_a, best_p))
    if not pairs:
        return iter(())
    first, second = np.array(pairs).T
    between = ways.geometry.between(q_a[first], q_p[second], belief.placement)
    T_E_T = inverse(model.camera_in_passive(q_a[first], belief)) @ model.target_in_passive(q_p[second])
    merit = merit_a[first] + merit_p[second] + 4 * np.minimum(between, STAND_OFF_CLEARANCE)
    merit = merit - np.abs(T_E_T[:, 2, 3] - _GOOD_DISTANCE)
    seen = model.in_view(T_E_T) & (between >= model.margin)
    order = np.argsort(-merit, kind="stable")
    return iter([(int(first[k]), int(second[k])) for k in order if seen[k]])


def _ease(arm: ArmModel, q: Array) -> Array:
    """Higher for postures near home and away from the limits and singularities."""
    travel = np.max(np.abs(q - arm.home), axis=1)
    room = np.min(np.minimum(q - arm.lower, arm.upper - q), axis=1)
    smallest = np.linalg.svd(arm.chain.jacobian(q), compute_uv=False)[:, -1]
    return np.asarray(-0.2 * travel + 0.3 * np.minimum(room, 0.5) + np.minimum(smallest, 0.1))


def _about(azimuth: float, angle: float) -> Array:
    """Rotation by ``angle`` about the axis at ``azimuth`` in the x-y plane."""
    return rotation_from_vector(angle * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))


def _aimed(T_P_E: Array, point: Array) -> Array:
    """The camera turned about its lens by the smallest rotation that brings its axis onto the point."""
    return transform(smallest_rotation(T_P_E[:3, 2], point - T_P_E[:3, 3]) @ T_P_E[:3, :3], T_P_E[:3, 3])
