"""First values where it is not known either how the target is mounted: from the pose of the board in each capture.

Cameras and boards close the loop T_A_H T_H_E T_E_T = T_A_P T_P_F T_F_T, which is AXB = YCZ. A board seen from afar
looks like its twin, and one of unknown order like itself the other way round; those that agree with the others are
taken.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from dualcal_hal.transforms import Array, Mask, inverse, rotation_angle
from procedures.estimation.degenerate import Degenerate
from procedures.estimation.refined.data import CaptureArrays, Indices, Knowns, Noise
from procedures.estimation.refined.inexact import Inexact, WithInexact, fit_inexact, target_mount
from procedures.estimation.refined.model import Model
from procedures.estimation.refined.motion import motion_between, moved
from procedures.estimation.refined.resection import plane_poses
from procedures.estimation.refined.start import HALF_TURN, held, seen_rays
from procedures.estimation.triples.closed_form import Solution, find_start

_FREE = target_mount(np.inf, np.inf)

_FEWEST = 5  # captures whose boards say 6 numbers each of 18, with some to spare
_FEWEST_ARRIVALS = 3
_STEPS = 15
_ROUNDS = 10
_DOUBTFUL = float(np.radians(2.0))  # a board's rotation in one capture is good to about one degree
_TRIES, _SOME = 24, 6  # sets of so many captures
_FITS = float(np.radians(3.0)), 4.0  # at least, and times the median


def is_free_mount(inexact: Inexact) -> bool:
    """Whether nothing is known of the mount."""
    return inexact.names == _FREE.names and not np.any(np.isfinite(inexact.sigmas))


def counted_from(given: Knowns, found: WithInexact) -> WithInexact:
    """With the mount's numbers counted from the given one, wherever the fit began."""
    off = dict(zip(_FREE.names, motion_between(given.T_F_T, found.knowns.T_F_T).tolist(), strict=True))
    return replace(found, known=tuple(replace(one, value=off.get(one.name, one.value)) for one in found.known))


@dataclass(frozen=True)
class _Boards:
    """Candidates (b,) for T_E_T of captures ``which``, with their corners from the other end where flipped."""

    which: Indices
    T_E_T: Array
    flipped: Mask


def find_mount(data: CaptureArrays, knowns: Knowns, noise: Noise) -> Array | None:
    """T_F_T (4, 4) that fits captures which agree with each other best; of ``knowns`` that of the mount is not used,
    except to choose between two that are half a turn apart where no order of corners is known. None where too few
    boards were seen.
    """
    model = Model(data, knowns, noise)
    boards = _boards(model, data)
    shown = np.unique(boards.which)
    if len(shown) < _FEWEST or len(np.unique(model.arrival[shown])) < _FEWEST_ARRIVALS:
        return None
    best = min(_agreeing(model, boards), key=lambda found: found.median)
    kept = np.zeros(len(data), dtype=bool)
    kept[best.chosen_captures[best.off <= max(_FITS[0], _FITS[1] * best.median)]] = True
    flipped = np.zeros(len(data), dtype=bool)
    flipped[best.chosen_captures] = best.flipped
    solution = best.solution
    start = replace(knowns, T_F_T=solution.Z)
    kept_data = data.turned(flipped).only(kept)
    state = Model(kept_data, start, noise).state(inverse(solution.Y), solution.X)
    try:
        found = fit_inexact(kept_data, start, noise, state, [_FREE], True).knowns.T_F_T
    except np.linalg.LinAlgError as error:
        raise Degenerate("the captures do not show how the target is mounted") from error
    if not np.any(data.order[kept]):
        # All boards the other way round, on a mount turned by half, are the same captures.
        found = min((found, found @ HALF_TURN), key=lambda T: float(rotation_angle(T[:3, :3], knowns.T_F_T[:3, :3])))
    return np.asarray(found)


@dataclass(frozen=True)
class _Agreeing:
    """solution: of the loop; of each capture the candidate that is nearest to it; off: rad; median: of these."""

    solution: Solution
    chosen_captures: Indices
    flipped: Mask
    off: Array

    @property
    def median(self) -> float:
        return float(np.median(self.off))


def _boards(model: Model, data: CaptureArrays) -> _Boards:
    rays, seen = seen_rays(model)
    usable = np.flatnonzero(seen.sum(axis=1) >= 4)
    which, poses = [np.zeros(0, dtype=np.intp)], [np.zeros((0, 4, 4))]
    if len(usable):
        which.append(np.repeat(usable, 2))
        poses.append(plane_poses(model.knowns.corners, rays[usable], seen[usable]).reshape(-1, 4, 4))
    for k, pose in enumerate(data.board_poses or ()):
        if pose is not None:
            given = np.asarray(pose, dtype=float).reshape(-1, 4, 4)
            which.append(np.full(len(given), k))
            poses.append(given)
    captures, T_E_T = np.concatenate(which), np.concatenate(poses)
    if not len(captures):
        return _Boards(captures, T_E_T, np.zeros(0, dtype=bool))
    T_E_T, good = _on_corners(model, captures, T_E_T)
    captures, T_E_T = captures[good], T_E_T[good]
    unsure = ~data.order[captures]
    return _Boards(
        which=np.concatenate([captures, captures[unsure]]),
        T_E_T=np.concatenate([T_E_T, T_E_T[unsure] @ HALF_TURN]),
        flipped=np.arange(len(captures) + int(unsure.sum())) >= len(captures),
    )


def _on_corners(model: Model, which: Indices, T_E_T: Array) -> tuple[Array, Mask]:
    """Poses refined on their captures' corners, and which of them fit these about as well as the best of theirs."""
    T_T_E, damping = inverse(T_E_T), np.full(len(which), 1e-3)
    at = model.sight(T_E_T, which)
    squares, normal, gradient = at.squares, at.normal, at.gradient
    for _ in range(_STEPS):
        scale = np.einsum("bii->bi", normal)
        damped = normal + damping[:, None, None] * scale[:, :, None] * np.eye(6) + 1e-12 * np.eye(6)
        usable = np.isfinite(squares)
        step = np.zeros((len(which), 6))
        step[usable] = np.linalg.solve(damped[usable], -gradient[usable][..., None])[..., 0]
        tried = moved(T_T_E, held(step))
        at = model.sight(inverse(tried), which)
        better = at.squares <= squares
        T_T_E = np.where(better[:, None, None], tried, T_T_E)
        squares = np.where(better, at.squares, squares)
        normal = np.where(better[:, None, None], at.normal, normal)
        gradient = np.where(better[:, None], at.gradient, gradient)
        damping = np.where(better, damping / 10, damping * 10)
    least = np.full(model.captures, np.inf)
    shown = np.isfinite(squares)
    np.minimum.at(least, which[shown], squares[shown])
    # A twin whose corners are off three times as far as the best one's is none.
    return inverse(T_T_E), shown & (squares <= 9 * least[which] + 9 * model.freedom[which])


def _agreeing(model: Model, boards: _Boards) -> Iterator[_Agreeing]:
    """From all captures together; and where these do not agree, from a few of them at a time."""
    captures, first = np.unique(boards.which, return_index=True)
    found = _settled(model, boards, first)
    yield found
    if found.median < _DOUBTFUL:
        return
    rng = np.random.default_rng(0)
    of = [np.flatnonzero(boards.which == k) for k in captures]
    for _ in range(_TRIES):
        some = rng.choice(len(captures), min(_SOME, len(captures)), replace=False)
        if len(np.unique(model.arrival[captures[some]])) < _FEWEST_ARRIVALS:
            continue
        yield _settled(model, boards, np.array([rng.choice(of[i]) for i in some]))


def _settled(model: Model, boards: _Boards, chosen: Indices) -> _Agreeing:
    """From the candidates ``chosen`` of some captures: those nearest to what they say, until these say themselves."""
    rotation_of = None
    for _ in range(_ROUNDS):
        of = boards.which[chosen]
        solution = find_start(model.T_A_H[model.arrival[of]], boards.T_E_T[chosen], model.T_P_F[of])
        nearest, off = _nearest(model, boards, solution)
        fits = off <= max(_FITS[0], _FITS[1] * float(np.median(off)))
        again = nearest[fits]
        if rotation_of is not None and np.array_equal(again, rotation_of):
            break
        if len(again) < _FEWEST or len(np.unique(model.arrival[boards.which[again]])) < _FEWEST_ARRIVALS:
            break
        chosen = rotation_of = again
    return _Agreeing(solution, boards.which[nearest], boards.flipped[nearest], off)


def _nearest(model: Model, boards: _Boards, solution: Solution) -> tuple[Indices, Array]:
    """Of each capture the candidate that is turned least from where the solution has it, and by how much, rad."""
    of = boards.which
    predicted = inverse(model.T_A_H[model.arrival[of]] @ solution.X) @ solution.Y @ model.T_P_F[of] @ solution.Z
    off = rotation_angle(predicted[:, :3, :3], boards.T_E_T[:, :3, :3])
    order = np.lexsort((off, of))
    first = np.unique(of[order], return_index=True)[1]
    return order[first], off[order[first]]
