"""X, Y and Z of AXB = YCZ with their uncertainty, from triples alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtr, chdtrc

from dualcal_hal.transforms import Array, inverse
from procedures.estimation.degenerate import Degenerate
from procedures.estimation.refined.motion import adjoint
from procedures.estimation.triples.closed_form import Solution, find_start
from procedures.estimation.triples.contradiction import Contradiction, find_contradiction
from procedures.estimation.triples.degeneracy import (
    FEWEST_TRIPLES,
    UNCERTAIN,
    WEAK,
    conditioning,
    refuse_degenerate,
    refuse_singular,
    refuse_uncertain,
    weakest,
)
from procedures.estimation.triples.noise import TripleNoise, root
from procedures.estimation.triples.refinement import UNKNOWNS, Measured, minimise, rise_by_one_sigma

__all__ = ["FEWEST_TRIPLES", "TripleEstimate", "estimate_triples"]

# Measured on 1,000 sets of 4 to 300 triples: up to 1.05 for 30 and more; 3 and more in all sets whose error was far
# outside their covariance (4 or 5 triples, turned by little), and the others' errors were as their covariance has them.
_LINEAR = 2.0

_SURPRISE = 0.0005  # probability of residuals so large, or so small, if the noise is as stated
_MISFIT = "the triples do not fit AXB = YCZ"
_TOO_LARGE = "the residuals are {:.3g} times what the stated noise explains"
_MOST_NAMED = 8
_ADVICE = "check what A, B and C are, their directions (B: the target in the camera), their order and their units"


@dataclass(frozen=True)
class TripleEstimate:
    """X, Y, Z (4, 4), m.

    covariance (18, 18): of log(T_est^-1 T_true) of X, then Y, then Z, [translation in m; rotation in rad] in the child
    frame, to first order. It is that of the stated noise, multiplied by scale^2 where the residuals are too large for
    it, never where they are too small: errors that all triples share leave no residuals. scale: sqrt(cost /
    degrees_of_freedom), near 1 if the noise is as stated; noise_fits: whether it is near enough.
    squares (n,): each triple's part of the cost, some 6 each: outliers are far above.
    start: where the refinement began. conditioning: smallest over largest singular value of the whitened problem, its
    columns scaled to length 1. rise: the most that one sigma along the least certain directions raises the cost, 1
    where first order is enough; warnings in words.
    """

    X: Array
    Y: Array
    Z: Array
    covariance: Array
    cost: float
    degrees_of_freedom: int
    scale: float
    noise_fits: bool
    squares: Array
    start: Solution
    conditioning: float
    rise: float
    warnings: tuple[str, ...]

    def covariance_of(self, name: str) -> Array:
        """(6, 6) of X, Y or Z."""
        at = 6 * "XYZ".index(name)
        return self.covariance[at : at + 6, at : at + 6]

    @property
    def T_P_A(self) -> Array:
        """Base 1 in base 2 (4, 4)."""
        return inverse(self.Y)

    @property
    def covariance_of_T_P_A(self) -> Array:
        """(6, 6), in the frame of base 1."""
        Ad = adjoint(self.Y)
        return np.asarray(Ad @ self.covariance_of("Y") @ Ad.T)


def estimate_triples(
    A: ArrayLike, B: ArrayLike, C: ArrayLike, noise: TripleNoise, names: Sequence[str] | None = None
) -> TripleEstimate:
    """Maximum likelihood from triples (n, 4, 4), m, with the errors of A and C marginalised; no start is needed.

    names (n): what a warning calls them, their index from 0 for None.
    Raises Degenerate, with the reason, for triples that do not determine X, Y and Z; ValueError for poses that are no
    rigid transforms, for different numbers of them, and for a noise that is of another number.
    """
    A, B, C = (_poses(each, name) for each, name in ((A, "A"), (B, "B"), (C, "C")))
    if not len(A) == len(B) == len(C):
        raise ValueError(f"{len(A)} poses A, {len(B)} B and {len(C)} C")
    noise.require_count(len(A))
    refuse_degenerate(A, B, C, noise)
    measured = Measured(A, B, C, root(noise.A), root(noise.C), noise.B, _inverse_of(noise.B))
    start = find_start(A, B, C)
    state, at, converged = minimise(measured, start)
    freedom = 6 * len(A) - UNKNOWNS
    condition = conditioning(at.normal)
    refuse_singular(condition)
    scale, noise_fits = _judge_noise(at.cost, freedom)
    covariance = _inverse_of(at.normal)
    refuse_uncertain(covariance)
    if not noise_fits:
        covariance *= max(1.0, scale**2)
    contradiction = None if noise_fits or scale < 1 else find_contradiction(measured)
    misfit = "" if noise_fits else _misfit(scale, contradiction, names or range(len(A)))
    if not converged or weakest(covariance, UNCERTAIN):
        advice = _ADVICE if contradiction is None else "correct or leave out what contradicts"
        raise Degenerate(f"{_MISFIT}: {misfit or _TOO_LARGE.format(scale)}; {advice}")
    rise = rise_by_one_sigma(measured, state, at)
    return TripleEstimate(
        X=state.solution.X,
        Y=state.solution.Y,
        Z=state.solution.Z,
        covariance=covariance,
        cost=at.cost,
        degrees_of_freedom=freedom,
        scale=scale,
        noise_fits=noise_fits,
        squares=at.squares,
        start=start,
        conditioning=condition,
        rise=rise,
        warnings=_warnings(covariance, misfit, rise),
    )


def _poses(poses: ArrayLike, name: str) -> Array:
    T = np.asarray(poses, dtype=float)
    if T.ndim != 3 or T.shape[1:] != (4, 4) or not np.all(np.isfinite(T)):
        raise ValueError(f"{name} must be finite poses (n, 4, 4), not of shape {T.shape}")
    R = T[:, :3, :3]
    rigid = np.allclose(R @ np.swapaxes(R, 1, 2), np.eye(3), rtol=0.0, atol=1e-6) and np.all(np.linalg.det(R) > 0)
    if not rigid or not np.all(T[:, 3] == [0.0, 0.0, 0.0, 1.0]):
        raise ValueError(f"{name} has poses that are no rigid transforms")
    return T


def _inverse_of(symmetric: Array) -> Array:
    """Of symmetric matrices (..., k, k), so that it is symmetric too."""
    M = np.linalg.inv(symmetric)
    return np.asarray((M + np.swapaxes(M, -1, -2)) / 2, dtype=float)


def _judge_noise(cost: float, freedom: int) -> tuple[float, bool]:
    """The scale, and whether a cost like this comes about with the noise as stated."""
    fits = min(chdtrc(freedom, cost), chdtr(freedom, cost)) > _SURPRISE
    return float(np.sqrt(cost / freedom)), bool(fits)


def _misfit(scale: float, found: Contradiction | None, names: Sequence[object]) -> str:
    """In words, with the triples that it is the fault of if it is that of some."""
    told = _TOO_LARGE.format(scale)
    if found is None:
        return told
    odd = ", ".join(str(names[index]) for index in found.odd[:_MOST_NAMED])
    more = f" and {len(found.odd) - _MOST_NAMED} more" if len(found.odd) > _MOST_NAMED else ""
    which = f"triple {odd}, which contradicts" if len(found.odd) == 1 else f"triples {odd}{more}, which contradict"
    return f"{told}, and without {which} the others, {found.scale:.3g} times"


def _warnings(covariance: Array, misfit: str, rise: float) -> tuple[str, ...]:
    said = [misfit] if misfit else []
    if uncertain := weakest(covariance, WEAK):
        said.append(f"{uncertain}: turn both flanges by more, about two axes each, or take more triples")
    if rise > _LINEAR:
        said.append(
            f"the covariance is too small: it holds to first order, and one sigma raises the cost by {rise:.2g}, not 1;"
            " take more triples"
        )
    return tuple(said)
