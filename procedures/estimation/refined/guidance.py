"""What captures would make seen what those that were taken do not determine."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dualcal_hal.transforms import Array, inverse, rotation_from_vector, transform
from procedures.estimation.refined.estimate import Refined
from procedures.estimation.refined.motion import adjoint

_TURN = float(np.radians(40.0))
_POSE = (1e-3, 2e-3)  # m, rad: about how exactly one arrival of several captures shows where the camera is
_ENOUGH = 0.5  # of a sigma, that a kind of capture has to bring it down to for being worth a word


@dataclass(frozen=True)
class _Kind:
    words: str
    turn: Array  # of the active flange, a rotation vector in its own frame


def would_help(result: Refined, T_A_H: Array) -> tuple[str, ...]:
    """A line for each kind of capture that helps most with a direction that is not observable.

    Each kind is tried: two more arrivals whose active flange is turned about another axis, both ways, are added to what
    is known, and the kind that lowers the sigma most is named. Empty where all is observable. T_A_H (4, 4): an active
    flange to turn from.
    """
    said: dict[str, list[str]] = {}
    for index, direction in enumerate(result.directions):
        if direction.observable:
            continue
        sigmas = {kind.words: _sigma_with(result, T_A_H, kind, index) for kind in _kinds(result)}
        best = min(sigmas, key=lambda words: sigmas[words])
        if sigmas[best] > _ENOUGH * direction.sigma:
            best = "more arrivals of the active arm, turned about all axes"
        said.setdefault(best, []).append(direction.name)
    return tuple(f"{words}, for {', '.join(names)}" for words, names in said.items())


def _kinds(result: Refined) -> Iterator[_Kind]:
    axis = result.T_H_E[:3, 2]
    across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    across /= np.linalg.norm(across)
    yield _Kind("constraints with the camera rolled about its optical axis", axis)
    yield _Kind("constraints with the optical axis tilted about one axis across it", across)
    yield _Kind("constraints with the optical axis tilted about the other axis across it", np.cross(axis, across))


def _sigma_with(result: Refined, T_A_H: Array, kind: _Kind, index: int) -> float:
    """Of the direction, once such captures are there too."""
    normal = np.linalg.inv(result.covariance)
    weight = np.diag(np.repeat([1 / _POSE[0] ** 2, 1 / _POSE[1] ** 2], 3))
    for sign in (1, -1):
        turned = T_A_H @ transform(rotation_from_vector(sign * _TURN * kind.turn), np.zeros(3))
        G = np.concatenate([adjoint(inverse(turned @ result.T_H_E)), np.eye(6)], axis=1)
        normal = normal + G.T @ weight @ G
    return float(np.sqrt(np.linalg.inv(normal)[index, index]))
