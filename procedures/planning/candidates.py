"""Candidates for constraints (paper, section 4.1): optical axes, and positions of the target along each.

Poses start from random joint angles, so they spread over what the arms can reach: a random pose of the active arm
gives an axis (step 1), eqs. (15) and (16) the positions along it (step 2, with i = 0..m-1 and a step of
(L_max - L_min)/(m-1)), and the random pose of the passive arm nearest to such a position an orientation of the
target within the angle constraint, eq. (13) (step 3); a few Newton steps bring the feature point onto the axis.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from dualcal_hal.geometry import BETWEEN_SAMPLES, ArmBody
from dualcal_hal.kinematics import random_joints
from dualcal_hal.transforms import Array, Mask, inverse
from procedures.planning.belief import Belief
from procedures.planning.choice import Knowledge
from procedures.planning.model import ArmModel, CellModel
from procedures.planning.obstacles import closer_than
from procedures.planning.sight import in_sight

ROOM = 0.015
"""The passive arm can still move this far (m) each way in the camera plane: the servo's room."""

_PASSIVE_SAMPLES = 12000
_AXIS_SAMPLES = 3000
_AXES_AT_ONCE = 24
_PICKS = 6  # postures of the passive arm tried for each position
_NEIGHBOURS = 32
_NEAR = 0.10  # m from a position within which a sampled posture is a start for it
_NORMAL_WEIGHT = 0.15  # m per unit of direction, to measure nearness in position and direction together


@dataclass(frozen=True, eq=False)
class Candidate:
    """One posture of the active arm and one of the passive arm for each of m positions, the farthest first.

    active: (n,) rad; passive: (m, n) rad; distance: (m,) m; tilt: (m,) rad; clearance: (m,) m.
    """

    active: Array
    passive: Array
    distance: Array
    tilt: Array
    clearance: Array
    knowledge: Knowledge


class CandidateSource:
    """Draws candidates for one belief and counts in ``refused`` those that failed a condition."""

    def __init__(self, model: CellModel, belief: Belief, rng: np.random.Generator) -> None:
        self._model = model
        self._margin = model.margin + BETWEEN_SAMPLES
        self._belief = belief
        self._rng = rng
        self.refused: Counter[str] = Counter()
        self._axes_left = np.zeros((0, model.active.chain.joints))

    def draw(self, positions: int, wanted: int, most_axes: int) -> list[Candidate]:
        """So many candidates or a few more; fewer if ``most_axes`` axes have been tried for them."""
        found: list[Candidate] = []
        tried = 0
        while len(found) < wanted and tried < most_axes:
            if len(self._axes_left) == 0:
                self._axes_left = self._axes()
                tried += _AXIS_SAMPLES // 100  # axes that nothing can be shown to cost something, too
            batch, self._axes_left = self._axes_left[:_AXES_AT_ONCE], self._axes_left[_AXES_AT_ONCE:]
            tried += len(batch)
            if len(batch):
                found += self._along(batch, positions)
        return found

    def _axes(self) -> Array:
        """Joint angles (k, n) of the active arm whose optical axis runs through what the passive arm reaches."""
        arm = self._model.active
        q = arm.nearest_turn(random_joints(self._rng, _AXIS_SAMPLES, arm.lower, arm.upper), arm.home)
        T_P_E = self._model.camera_in_passive(q, self._belief)
        camera, axis = T_P_E[:, :3, 3], T_P_E[:, :3, 2]
        served = np.ones(len(q), dtype=bool)
        for distance in (self._model.distance[1], self._model.distance[0]):
            looked_at = np.hstack([camera + distance * axis, -_NORMAL_WEIGHT * axis])
            nearest = np.full(len(q), np.inf)
            nearest[served] = self._library.tree.query(looked_at[served], distance_upper_bound=_NEAR)[0]
            served &= nearest < _NEAR
        self.refused["the axis misses what the passive arm reaches"] += int(np.sum(~served))
        q = q[served]
        clear = self._model.geometry.active.own_clearance(q) >= self._margin if len(q) else served[:0]
        self._count_own("active", self._model.geometry.active, q[~clear])
        return np.asarray(q[clear])

    def _along(self, active: Array, positions: int) -> list[Candidate]:
        """Those of the given axes along which the target can be shown at all positions."""
        T_P_E = self._model.camera_in_passive(active, self._belief)
        low, high = self._model.distance
        distance = np.linspace(high, low, positions)
        starts, goals, found = self._passive_starts(T_P_E, distance)
        shape = found.shape  # (axes, positions, picks)
        q, reached = _solve(
            self._model.passive, self._model, goals.reshape(-1, 4, 4), starts.reshape(-1, starts.shape[-1])
        )
        q, reached = q.reshape(*shape, -1), reached.reshape(shape) & found
        self._count("the passive arm does not reach the position", reached)
        usable = reached & self._usable(active, q, T_P_E, reached)
        shown = np.flatnonzero(np.all(np.any(usable, axis=2), axis=1))
        if len(shown) == 0:
            return []
        active, T_P_E = active[shown], T_P_E[shown]
        passive = np.stack([self._unwound(_least_travel(q[k], usable[k])) for k in shown])
        roomy = self._has_room(active, passive, T_P_E)
        self._count("no room for alignment", roomy)
        return [self._candidate(active[k], passive[k], T_P_E[k], distance) for k in np.flatnonzero(roomy)]

    def _unwound(self, q: Array) -> Array:
        """Positions (m, n) with joints turned by whole turns to where they are nearest to the position before."""
        for i in range(1, len(q)):
            q[i] = self._model.passive.nearest_turn(q[i], q[i - 1])
        return q

    def _passive_starts(self, T_P_E: Array, distance: Array) -> tuple[Array, Array, Mask]:
        """Starts (a, m, picks, n) and target poses (a, m, picks, 4, 4) near library postures, and which exist."""
        library, rng = self._library, self._rng
        axis = T_P_E[:, None, :3, 2]
        points = T_P_E[:, None, :3, 3] + distance[:, None] * axis
        shape = points.shape[:2]
        normal = -_tilted(np.broadcast_to(axis, points.shape), self._model.tilt_max, rng)
        _, index = library.tree.query(np.concatenate([points, _NORMAL_WEIGHT * normal], axis=-1), k=_NEIGHBOURS)
        near = np.linalg.norm(library.T_P_T[index, :3, 3] - points[:, :, None], axis=-1) < _NEAR
        facing = -np.einsum("amki,ami->amk", library.T_P_T[index, :3, 2], np.broadcast_to(axis, points.shape))
        allowed = near & (facing > np.cos(self._model.tilt_max))
        order = np.argsort(np.where(allowed, rng.random(allowed.shape), 2.0), axis=-1)[..., :_PICKS]
        index = np.take_along_axis(index, order, axis=-1)
        found = np.take_along_axis(allowed, order, axis=-1)
        self._count("no posture within the tilt allowed", np.any(found, axis=-1))
        goals = library.T_P_T[index].copy()
        goals[..., :3, 3] = points[:, :, None]
        assert found.shape[:2] == shape
        return library.q[index], goals, found

    def _usable(self, active: Array, q: Array, T_P_E: Array, reached: Mask) -> Mask:
        """Which reached postures (a, m, picks) show the target whole and unhidden, and keep clear."""
        model, which = self._model, np.nonzero(reached)
        T_E_T = inverse(T_P_E)[which[0]] @ model.target_in_passive(q[which])
        seen = model.in_view(T_E_T)
        self._count("the target is not wholly in view", seen)
        own = self._model.geometry.passive.own_clearance(q[which]) if len(which[0]) else np.zeros(0)
        self._count_own("passive", self._model.geometry.passive, q[which][seen & (own < self._margin)])
        good = seen & (own >= self._margin)
        which = tuple(w[good] for w in which)
        usable = np.zeros(reached.shape, dtype=bool)
        if len(which[0]):
            between = self._model.geometry.between(active[which[0]], q[which], self._belief.placement)
            self._count("the arms are too close to each other", between >= self._margin)
            which = tuple(w[between >= self._margin] for w in which)
            free = in_sight(model, active[which[0]], q[which], self._belief)
            self._count("an arm or a fixture hides the target", free)
            usable[tuple(w[free] for w in which)] = True
        return usable

    def _has_room(self, active: Array, passive: Array, T_P_E: Array) -> Mask:
        """Which axes (a, n) leave room at all their positions (a, m, n) to move each way in the camera plane."""
        model = self._model
        steps = ROOM * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        shifts = steps @ np.swapaxes(T_P_E[:, None, :3, :2], 2, 3)  # (a, 1, 4, 3)
        goals = np.repeat(model.target_in_passive(passive)[:, :, None], len(steps), axis=2)
        goals[..., :3, 3] += shifts
        starts = np.repeat(passive[:, :, None], len(steps), axis=2)
        q, reached = _solve(model.passive, model, goals.reshape(-1, 4, 4), starts.reshape(-1, starts.shape[-1]))
        room = np.all(reached.reshape(len(active), -1), axis=1)
        if not np.any(room):
            return np.asarray(room)
        each = len(q) // len(active)
        which = np.repeat(room, each)
        own = self._model.geometry.clearance(np.repeat(active, each, axis=0)[which], q[which], self._belief.placement)
        room[room] = np.all(own.reshape(-1, each) >= self._margin, axis=1)
        return np.asarray(room)

    def _candidate(self, active: Array, passive: Array, T_P_E: Array, distance: Array) -> Candidate:
        model = self._model
        T_P_T = model.target_in_passive(passive)
        clearance = self._model.geometry.clearance(active[None], passive, self._belief.placement)
        tilt = np.arccos(np.clip(-T_P_T[:, :3, 2] @ T_P_E[:3, 2], -1.0, 1.0))
        knowledge = Knowledge.of(model.active.chain.forward(active), self._belief, distance)
        return Candidate(active, passive, distance, tilt, clearance, knowledge)

    def _count(self, condition: str, kept: Mask) -> None:
        self.refused[condition] += int(kept.size - np.sum(kept))

    def _count_own(self, role: str, body: ArmBody, close: Array) -> None:
        """Postures (k, n) that are too close to something of the arm's own, by what that is."""
        for what, count in closer_than(self._margin, body, close).items():
            self.refused[f"the {role} arm is too close to {what}"] += count

    @cached_property
    def _library(self) -> _Library:
        arm = self._model.passive
        q = arm.nearest_turn(random_joints(self._rng, _PASSIVE_SAMPLES, arm.lower, arm.upper), arm.home)
        return _Library(q, self._model.target_in_passive(q))


@dataclass(frozen=True, eq=False)
class _Library:
    """Random postures of the passive arm, found by where the target is and which way it faces."""

    q: Array
    T_P_T: Array

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(np.hstack([self.T_P_T[:, :3, 3], _NORMAL_WEIGHT * self.T_P_T[:, :3, 2]]))


def _solve(arm: ArmModel, model: CellModel, T_P_T: Array, starts: Array) -> tuple[Array, Mask]:
    goals = T_P_T @ inverse(model.T_F_T)
    return arm.chain.inverse(goals, starts, arm.lower, arm.upper, iterations=12)


def _tilted(axis: Array, largest: float, rng: np.random.Generator) -> Array:
    """Directions (..., 3) turned away by random angles up to ``largest``, uniform on the cap."""
    cosine = rng.uniform(np.cos(largest), 1.0, axis.shape[:-1])
    azimuth = rng.uniform(0.0, 2 * np.pi, axis.shape[:-1])
    helper = np.where(np.abs(axis[..., :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    u = np.cross(axis, helper)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    v = np.cross(axis, u)
    sine = np.sqrt(1.0 - cosine**2)
    sideways = np.cos(azimuth)[..., None] * u + np.sin(azimuth)[..., None] * v
    return np.asarray(cosine[..., None] * axis + sine[..., None] * sideways)


def _least_travel(q: Array, usable: Mask) -> Array:
    """Of usable postures (m, picks, n) one each, (m, n), with the least largest joint travel from one to the next.

    Whole turns do not count as travel.
    """
    positions = len(q)
    cost = np.where(usable[0], 0.0, np.inf)
    came_from = np.zeros(usable.shape, dtype=int)
    for i in range(1, positions):
        apart = np.abs(q[i][None] - q[i - 1][:, None]) % (2 * np.pi)
        travel = np.max(np.minimum(apart, 2 * np.pi - apart), axis=2) + cost[:, None]
        came_from[i] = np.argmin(travel, axis=0)
        cost = np.where(usable[i], np.min(travel, axis=0), np.inf)
    pick = int(np.argmin(cost))
    picks = [pick]
    for i in range(positions - 1, 0, -1):
        pick = int(came_from[i, pick])
        picks.append(pick)
    return np.stack([q[i, pick] for i, pick in enumerate(reversed(picks))])
