"""First values without a nominal: the camera's pose at each arrival, then both transforms in closed form.

The captures of an arrival have known places in P, so together they are one target that is not plane. Poses are refined
within their arrival with captures that do not fit weighed down, then the cell is, with arrivals that do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.transforms import Array, Mask, apply, inverse, rotation_angle
from procedures.estimation.degenerate import Degenerate
from procedures.estimation.projection import undistort
from procedures.estimation.refined.closed_form import solve
from procedures.estimation.refined.data import Indices
from procedures.estimation.refined.model import Model, marginalised
from procedures.estimation.refined.motion import adjoint, motion_between, moved
from procedures.estimation.refined.resection import camera_poses, few_point_poses, plane_poses, resect

# How far off, in sigmas rms, a capture or an arrival may be without being weighed down, step by step: a first value is
# far from what all agree on, and at the end only those that fit should decide.
_POSE_SCALES = (100.0, 30.0, 10.0, 5.0, 3.0)
_CELL_SCALES = (100.0, 30.0, 10.0, 5.0, 3.0, 3.0, 3.0)

# Of a target's extent across a line or a plane to that along it, from where it is not on one: feature points aligned
# to the optical axis come to 0.005, plane boards at different distances to 0.1.
_THICK = 0.02
_FEWEST_LINEAR, _FEWEST_POINTS = 6, 3

_WELL = 9.0  # squares in units of sigma, of a number: all fit, there is nothing to weigh down

_MOST_POSES = 3  # kept of an arrival
_SAME_TURN, _SAME_PLACE = np.radians(1.0), 0.01
_WORSE = 3.0  # a pose whose captures are this much farther off in the logarithm of their squares is not kept
_FEWEST_SETS, _MOST_PAIRS = 20, 1000  # sets of three arrivals, and their comparisons with all poses
_MOST_STARTS = 6


@dataclass(frozen=True)
class Poses:
    """Candidates for T_P_E (c, 4, 4) of arrivals (c,); loss (c,); normal (c, 6, 6): information on it from captures
    that fit. Of each candidate with each capture of its arrival, in pairs (p,): of, which: both; flipped: whether it
    fits from the other end of its corners; weights: 1 if it fits.
    """

    arrival: Indices
    T_P_E: Array
    loss: Array
    normal: Array
    of: Indices
    which: Indices
    flipped: Mask
    weights: Array

    @property
    def optical_axes(self) -> Array:
        """(., 3): directions in P, of each arrival's best candidate."""
        return self.T_P_E[np.unique(self.arrival, return_index=True)[1], :3, 2]

    def only(self, chosen: Indices) -> Poses:
        place = np.full(len(self.arrival), -1, dtype=np.intp)
        place[chosen] = np.arange(len(chosen))
        kept = place[self.of] >= 0
        return Poses(
            self.arrival[chosen],
            self.T_P_E[chosen],
            self.loss[chosen],
            self.normal[chosen],
            place[self.of[kept]],
            self.which[kept],
            self.flipped[kept],
            self.weights[kept],
        )


@dataclass(frozen=True)
class Start:
    """T_P_A, T_H_E (4, 4); flipped (k,): captures whose corners are then listed from the other end; loss: how badly
    the arrivals fit; fits (k,): captures that do.
    """

    T_P_A: Array
    T_H_E: Array
    flipped: Mask
    loss: float
    fits: Mask


def camera_candidates(
    model: Model, order_known: Mask, board_poses: Sequence[ArrayLike | None] | None, thorough: bool
) -> Poses:
    """Poses of the camera at each arrival, from all points seen there together. Thorough: from each capture's board
    alone too, for arrivals whose captures do not fit together; else only for those with unknown order or where the
    points together are one plane. Raises Degenerate where nothing shows a pose.
    """
    T_P_T = model.T_P_F @ model.knowns.T_F_T
    rays, seen = seen_rays(model)
    seen &= np.isfinite(rays).all(axis=-1)
    target = _Target.of(model, apply(T_P_T, model.knowns.corners), seen)
    arrival, T_P_E = target.linear(rays)
    together = np.isin(np.arange(model.arrivals), arrival)
    unsure = np.bincount(model.arrival[~order_known], minlength=model.arrivals) > 0
    alone = np.flatnonzero((seen.sum(axis=1) >= 4) & (thorough | ~together | unsure)[model.arrival])
    if len(alone):
        boards = plane_poses(model.knowns.corners, rays[alone], seen[alone])
        for poses in (boards, boards[~order_known[alone]] @ HALF_TURN):
            of = alone if len(poses) == len(alone) else alone[~order_known[alone]]
            arrival = np.concatenate([arrival, np.repeat(model.arrival[of], 2)])
            T_P_E = np.concatenate([T_P_E, camera_poses(T_P_T[of][:, None], poses).reshape(-1, 4, 4)])
    for k, pose in enumerate(board_poses or ()):
        if pose is not None and thorough | ~together[model.arrival[k]]:
            given = np.asarray(pose, dtype=float).reshape(-1, 4, 4)
            arrival = np.concatenate([arrival, np.repeat(model.arrival[k], len(given))])
            T_P_E = np.concatenate([T_P_E, camera_poses(T_P_T[k], given)])
    for a in np.setdiff1d(np.flatnonzero(target.few), arrival if not thorough else model.arrival[alone]):
        of_arrival = seen & (model.arrival == a)[:, None]
        poses = inverse(few_point_poses(target.places[of_arrival], rays[of_arrival]))
        arrival = np.concatenate([arrival, np.repeat(a, len(poses))])
        T_P_E = np.concatenate([T_P_E, poses])
    if not len(arrival):
        raise Degenerate(target.why_not())
    return _distinct(model, _agreed(model, T_P_T, order_known, arrival, T_P_E))


@dataclass(frozen=True)
class _Target:
    """All that was seen at an arrival as one target: places (k, n, 3) in P of the corners that were ``seen`` (k, n);
    points (a,): how many; thick, flat (a,): whether they are not in one plane, and not on one line.
    """

    model: Model
    places: Array
    seen: Mask
    points: Indices
    thick: Mask
    flat: Mask

    @classmethod
    def of(cls, model: Model, places: Array, seen: Mask) -> _Target:
        points, spread = np.zeros(model.arrivals, dtype=np.intp), np.zeros((model.arrivals, 3))
        for a in range(model.arrivals):
            mine = places[seen & (model.arrival == a)[:, None]]
            points[a] = len(mine)
            if len(mine) >= _FEWEST_POINTS:
                spread[a] = np.linalg.svd(mine - mine.mean(axis=0), compute_uv=False)
        thick, flat = (spread[:, i] > _THICK * spread[:, 0] for i in (2, 1))
        return cls(model, places, seen, points, thick, flat)

    @property
    def few(self) -> Mask:
        """(a,): arrivals whose points show a pose, though perhaps not to the linear method."""
        return self.flat & (self.points >= _FEWEST_POINTS)

    def linear(self, rays: Array) -> tuple[Indices, Array]:
        """T_P_E of the arrivals with points enough, from all of these at once."""
        usable = np.flatnonzero(self.thick & (self.points >= _FEWEST_LINEAR))
        mine = np.flatnonzero(np.isin(self.model.arrival, usable))
        groups = np.searchsorted(usable, self.model.arrival[mine])
        seen = self.seen[mine]
        shown = np.where(seen[..., None], rays[mine], 0.0)
        T_E_P = resect(self.places[mine], shown, seen.astype(float), groups, len(usable))
        return usable, inverse(T_E_P)

    def why_not(self) -> str:
        """Where no arrival shows a pose."""
        if self.points.max(initial=0) < _FEWEST_POINTS:
            return (
                "at no arrival three points were seen, corners or feature points: take captures that show corners of"
                " the board, or more positions a constraint"
            )
        return (
            "the points seen at each arrival lie on one line, as feature points on the optical axis do, which shows"
            " neither how the camera is turned about that line nor where on it: take captures that show more corners of"
            " the board; method paper takes these two from the nominal"
        )


HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])


def seen_rays(model: Model) -> tuple[Array, Mask]:
    """(k, n, 2) normalised undistorted, NaN where there is no such point, and which corners were seen."""
    seen = model.seen.copy()
    centre = model.knowns.matrix[:2, 2]
    pixels = np.where(seen[..., None], model.pixels, centre)
    try:
        return undistort(pixels, model.knowns.matrix, model.knowns.distortion), seen
    except ValueError:
        rays = np.full(pixels.shape, np.nan)
        for k, corners in enumerate(pixels):
            try:
                rays[k] = undistort(corners, model.knowns.matrix, model.knowns.distortion)
            except ValueError:
                continue
        return rays, seen


def _agreed(model: Model, T_P_T: Array, order_known: Mask, arrival: Indices, T_P_E: Array) -> Poses:
    """Poses refined on the captures of their arrival."""
    of, which = _pairs(arrival, model.arrival)
    unsure = np.flatnonzero(~order_known[which])
    freedom = 2.0 * model.seen.sum(axis=1)[which]
    flipped = np.zeros(len(which), dtype=bool)
    for scale in (*_POSE_SCALES, None):
        T_E_T = inverse(T_P_E)[of] @ T_P_T[which]
        squares, normal, gradient = _sights(model, T_E_T, which, flipped)
        if len(unsure):
            other = _sights(model, T_E_T[unsure], which[unsure], ~flipped[unsure])
            better = other[0] < squares[unsure]
            for mine, its in zip((squares, normal, gradient), other, strict=True):
                mine[unsure[better]] = its[better]
            flipped[unsure[better]] = ~flipped[unsure[better]]
        off = squares / np.maximum(freedom, 1)
        weights = 1 / (1 + off / (scale or _POSE_SCALES[-1]) ** 2)
        summed = np.zeros((len(T_P_E), 6, 6))
        np.add.at(summed, of, weights[:, None, None] * normal)
        if scale is None:
            break
        towards = np.zeros((len(T_P_E), 6))
        np.add.at(towards, of, weights[:, None] * gradient)
        floor = (1e-9 * np.trace(summed, axis1=1, axis2=2) + 1e-9)[:, None, None] * np.eye(6)
        step = np.linalg.solve(summed + floor, -towards[..., None])[..., 0]
        T_P_E = moved(T_P_E, held(step))
        if off.max(initial=0.0) < _WELL and -np.sum(step * towards, axis=1).min(initial=0.0) < _WELL:
            break
    loss = np.zeros(len(T_P_E))
    np.add.at(loss, of, np.log1p(np.minimum(off, 1e8)))
    return Poses(arrival, T_P_E, loss, summed, of, which, flipped, weights)


def _pairs(arrival: Indices, of_captures: Indices) -> tuple[Indices, Indices]:
    """Each candidate with each capture of its arrival."""
    order = np.argsort(of_captures, kind="stable")
    begins = np.searchsorted(of_captures[order], arrival, side="left")
    counts = np.searchsorted(of_captures[order], arrival, side="right") - begins
    of = np.repeat(np.arange(len(arrival)), counts)
    within = np.arange(len(of)) - np.repeat(np.cumsum(counts) - counts, counts)
    return of, order[begins[of] + within]


def _sights(model: Model, T_E_T: Array, which: Indices, flipped: Mask) -> tuple[Array, Array, Array]:
    """Squares, normal and gradient of boards on T_P_E, passive arm marginalised; infinite and zero for one that is
    not in front of the camera.
    """
    sight = model.sight(T_E_T, which, flipped)
    behind = ~np.isfinite(sight.squares)
    normal = np.where(behind[:, None, None], 0.0, sight.normal)
    gradient = np.where(behind[:, None], 0.0, sight.gradient)
    nothing = np.zeros((len(which), sight.towards_passive.shape[-1]))
    W, gw, _, step = marginalised(normal, gradient, sight.towards_passive, nothing)
    own = np.einsum("bij,bi->bj", sight.towards_passive, gradient)
    squares = sight.squares + np.einsum("bj,bj->b", own, step)
    return np.where(behind, np.inf, squares), W, gw


def held(motion: Array) -> Array:
    """Motions (..., 6) no longer than what keeps a far step from jumping: 0.3 m and 0.5 rad."""
    size = np.maximum(np.linalg.norm(motion[..., :3], axis=-1) / 0.3, np.linalg.norm(motion[..., 3:], axis=-1) / 0.5)
    return np.asarray(motion / np.maximum(size, 1.0)[..., None])


def _distinct(model: Model, poses: Poses) -> Poses:
    """The best few of each arrival that are not the same."""
    kept: list[int] = []
    for a in range(model.arrivals):
        mine: list[int] = []
        of = np.flatnonzero(poses.arrival == a)
        for i in of[np.argsort(poses.loss[of], kind="stable")]:
            worse = len(mine) > 0 and poses.loss[i] > poses.loss[mine[0]] + _WORSE
            if worse or len(mine) == _MOST_POSES:
                break
            if all(_differ(poses.T_P_E[i], poses.T_P_E[j]) for j in mine):
                mine.append(int(i))
        kept += mine
    return poses.only(np.array(kept, dtype=np.intp))


def _differ(T: Array, other: Array) -> bool:
    turned = rotation_angle(T[:3, :3], other[:3, :3]) > _SAME_TURN
    return bool(turned or np.linalg.norm(T[:3, 3] - other[:3, 3]) > _SAME_PLACE)


def starts(model: Model, poses: Poses, thorough: bool) -> list[Start]:
    """The best few, best first: from all arrivals together; and from three each, if thorough or if any arrival has
    several candidates.
    """
    found = np.unique(poses.arrival)
    if len(found) < 3:
        return []
    T_P_A, T_H_E = _closed(model, poses, _sets(poses, found, thorough))
    # The information of an arrival on T_P_E falls by what the active arm adds, whose effect hardly depends on T_H_E.
    T_P_A, T_H_E, off = _fitted(model, poses, T_P_A, T_H_E)
    best = _best_of_arrival(off, poses.arrival, model.arrivals)
    taken = np.where(np.isfinite(best), np.log1p(np.minimum(best / 6, 1e8)), 0.0)
    order = np.argsort(taken.sum(axis=1), kind="stable")
    results: list[Start] = []
    for i in order:
        if len(results) == _MOST_STARTS:
            break
        if any(not _differ(T_P_A[i], r.T_P_A) and not _differ(T_H_E[i], r.T_H_E) for r in results):
            continue
        results.append(_start(model, poses, T_P_A[i], T_H_E[i], off[i], float(taken[i].sum())))
    return results


def _sets(poses: Poses, arrivals: Indices, thorough: bool) -> list[Indices]:
    """Of candidates: the best of all arrivals; and such of three arrivals, if thorough or if arrivals have several."""
    of = [np.flatnonzero(poses.arrival == a) for a in arrivals]
    sets = [np.array([candidates[0] for candidates in of])]
    if not thorough and all(len(candidates) == 1 for candidates in of):
        return sets
    triples = list(combinations(range(len(of)), 3))
    most = max(_FEWEST_SETS, _MOST_PAIRS // len(poses.arrival))
    if len(triples) > most:
        rng = np.random.default_rng(0)
        triples = [tuple(rng.choice(len(of), 3, replace=False)) for _ in range(most)]
    chosen = [np.array(members) for triple in triples for members in product(*(of[i] for i in triple))]
    if len(chosen) > 4 * most:
        chosen = [chosen[i] for i in np.random.default_rng(0).choice(len(chosen), 4 * most, replace=False)]
    return sets + chosen


def _closed(model: Model, poses: Poses, sets: list[Indices]) -> tuple[Array, Array]:
    T_P_A, T_H_E = [], []
    for members in (sets[:1], sets[1:]):
        if not members:
            continue
        chosen = np.stack(members)
        X, Y = solve(model.T_A_H[poses.arrival[chosen]], inverse(poses.T_P_E[chosen]))
        T_P_A.append(inverse(Y))
        T_H_E.append(X)
    return np.concatenate(T_P_A), np.concatenate(T_H_E)


def _fitted(model: Model, poses: Poses, T_P_A: Array, T_H_E: Array) -> tuple[Array, Array, Array]:
    """Cells (s, 4, 4) refined on the poses of the arrivals, and the squared distances (s, c) of these in sigmas."""
    T_A_H, J = model.T_A_H[poses.arrival], model.noise.active * model.J_active[poses.arrival]
    none = np.zeros((len(poses.arrival), J.shape[-1]))
    for scale in (*_CELL_SCALES, None):
        T_E_H = inverse(T_H_E)
        d = motion_between(poses.T_P_E[None], T_P_A[:, None] @ T_A_H[None] @ T_H_E[:, None])
        A = adjoint(T_E_H)[:, None] @ J[None]
        shape = (-1, *A.shape[2:])
        flat_normal = np.broadcast_to(poses.normal, (len(T_P_A), *poses.normal.shape)).reshape(-1, 6, 6)
        information = marginalised(
            flat_normal, np.zeros((len(flat_normal), 6)), A.reshape(shape), np.tile(none, (len(T_P_A), 1))
        )[0]
        information = information.reshape(len(T_P_A), -1, 6, 6)
        towards = (information @ d[..., None])[..., 0]
        off = np.einsum("sci,sci->sc", d, towards)
        if scale is None:
            return T_P_A, T_H_E, off
        best = _best_of_arrival(off, poses.arrival, model.arrivals)[:, poses.arrival]
        weights = np.where(off <= best, 1 / (1 + off / 6 / scale**2), 0.0)
        G = np.empty((*off.shape, 6, 12))
        G[..., :6] = adjoint(inverse(T_A_H[None] @ T_H_E[:, None]))
        G[..., 6:] = np.eye(6)
        G_T = np.swapaxes(G, -1, -2) * weights[..., None, None]
        normal = np.sum(G_T @ information @ G, axis=1)
        gradient = np.sum((G_T @ towards[..., None])[..., 0], axis=1)
        damping = (1e-9 * np.trace(normal, axis1=1, axis2=2) + 1e-9)[:, None, None] * np.eye(12)
        step = np.linalg.solve(normal + damping, -gradient[..., None])[..., 0]
        T_P_A, T_H_E = moved(T_P_A, held(step[:, :6])), moved(T_H_E, held(step[:, 6:]))
    raise AssertionError


def _best_of_arrival(off: Array, arrival: Indices, arrivals: int) -> Array:
    """(s, a): the least of (s, c) over the candidates of each arrival; infinite for one without any."""
    best = np.full((len(off), arrivals), np.inf)
    np.minimum.at(best.T, arrival, off.T)
    return best


def _start(model: Model, poses: Poses, T_P_A: Array, T_H_E: Array, off: Array, loss: float) -> Start:
    best = np.full(model.arrivals, -1, dtype=np.intp)
    worst_first = np.argsort(-off, kind="stable")
    best[poses.arrival[worst_first]] = worst_first
    taken = best[model.arrival[poses.which]] == poses.of
    which = poses.which[taken]
    flipped, fits = np.zeros(model.captures, dtype=bool), np.zeros(model.captures, dtype=bool)
    flipped[which] = poses.flipped[taken]
    arrival_fits = off[poses.of[taken]] / 6 < _CELL_SCALES[-1] ** 2
    fits[which] = arrival_fits & (poses.weights[taken] > 0.5)
    return Start(T_P_A, T_H_E, flipped, loss, fits)
