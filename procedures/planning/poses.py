"""Selection of poses (paper, section 4.1): optical axes over the workspace and positions of the target along them.

Poses start from random joint angles, so they spread over what the arms can reach: a random pose of the active arm
gives an axis (step 1), eqs. (15) and (16) the positions along it (step 2, with i = 0..m-1 and a step of
(L_max - L_min)/(m-1)), and the random pose of the passive arm nearest to such a position an orientation of the
target within the angle constraint, eq. (13) (step 3); a few Newton steps bring the feature point onto the axis.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from dualcal_hal.errors import NoPlan
from dualcal_hal.kinematics import random_joints
from dualcal_hal.session.captures import Use
from dualcal_hal.transforms import Array, Mask, inverse, skew
from procedures.planning.belief import Belief
from procedures.planning.model import ArmModel, CellModel, Posture
from procedures.planning.plan import Plan, PlannedConstraint, PlannedPosition, turned_about_two_axes
from procedures.planning.ways import WayFinder

ROOM = 0.015
"""The passive arm can still move this far (m) each way in the camera plane: the servo's room."""

LEAST_TURN = np.deg2rad(30.0)
"""Flange orientations of the calibration's constraints are turned by this much about two axes (rad)."""

_PASSIVE_SAMPLES = 12000
_AXIS_SAMPLES = 3000
_AXES_AT_ONCE = 24
_AXES_TRIED = 1500
_PICKS = 6  # postures of the passive arm tried for each position
_NEIGHBOURS = 32
_NEAR = 0.10  # m from a position within which a sampled posture is a start for it
_NORMAL_WEIGHT = 0.15  # m per unit of direction, to measure nearness in position and direction together
_POOL = 2.5  # candidates to choose from, per constraint wanted


@dataclass(frozen=True, eq=False)
class Request:
    """How many constraints of a use, each with how many positions.

    Their names count from ``first_number``; ``captured`` are constraints of this use that there are already, which
    the new ones shall complete.
    """

    use: Use
    constraints: int
    positions: int
    first_number: int = 0
    captured: tuple[PlannedConstraint, ...] = ()


@dataclass(frozen=True, eq=False)
class _Candidate:
    active: Array
    passive: Array  # (m, n)
    tilt: Array
    distance: Array
    clearance: Array
    information: Array  # (12, 12)


class PosePlanner:
    """Draws poses for one belief; the same seed gives the same poses."""

    def __init__(self, model: CellModel, belief: Belief, ways: WayFinder, seed: Sequence[int]) -> None:
        self._model = model
        self._belief = belief
        self._ways = ways
        self._rng = np.random.default_rng(list(seed))
        self.refused: Counter[str] = Counter()

    def plan(self, requests: Sequence[Request], start: Posture, *, provisional: bool) -> Plan:
        """Constraints for all requests, in an order in which each can be reached from the one before.

        Raises NoPlan, which says how many candidates failed which condition.
        """
        planned: list[PlannedConstraint] = []
        posture = start
        for request in requests:
            pool = self._candidates(request)
            chosen, posture = self._reachable_choice(pool, request, posture)
            planned += chosen
        return Plan(tuple(planned), dict(self.refused), provisional, self._belief.source)

    # -- candidates ---------------------------------------------------------------------------------------------

    def _candidates(self, request: Request) -> list[_Candidate]:
        wanted = int(np.ceil(_POOL * request.constraints)) + 2
        pool: list[_Candidate] = []
        tried = 0
        while len(pool) < wanted and tried < _AXES_TRIED:
            axes = self._axes()
            for first in range(0, len(axes), _AXES_AT_ONCE):
                batch = axes[first : first + _AXES_AT_ONCE]
                tried += len(batch)
                pool += self._along(batch, request.positions)
                if len(pool) >= wanted or tried >= _AXES_TRIED:
                    break
            if len(axes) == 0:
                tried += _AXIS_SAMPLES // 10
        if len(pool) < request.constraints:
            raise NoPlan(self._refusal(request, len(pool)))
        return pool

    def _axes(self) -> Array:
        """Joint angles (k, n) of the active arm whose optical axis runs through what the passive arm reaches."""
        arm = self._model.active
        q = random_joints(self._rng, _AXIS_SAMPLES, arm.lower, arm.upper)
        T_P_E = self._model.camera_in_passive(q, self._belief)
        camera, axis = T_P_E[:, :3, 3], T_P_E[:, :3, 2]
        served = np.ones(len(q), dtype=bool)
        for distance in (self._model.distance[1], self._model.distance[0]):
            looked_at = np.hstack([camera + distance * axis, -_NORMAL_WEIGHT * axis])
            nearest = np.full(len(q), np.inf)
            nearest[served] = self._library.tree.query(looked_at[served])[0]
            served &= nearest < _NEAR
        self.refused["the axis misses what the passive arm reaches"] += int(np.sum(~served))
        q = q[served]
        clear = self._ways.geometry.active.own_clearance(q) >= self._model.margin if len(q) else served[:0]
        self.refused["the active arm is too close to itself or the floor"] += int(np.sum(~clear))
        return np.asarray(q[clear])

    def _along(self, active: Array, positions: int) -> list[_Candidate]:
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
        passive = np.stack([_least_travel(q[k], usable[k]) for k in shown])
        roomy = self._has_room(active, passive, T_P_E)
        self._count("no room for alignment", roomy)
        return [self._candidate(active[k], passive[k], T_P_E[k], distance) for k in np.flatnonzero(roomy)]

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
        """Which reached postures (a, m, picks) show the target whole and keep clear."""
        model, which = self._model, np.nonzero(reached)
        T_E_T = inverse(T_P_E)[which[0]] @ model.target_in_passive(q[which])
        seen = model.in_view(T_E_T)
        self._count("the target is not wholly in view", seen)
        own = self._ways.geometry.passive.own_clearance(q[which]) if len(which[0]) else np.zeros(0)
        self._count("the passive arm is too close to itself or the floor", own[seen] >= model.margin)
        good = seen & (own >= model.margin)
        which = tuple(w[good] for w in which)
        usable = np.zeros(reached.shape, dtype=bool)
        if len(which[0]):
            between = self._ways.geometry.between(active[which[0]], q[which], self._belief.placement)
            self._count("the arms are too close to each other", between >= model.margin)
            usable[tuple(w[between >= model.margin] for w in which)] = True
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
        each = len(q) // len(active)
        which = np.repeat(room, each)
        own = self._ways.geometry.clearance(np.repeat(active, each, axis=0)[which], q[which], self._belief.placement)
        room[room] = np.all(own.reshape(-1, each) >= model.margin, axis=1)
        return np.asarray(room)

    def _candidate(self, active: Array, passive: Array, T_P_E: Array, distance: Array) -> _Candidate:
        model = self._model
        T_P_T = model.target_in_passive(passive)
        clearance = self._ways.geometry.clearance(active[None], passive, self._belief.placement)
        tilt = np.arccos(np.clip(-T_P_T[:, :3, 2] @ T_P_E[:3, 2], -1.0, 1.0))
        information = _information(T_P_E, self._belief, T_P_T[:, :3, 3])
        return _Candidate(active, passive, tilt, distance, clearance, information)

    # -- choice and order ---------------------------------------------------------------------------------------

    def _reachable_choice(
        self, pool: list[_Candidate], request: Request, start: Posture
    ) -> tuple[list[PlannedConstraint], Posture]:
        """The best-conditioned choice from the pool that can be visited in some order from ``start``."""
        known = self._known(request.captured)
        straight: dict[int, bool] = {}
        while True:
            chosen = _most_informative(pool, request.constraints, known)
            # Ways cost most to judge: only those of candidates that would be chosen are.
            straight.update({id(c): self._is_straight(c) for c in chosen if id(c) not in straight})
            lost, why = [c for c in chosen if not straight[id(c)]], "the way between two positions is not clear"
            if not lost:
                ordered, lost, end = self._order(chosen, start)
                why = "no clear way to the constraint"
            if not lost:
                break
            self.refused[why] += len(lost)
            pool = [candidate for candidate in pool if not any(candidate is other for other in lost)]
            if len(pool) < request.constraints:
                raise NoPlan(self._refusal(request, len(pool)))
        self._require_turns(ordered, request)
        names = range(request.first_number, request.first_number + len(ordered))
        return [_planned(c, f"{request.use}/{i:02d}", request.use) for i, c in zip(names, ordered, strict=True)], end

    def _is_straight(self, candidate: _Candidate) -> bool:
        """Whether the passive arm can go straight from each position to the next."""
        first = Posture.of(candidate.active, candidate.passive[0])
        return self._ways.clear(self._model.passive.name, first, candidate.passive[1:])

    def _order(self, chosen: list[_Candidate], start: Posture) -> tuple[list[_Candidate], list[_Candidate], Posture]:
        """Nearest first in joint space, each with a clear way from the one before; those never reached."""
        left, ordered, posture = list(chosen), [], start
        while left:
            here = np.array([*posture.active, *posture.passive])
            left.sort(key=lambda c: float(np.max(np.abs(np.concatenate([c.active, c.passive[0]]) - here))))
            for candidate in left:
                if self._ways.find(posture, Posture.of(candidate.active, candidate.passive[0])) is not None:
                    break
            else:
                break
            left = [other for other in left if other is not candidate]
            ordered.append(candidate)
            posture = Posture.of(candidate.active, candidate.passive[-1])
        return ordered, left, posture

    def _known(self, captured: Sequence[PlannedConstraint]) -> Array:
        """What captured constraints tell already, (12, 12)."""
        model, total = self._model, np.zeros((12, 12))
        for constraint in captured:
            T_P_E = model.camera_in_passive(constraint.active, self._belief)
            distances = np.array([[position.distance] for position in constraint.positions])
            total += _information(T_P_E, self._belief, T_P_E[:3, 3] + distances * T_P_E[:3, 2])
        return total

    def _require_turns(self, chosen: list[_Candidate], request: Request) -> None:
        if request.use != "calibration":
            return
        active = np.array([*(constraint.active for constraint in request.captured), *(c.active for c in chosen)])
        R = self._model.active.chain.forward(active)[:, :3, :3]
        turned = turned_about_two_axes(R)
        if turned < LEAST_TURN:
            self.refused["the flange is not turned by 30 degrees about two axes"] += 1
            raise NoPlan(self._refusal(request, 0))

    def _count(self, condition: str, kept: Mask) -> None:
        self.refused[condition] += int(kept.size - np.sum(kept))

    def _refusal(self, request: Request, found: int) -> str:
        counts = "; ".join(f"{what}: {count}" for what, count in self.refused.most_common() if count)
        return (
            f"no plan: {found} of {request.constraints} {request.use} constraints with {request.positions} positions "
            f"found. Candidates that failed a condition: {counts}"
        )

    @cached_property
    def _library(self) -> _Library:
        arm = self._model.passive
        q = random_joints(self._rng, _PASSIVE_SAMPLES, arm.lower, arm.upper)
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
    """Of usable postures (m, picks, n) one each, (m, n), with the least largest joint travel from one to the next."""
    positions = len(q)
    cost = np.where(usable[0], 0.0, np.inf)
    came_from = np.zeros(usable.shape, dtype=int)
    for i in range(1, positions):
        travel = np.max(np.abs(q[i][None] - q[i - 1][:, None]), axis=2) + cost[:, None]
        came_from[i] = np.argmin(travel, axis=0)
        cost = np.where(usable[i], np.min(travel, axis=0), np.inf)
    pick = int(np.argmin(cost))
    picks = [pick]
    for i in range(positions - 1, 0, -1):
        pick = int(came_from[i, pick])
        picks.append(pick)
    return np.stack([q[i, pick] for i, pick in enumerate(reversed(picks))])


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


def _most_informative(pool: list[_Candidate], count: int, known: Array) -> list[_Candidate]:
    """Greedy choice by the determinant of the information (D-optimality) on top of what is known already."""
    total = known + 1e-3 * np.eye(12)
    left, chosen = list(pool), []
    for _ in range(min(count, len(left))):
        gains = np.linalg.slogdet(total + np.stack([c.information for c in left]))[1]
        best = left.pop(int(np.argmax(gains)))
        total = total + best.information
        chosen.append(best)
    return chosen


def _planned(candidate: _Candidate, name: str, use: Use) -> PlannedConstraint:
    positions = tuple(
        PlannedPosition(tuple(map(float, q)), float(d), float(t), float(c))
        for q, d, t, c in zip(candidate.passive, candidate.distance, candidate.tilt, candidate.clearance, strict=True)
    )
    return PlannedConstraint(name, use, tuple(map(float, candidate.active)), positions)
