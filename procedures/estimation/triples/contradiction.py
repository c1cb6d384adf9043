"""Which triples contradict the others, where all together do not fit AXB = YCZ."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtr, chdtri

from dualcal_hal.transforms import Array
from procedures.estimation.triples.closed_form import Solution, find_start
from procedures.estimation.triples.degeneracy import DEGENERATE, UNCERTAIN, conditioning, weakest
from procedures.estimation.triples.refinement import UNKNOWNS, Linearised, Measured, State, linearised, minimise

FEWEST_THAT_AGREE = 6
"""Fewer fit some X, Y and Z nearly whatever they are."""

# With a third of the triples wrong, one in twelve of so many is right throughout.
_SUBSETS = 60
_ROUNDS = 5

_FARTHEST = float(chdtri(6, 1e-5))  # the square that one of 100,000 good triples exceeds
_MEDIAN = float(chdtri(6, 0.5))
_TOO_WELL = 1e-5  # probability of residuals so small


Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Contradiction:
    """odd: indices of the triples that do not fit; scale: of the others, as that of a TripleEstimate."""

    odd: tuple[int, ...]
    scale: float


def find_contradiction(measured: Measured) -> Contradiction | None:
    """The smaller part that contradicts the larger; None if no larger part agrees in itself, or nothing is odd.

    Least median of squares over subsets (Rousseeuw, "Least Median of Squares Regression", Journal of the American
    Statistical Association 79(388), 1984), refined over what fits. The same triples give the same answer.
    """
    n = len(measured.A)
    if n <= FEWEST_THAT_AGREE:
        return None
    rng = np.random.default_rng(n)
    subsets = [np.sort(rng.choice(n, FEWEST_THAT_AGREE, replace=False)) for _ in range(_SUBSETS)]
    squares = min((_squares(measured, _start(measured.some(subset))) for subset in subsets), key=np.median)
    fits = np.sort(np.argsort(squares, kind="stable")[: max(FEWEST_THAT_AGREE, n // 2)])
    for _ in range(_ROUNDS):
        agreeing = measured.some(fits)
        state, at, converged = minimise(agreeing, _start(agreeing))
        if not converged or conditioning(at.normal) < DEGENERATE:
            return None
        limit = _FARTHEST * max(1.0, float(np.median(at.squares)) / _MEDIAN)
        before, fits = fits, np.flatnonzero(_squares_of_others(measured, state.solution, at, fits) <= limit)
        if len(fits) < FEWEST_THAT_AGREE:
            return None
        if np.array_equal(before, fits):
            odd = np.setdiff1d(np.arange(n), fits)
            return _if_it_shows(odd, len(fits), at) if 0 < len(odd) < len(fits) else None
    return None


def _if_it_shows(odd: Indices, agreeing: int, at: Linearised) -> Contradiction | None:
    """None where those that agree do so by chance: so badly that nothing is determined, or better than noise lets."""
    freedom = 6 * agreeing - UNKNOWNS
    scale = float(np.sqrt(at.cost / freedom))
    covariance = np.asarray(np.linalg.inv(at.normal), dtype=float) * max(1.0, scale) ** 2
    by_chance = weakest(covariance, UNCERTAIN) or chdtr(freedom, at.cost) < _TOO_WELL
    return None if by_chance else Contradiction(tuple(odd.tolist()), scale)


def _start(measured: Measured) -> Solution:
    return find_start(measured.A, measured.B, measured.C)


def _at(measured: Measured, solution: Solution) -> Linearised:
    return linearised(measured, State(solution, np.zeros((len(measured.A), 12))))


def _squares(measured: Measured, solution: Solution) -> Array:
    """(n,): how far each triple is from X, Y and Z, in units of its noise."""
    return _at(measured, solution).squares


def _squares_of_others(measured: Measured, solution: Solution, agreeing: Linearised, fits: Indices) -> Array:
    """(n,): the same, but for triples that the solution was not found with also in units of its own uncertainty."""
    at = _at(measured, solution)
    squares = at.squares.copy()
    J, S = at.towards_unknowns, measured.covariance_B + at.towards_errors @ np.swapaxes(at.towards_errors, 1, 2)
    S = S + J @ np.linalg.inv(agreeing.normal) @ np.swapaxes(J, 1, 2)
    others = np.setdiff1d(np.arange(len(squares)), fits)
    r = at.offset[others, :, None]
    squares[others] = np.sum(r * np.linalg.solve(S[others], r), axis=(1, 2))
    return squares
