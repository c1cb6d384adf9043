"""What captures would make seen what those that were taken do not determine."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dualcal_hal.transforms import Array, inverse, rotation_from_vector, transform
from procedures.estimation.refined.data import CaptureArrays
from procedures.estimation.refined.estimate import Refined
from procedures.estimation.refined.model import CELL, Linearised, Model, marginalised
from procedures.estimation.refined.motion import adjoint

_TURN = float(np.radians(40.0))
_SHIFT = 0.15  # m
_DEPTH = 0.1  # m
_SAME = "as many captures again, of the same kinds"
_WORTH = 0.8  # of the sigma that more of the same leaves; what does not come below it is not worth a word of its own


def would_help(result: Refined, captures: CaptureArrays) -> tuple[str, ...]:
    """A line for each kind of captures that helps most with a direction that is not observable; empty where all are.

    Each kind is reckoned with as if as many captures as there are were taken again in that way: what they would say of
    the cell is added to what is known, and the kind that leaves the smallest sigma is named. captures: those of the
    estimate, all of them, in its order.
    """
    hidden = [index for index, direction in enumerate(result.directions) if not direction.observable]
    if not hidden:
        return ()
    known = np.linalg.inv(result.covariance)
    sigmas = {words: np.sqrt(np.diag(np.linalg.inv(known + gain))) for words, gain in _gains(result, captures)}
    said: dict[str, list[str]] = {}
    for index in hidden:
        best = min(sigmas, key=lambda words: float(sigmas[words][index]))
        if sigmas[best][index] > _WORTH * sigmas[_SAME][index]:
            best = _SAME
        said.setdefault(best, []).append(result.directions[index].name)
    return tuple(f"{words}, for {', '.join(names)}" for words, names in said.items())


@dataclass(frozen=True)
class _Kind:
    """turn, rad, and shift, m, in the camera's frame: one this way and the next one that."""

    words: str
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def moves(self, count: int) -> Array:
        """(count, 4, 4)."""
        way = np.where(np.arange(count) % 2 == 0, 1.0, -1.0)[:, None]
        return transform(rotation_from_vector(way * self.turn), way * self.shift)


# Arrivals again, with the camera moved, the boards before it where they are.
_ARRIVALS = (
    _Kind(_SAME),
    _Kind("constraints with the camera rolled about its optical axis", turn=(0, 0, _TURN)),
    _Kind("constraints with the camera turned about its x-axis", turn=(_TURN, 0, 0)),
    _Kind("constraints with the camera turned about its y-axis", turn=(0, _TURN, 0)),
    _Kind("constraints with the camera farther to the sides", shift=(_SHIFT, _SHIFT, 0)),
)

# Positions again at the same arrivals, with the boards moved.
_POSITIONS = (
    _Kind("more positions on the same constraints"),
    _Kind("positions at more distances from the camera", shift=(0, 0, _DEPTH)),
    _Kind("positions with the board tilted more about the camera's x-axis", turn=(_TURN, 0, 0)),
    _Kind("positions with the board tilted more about the camera's y-axis", turn=(0, _TURN, 0)),
)


def _gains(result: Refined, captures: CaptureArrays) -> Iterator[tuple[str, Array]]:
    """Information (12, 12) on the cell that each kind adds."""
    model = Model(captures.turned(result.flipped).only(result.used), result.knowns, result.noise)
    at = model.linearised(model.state(result.T_P_A, result.T_H_E))
    for kind in _ARRIVALS:
        T_A_E = model.T_A_H @ result.T_H_E @ kind.moves(model.arrivals)
        G = np.concatenate([adjoint(inverse(T_A_E)), np.broadcast_to(np.eye(6), (model.arrivals, 6, 6))], axis=2)
        yield kind.words, np.sum(np.swapaxes(G, 1, 2) @ at.pose_normal @ G, axis=0)
    for place in _POSITIONS:
        yield place.words, _of_positions(model, result, at, place)


def _of_positions(model: Model, result: Refined, at: Linearised, kind: _Kind) -> Array:
    T_P_E = result.T_P_A @ model.T_A_H[model.arrival] @ result.T_H_E
    T_E_T = inverse(T_P_E) @ model.T_P_F @ result.knowns.T_F_T
    moves = kind.moves(model.captures)
    there = T_E_T.copy()
    there[:, :3, :3] = moves[:, :3, :3] @ T_E_T[:, :3, :3]
    there[:, :3, 3] += moves[:, :3, 3]
    sight = model.sight(there)
    seen = np.isfinite(sight.squares)
    normal = np.where(seen[:, None, None], sight.normal, 0.0)
    none = np.zeros((model.captures, 6))
    W = marginalised(normal, none, sight.towards_passive, np.zeros(sight.towards_passive.shape[::2]))[0]
    arrivals = at.arrival_normal.copy()
    np.add.at(arrivals, model.arrival, W)
    A = at.towards_active
    pose = marginalised(arrivals, np.zeros((model.arrivals, 6)), A, np.zeros(A.shape[::2]))[0]
    G = at.towards_cell
    gain = np.sum(np.swapaxes(G, 1, 2) @ (pose - at.pose_normal) @ G, axis=0)
    return np.asarray(gain).reshape(CELL, CELL)
