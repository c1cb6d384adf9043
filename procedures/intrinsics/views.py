"""Where to show the target: over the whole image, tilted and at several distances, so that the lens can be told.

The active arm rests; the passive arm holds the target where it projects onto a lattice of places in the image. Of all
that is reached, in view and clear, those are chosen that say most of the parameters (the determinant of their
information) and bring corners where there are none yet. Where the passive arm does not reach all of the image, the
active arm rests in another posture for what is missing.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dualcal_hal.camera import Intrinsics
from dualcal_hal.kinematics import random_joints
from dualcal_hal.target import Charuco
from dualcal_hal.transforms import Array, Mask, inverse, rotation_from_vector, smallest_rotation, transform
from procedures.intrinsics.coverage import GRID, corners_in_cells
from procedures.intrinsics.estimate import LEAST_CORNERS, information_of
from procedures.planning.advice import counted
from procedures.planning.belief import Belief
from procedures.planning.model import CellModel, Posture
from procedures.planning.order import shortest_order
from procedures.planning.sight import in_sight
from procedures.planning.ways import WayFinder

PRIOR_SIGMAS = np.array([0.05, 0.05, 20.0, 20.0, 0.3, 0.3, 0.01, 0.01, 0.3])
"""What is known of the parameters before: of fx and fy in parts of them, of the others as they are."""

TILTS = np.deg2rad([20.0, 38.0])
"""rad by which the target leans from the ray to it; at most the procedure's largest tilt."""
_AZIMUTHS = 8
_DISTANCES = 3
_PLACES = (7, 5)
"""Columns and rows of the places in the image."""
CORNER_SIGMA = 0.05
"""px per axis, by which views are weighed against what is known before."""
_NEW_CELL = 0.5
"""What a cell without corners is worth, beside the logarithm of the determinant."""
_LIBRARY = 8000
_NORMAL_WEIGHT = 0.15  # m per unit of direction, to measure nearness in position and direction together
_STARTS = 3  # of the library, for each pose
_MISSING_ALLOWED = 0.06  # of the places, before the active arm rests elsewhere for them
_FITTINGS = 3  # times that a pose is shifted to where it belongs in the image
_INSIDE = 1.0  # px, for what a shift leaves
_CHARUCO_BEYOND = 0.35  # of its extent, by which a target that is known by its parts may leave the image
_CHARUCO_SEEN = 0.4  # of its corners, at least
_RESTS = (
    (0.0, 0.0, 0.0),
    (-0.1, 0.0, 0.0),
    (0.1, 0.0, 0.0),
    (0.0, 12.0, 0.0),
    (0.0, -12.0, 0.0),
    (0.0, 0.0, 12.0),
    (0.0, 0.0, -12.0),
    (-0.1, 0.0, 20.0),
    (-0.1, 0.0, -20.0),
    (-0.1, 20.0, 0.0),
    (-0.1, -20.0, 0.0),
)
"""How the camera may stand otherwise than at the stand-off: m along its axis, deg about its x and y."""


Place = tuple[int, int]
"""Column and row among the places in the image."""


@dataclass(frozen=True, eq=False)
class Shown:
    """What has been seen, or is sure to be: information (9, 9) of the parameters, and cells (rows, columns) of the
    image with corners."""

    information: Array
    cells: NDArray[np.bool_]

    @staticmethod
    def of(corners: Sequence[Array], poses: Sequence[Array], points: Array, intrinsics: Intrinsics) -> Shown:
        """Of views: corners (n, 2) px of the target's ``points`` (n, 3), and ``T_E_T`` (4, 4) of each."""
        total = np.diag(1.0 / (PRIOR_SIGMAS * [*np.diag(intrinsics.matrix)[:2], 1, 1, 1, 1, 1, 1, 1]) ** 2)
        shown = Shown(total, np.zeros(GRID[::-1], dtype=bool))
        for pixels, T_E_T in zip(corners, poses, strict=True):
            seen = np.isfinite(pixels[:, 0])
            if seen.sum() >= LEAST_CORNERS:
                says = information_of(T_E_T, points[seen], intrinsics) / CORNER_SIGMA**2
                shown = shown.with_view(says, corners_in_cells(pixels, intrinsics.size) > 0)
        return shown

    def with_view(self, says: Array, cells: NDArray[np.bool_]) -> Shown:
        """And what another view says."""
        return Shown(self.information + says, self.cells | cells)


@dataclass(frozen=True, eq=False)
class _Candidate:
    posture: Posture
    place: Place
    information: Array
    cells: NDArray[np.bool_]


class ViewPlanner:
    """Chooses views for one belief and one belief of the lens; the same seed gives the same views.

    margin: px that corners stay inside the image; refused: how many poses failed which condition.
    """

    def __init__(self, model: CellModel, belief: Belief, ways: WayFinder, margin: float, seed: Sequence[int]) -> None:
        self._model, self._belief, self._ways = model, belief, ways
        self._margin = margin
        self._rng = np.random.default_rng(list(seed))
        self.refused: Counter[str] = Counter()

    def choose(self, count: int, shown: Shown, at: Posture, start: Posture) -> list[Posture]:
        """So many views, or fewer where no more are possible, in an order of short travel from ``start``.

        at: the stand-off, where camera and target face each other.
        """
        every = set(itertools.product(range(_PLACES[0]), range(_PLACES[1])))
        missing, candidates = every, list[_Candidate]()
        rests = list(self._rests(at))
        found = [self._candidates(rests[0], at, missing)] if rests else []
        while found:
            best = max(found, key=lambda those: len({candidate.place for candidate in those}))
            missing = missing - {candidate.place for candidate in best}
            candidates += best
            if not best or len(missing) <= _MISSING_ALLOWED * len(every):
                break
            found = [self._candidates(q, at, missing) for q in rests[1:]]
        return self._in_order(_chosen(candidates, count, shown), start)

    def why_refused(self) -> str:
        """How many poses failed which condition, in words."""
        return counted(self.refused)

    def _rests(self, at: Posture) -> Iterator[Array]:
        """Joint angles (n,) of the active arm, the stand-off's first, that are clear of what stands about it."""
        arm, T_H_E = self._model.active, self._belief.T_H_E
        T_A_E = arm.chain.forward(at.active) @ T_H_E
        moved = [
            T_A_E @ transform(rotation_from_vector(np.deg2rad([about_x, about_y, 0.0])), [0.0, 0.0, along])
            for along, about_x, about_y in _RESTS
        ]
        q, reached = arm.chain.inverse(
            np.array(moved) @ inverse(T_H_E), np.tile(at.active, (len(moved), 1)), arm.lower, arm.upper
        )
        clear = self._model.geometry.active.own_clearance(q) >= self._ways.margin
        yield from q[reached & clear]

    def _candidates(self, rest: Array, at: Posture, places: set[Place]) -> list[_Candidate]:
        """Views from one posture of the active arm (n,), with the target in some of the places."""
        model, belief = self._model, self._belief
        T_P_E = model.camera_in_passive(rest, belief)
        where, goals = self._goals(sorted(places))
        T_P_T, starts = self._turned(T_P_E @ goals, at)
        T_E_T = self._fitted(inverse(T_P_E) @ T_P_T, np.array(where) / (np.array(_PLACES) - 1))
        q, reached = self._reached(T_P_E @ T_E_T, starts)
        self.refused["the passive arm does not get there"] += int(np.sum(~np.any(reached, axis=1)))
        # Of the ways to hold the target so, the one nearest to the stand-off's.
        away = np.where(reached, np.max(np.abs(q - np.array(at.passive)), axis=2), np.inf)
        which = np.flatnonzero(np.any(reached, axis=1))
        q = q[which, np.argmin(away[which], axis=1)]
        pixels = model.project_board(inverse(T_P_E) @ model.target_in_passive(q))
        inside = self._inside(pixels)
        seen = self._are_enough(inside)
        self.refused["the target is not in view"] += int(np.sum(~seen))
        which, q, pixels, inside = which[seen], q[seen], pixels[seen], inside[seen]
        clear = self._are_clear(rest, q)
        return [
            self._candidate(where[k], rest, q_p, np.where(seen_of[:, None], corners, np.nan))
            for k, q_p, corners, seen_of in zip(which[clear], q[clear], pixels[clear], inside[clear], strict=True)
        ]

    def _candidate(self, place: Place, rest: Array, q_p: Array, corners: Array) -> _Candidate:
        model = self._model
        T_E_T = inverse(model.camera_in_passive(rest, self._belief)) @ model.target_in_passive(q_p)
        points = model.board.corners[np.isfinite(corners[:, 0])]
        says = information_of(T_E_T, points, model.intrinsics) / CORNER_SIGMA**2
        cells = corners_in_cells(corners, model.intrinsics.size) > 0
        return _Candidate(Posture.of(rest, q_p), place, says, cells)

    def _goals(self, places: Sequence[Place]) -> tuple[list[Place], Array]:
        """The place and, roughly, ``T_E_T`` (4, 4) of each wanted view; how it is turned about its normal is open.

        Flat to the ray and tilted to all sides, by turns less and more.
        """
        tilts = np.minimum(TILTS, self._model.tilt_max)
        leans = [(0.0, 0.0), *((float(tilts[i % 2]), 2 * np.pi * i / _AZIMUTHS) for i in range(_AZIMUTHS))]
        intrinsics = self._model.intrinsics
        where, goals = [], []
        for place, distance in itertools.product(places, np.linspace(*self._model.distance, _DISTANCES)):
            pixel = np.array(place) / (np.array(_PLACES) - 1) * (np.array(intrinsics.size) - 1)
            ray = np.linalg.solve(intrinsics.matrix, [*pixel, 1.0])
            facing = smallest_rotation([0.0, 0.0, 1.0], ray)
            for tilt, azimuth in leans:
                lean = tilt * np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
                R = facing @ rotation_from_vector(lean) @ np.diag([1.0, -1.0, -1.0])
                where.append(place)
                goals.append(transform(R, ray * distance))
        return where, np.array(goals)

    def _fitted(self, T_E_T: Array, share: Array) -> Array:
        """Poses (k, s, 4, 4) shifted so that the corners fill the image from edge to edge as ``share`` (k, 2) goes from
        0 to 1 along its width and height."""
        intrinsics, T_E_T = self._model.intrinsics, T_E_T.copy()
        size, focal = np.array(intrinsics.size), np.diag(intrinsics.matrix)[:2]
        beyond = _CHARUCO_BEYOND if isinstance(self._model.board, Charuco) else 0.0
        for _ in range(_FITTINGS):
            pixels = self._model.project_board(T_E_T)
            low, extent = pixels.min(axis=-2), np.ptp(pixels, axis=-2)
            least = self._margin + _INSIDE - beyond * extent
            wanted = least + share[:, None] * (size - 1 - 2 * least - extent)
            T_E_T[..., :2, 3] += (wanted - low) / focal * T_E_T[..., 2:3, 3]
        return T_E_T

    def _turned(self, T_P_T: Array, at: Posture) -> tuple[Array, Array]:
        """The goals (k, s, 4, 4), turned about their normals as postures near them hold the target, and these
        postures (k, s, n): the stand-off's, and random ones."""
        library, tree = self._library
        arm = self._model.passive
        where = np.hstack([T_P_T[:, :3, 3], _NORMAL_WEIGHT * T_P_T[:, :3, 2]])
        _, index = tree.query(where, k=_STARTS)
        starts = np.concatenate([np.tile(np.array(at.passive), (len(T_P_T), 1, 1)), library[index]], axis=1)
        held = self._model.target_in_passive(arm.nearest_turn(starts, np.array(at.passive)))[..., :3, :3]
        normal = np.broadcast_to(T_P_T[:, None, :3, 2], held[..., 2].shape)
        goals = np.tile(T_P_T[:, None], (1, starts.shape[1], 1, 1))
        goals[..., :3, :3] = _with_normal(held, normal)
        return goals, starts

    def _reached(self, T_P_T: Array, starts: Array) -> tuple[Array, Mask]:
        arm = self._model.passive
        flanges = (T_P_T @ inverse(self._model.T_F_T)).reshape(-1, 4, 4)
        flat = starts.reshape(-1, starts.shape[-1])
        q, reached = arm.chain.inverse(flanges, flat, arm.lower, arm.upper, iterations=20)
        return q.reshape(starts.shape), reached.reshape(starts.shape[:-1])

    @cached_property
    def _library(self) -> tuple[Array, cKDTree]:
        """Random postures (k, n) of the passive arm, and where and which way they hold the target."""
        arm = self._model.passive
        q = arm.nearest_turn(random_joints(self._rng, _LIBRARY, arm.lower, arm.upper), arm.home)
        T_P_T = self._model.target_in_passive(q)
        return q, cKDTree(np.hstack([T_P_T[:, :3, 3], _NORMAL_WEIGHT * T_P_T[:, :3, 2]]))

    def _inside(self, pixels: Array) -> Mask:
        """Which corners (k, n) of ``pixels`` (k, n, 2) are inside the image by the margin."""
        size = np.array(self._model.intrinsics.size)
        return np.asarray(np.all((pixels >= self._margin) & (pixels <= size - 1 - self._margin), axis=-1))

    def _are_enough(self, inside: Mask) -> Mask:
        """Of corners (k, n) inside: a part of a checkerboard does not say which part it is."""
        if isinstance(self._model.board, Charuco):
            return np.asarray(inside.sum(axis=1) >= max(LEAST_CORNERS, _CHARUCO_SEEN * inside.shape[1]))
        return np.asarray(np.all(inside, axis=1))

    def _are_clear(self, rest: Array, q: Array) -> NDArray[np.intp]:
        """The numbers of those postures of the passive arm (k, n) that keep clear and hide nothing."""
        model, margin = self._model, self._ways.margin
        clear = model.geometry.passive.own_clearance(q) >= margin if len(q) else np.zeros(0, dtype=bool)
        self.refused["the passive arm is too close to itself or what stands about it"] += int(np.sum(~clear))
        which = np.flatnonzero(clear)
        if len(which):
            apart = model.geometry.between(rest[None], q[which], self._belief.placement) >= margin
            self.refused["the arms are too close to each other"] += int(np.sum(~apart))
            which = which[apart]
        if len(which):
            free = in_sight(model, np.tile(rest, (len(which), 1)), q[which], self._belief)
            self.refused["an arm or a fixture hides the target"] += int(np.sum(~free))
            which = which[free]
        return which

    def _in_order(self, chosen: Sequence[Posture], start: Posture) -> list[Posture]:
        """By the seconds that straight moves take; both arms' add up, as they move one after the other."""
        a, p = self._model.active, self._model.passive
        if not chosen:
            return []
        q_a, q_p = np.array([view.active for view in chosen]), np.array([view.passive for view in chosen])
        first = a.move_time(np.array(start.active), q_a) + p.move_time(np.array(start.passive), q_p)
        between = a.move_time(q_a[:, None], q_a) + p.move_time(q_p[:, None], q_p)
        return [chosen[i] for i in shortest_order(first, between)]


def _with_normal(held: Array, normal: Array) -> Array:
    """Rotations (..., 3, 3) turned by the smallest angle so that their z axes are the normals (..., 3)."""
    axis = np.cross(held[..., 2], normal)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine, np.sum(held[..., 2] * normal, axis=-1, keepdims=True))
    turn = rotation_from_vector(axis / np.maximum(sine, 1e-12) * angle)
    return np.asarray(turn @ held)


def _chosen(candidates: Sequence[_Candidate], count: int, shown: Shown) -> list[Posture]:
    """The best so many, one after the other."""
    left, chosen = list(candidates), list[Posture]()
    while left and len(chosen) < count:
        says = np.array([candidate.information for candidate in left])
        new = np.array([np.sum(candidate.cells & ~shown.cells) for candidate in left])
        gains = np.linalg.slogdet(shown.information + says)[1] + _NEW_CELL * new
        best = left.pop(int(np.argmax(gains)))
        shown = shown.with_view(best.information, best.cells)
        chosen.append(best.posture)
    return chosen
