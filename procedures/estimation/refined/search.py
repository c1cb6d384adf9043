"""The cell that explains most captures, and which these are: trimmed fits from all starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from dualcal_hal.transforms import Array, Mask
from procedures.estimation.degenerate import Degenerate
from procedures.estimation.refined.data import CaptureArrays, Indices, Knowns, Noise
from procedures.estimation.refined.fit import Fit, minimise
from procedures.estimation.refined.inexact import Inexact, fit_inexact
from procedures.estimation.refined.model import CELL, Model
from procedures.estimation.refined.outliers import (
    Distances,
    between_arrivals,
    distances,
    limits,
    predicted_distances,
)
from procedures.estimation.refined.start import Start

# Captures of one arrival whose active readings differ by more than this are taken for two arrivals.
_APART = 5e-3  # rad

_SUSPICIOUS = 4.0  # squares this many times larger than the noise says: perhaps not the right optimum
_MOST_ROUNDS = 12

# Captures that are all off, each in its own way, differ more from each other than noisy ones do: an outlier among them
# is twice as far off as it is among others.
STANDS_OUT = 4.0  # a square

# What share may be left out: where all may be off together, and where those that stand out explain all.
FEW, LESS_THAN_HALF = 1 / 3, 0.49

_MISFIT = 900.0  # squares larger by more than this are not of arms, mounts or cameras that are somewhat off
_SIGNIFICANT = 1e-3


@dataclass(frozen=True)
class Solution:
    """A fit to the captures ``used`` (k,), those ``flipped`` (k,) from the other end of their corners; loss: how far
    all captures are off, by the logarithm, so that those which do not belong hardly count.
    """

    model: Model
    fit: Fit
    used: Mask
    flipped: Mask
    distances: Distances
    loss: float

    @property
    def scale(self) -> float:
        """By what its squares exceed those of the stated noise, those between arrivals by themselves too."""
        between = excess(*between_arrivals(self.fit))
        return max(excess(self.fit.at.cost, self.model.measurements - CELL), between)


@dataclass(frozen=True)
class Search:
    """For the cell from starts and captures of which some may not belong: ``data``, its arrivals told apart by what was
    read; ``every``: the model of all; usable (k,): those in which a corner was seen. farther: than the least probable
    capture that belongs, in squares, is one that does not.
    """

    data: CaptureArrays
    every: Model
    usable: Mask
    keep_all: bool
    farther: float = 1.0

    @classmethod
    def of(cls, data: CaptureArrays, knowns: Knowns, noise: Noise, keep_all: bool) -> Search:
        data = replace(data, arrivals=_by_reading(data))
        every = Model(data, knowns, noise)
        return cls(data, every, every.seen.sum(axis=1) > 0, keep_all)

    def share_out(self, solution: Solution) -> float:
        """Of the captures, those left out."""
        return float(1 - solution.used.sum() / self.usable.sum())

    def explained(self, solution: Solution, most_out: float) -> bool:
        """Whether outliers explain all that is off: the others fit the noise, and are enough to be believed."""
        out = self.share_out(solution)
        return out == 0 or (out <= most_out and solution.scale == 1)

    def off_alike(self, solution: Solution) -> bool:
        """Whether it may be one misfit that all captures share, but for a few."""
        return self.share_out(solution) <= FEW and solution.scale <= _MISFIT

    def solutions(self, found: Sequence[Start], only_fitting: bool) -> list[Solution]:
        """From all starts, best first; only_fitting: at first with the captures that fit the start."""
        results = []
        for start in found:
            used = self.usable & start.fits if only_fitting and not self.keep_all else self.usable
            solution = self._fitted(start.T_P_A, start.T_H_E, used, start.flipped)
            if solution is not None:
                results.append(solution if self.keep_all else self._trimmed(solution))
        return best_first(results)

    def suspicious(self, solution: Solution) -> bool:
        """Whether another start may do better."""
        dropped = not np.array_equal(solution.used, self.usable)
        return dropped or max(solution.distances.scale()) > _SUSPICIOUS or not solution.fit.converged

    def _fitted(self, T_P_A: Array, T_H_E: Array, used: Mask, flipped: Mask) -> Solution | None:
        if len(np.unique(self.every.arrival[used])) < 3:
            return None
        model = Model(self.data.turned(flipped).only(used), self.every.knowns, self.every.noise)
        fit = minimise(model, model.state(T_P_A, T_H_E))
        if not np.isfinite(fit.at.cost):
            return None
        try:
            off = distances(model, fit)
            predicted = predicted_distances(model, self.every, fit, flipped) if not used.all() else np.empty(len(used))
        except np.linalg.LinAlgError:
            return None
        predicted[used] = off.captures
        apart = np.log1p(np.minimum(predicted / np.maximum(self.every.freedom, 1), 1e12))
        return Solution(model, fit, used, flipped, off, float(apart[self.usable].sum()))

    def _trimmed(self, solution: Solution) -> Solution:
        """Without what does not fit, and with all that does."""
        seen_before = [solution.used]
        for _ in range(_MOST_ROUNDS):
            used, flipped = self._judged(solution)
            if np.array_equal(used, solution.used) and np.array_equal(flipped[used], solution.flipped[used]):
                break
            again = self._fitted(solution.fit.state.T_P_A, solution.fit.state.T_H_E, used, flipped)
            if again is None:
                break
            solution = again
            if any(np.array_equal(used, before) for before in seen_before):
                break
            seen_before.append(used)
        return solution

    def trimmed_with(self, knowns: Knowns, inexact: Sequence[Inexact], begun: Sequence[Start]) -> Solution | None:
        """The best from all starts, or the first that explains all, as :meth:`_trimmed_with`."""
        found = []
        for start in begun:
            solution = self._trimmed_with(knowns, inexact, start)
            if solution is not None:
                found.append(solution)
                if self.explained(solution, FEW):
                    break
        return best_first(found)[0] if found else None

    def _trimmed_with(self, knowns: Knowns, inexact: Sequence[Inexact], begun: Start) -> Solution | None:
        """As :meth:`_trimmed`, with the knowns found anew each time from the captures that are left."""
        T_P_A, T_H_E, flipped, used = begun.T_P_A, begun.T_H_E, begun.flipped, begun.fits
        solution: Solution | None = None
        seen_before: list[Mask] = []
        for _ in range(len(self.data)):
            seen_before.append(used)
            kept = self.data.turned(flipped).only(used)
            start = Model(kept, self.every.knowns, self.every.noise).state(T_P_A, T_H_E)
            try:
                found = fit_inexact(kept, knowns, self.every.noise, start, inexact, True)
            except (Degenerate, np.linalg.LinAlgError):
                break  # the captures left are too few to see the knowns in
            T_P_A, T_H_E = found.fit.state.T_P_A, found.fit.state.T_H_E
            there = replace(self, every=Model(self.data, found.knowns, self.every.noise))
            again = there._fitted(T_P_A, T_H_E, used, flipped)
            if again is None:
                break
            solution = again
            used, flipped = there._judged(solution)
            if any(np.array_equal(used, before) for before in seen_before):
                break
        return solution

    def _judged(self, solution: Solution) -> tuple[Mask, Mask]:
        of_captures, of_arrivals = (self.farther * scale for scale in solution.distances.scale())
        used = solution.used.copy()
        mine = np.flatnonzero(used)
        worst = _worst(solution, of_captures, of_arrivals)
        used[mine[worst]] = False
        flipped = solution.flipped.copy()
        if worst.any() or np.array_equal(used, self.usable):
            return used, flipped
        # What was left out so far comes back where it fits.
        freedom = self.every.freedom
        scale = max(of_captures, of_arrivals)
        predicted = predicted_distances(solution.model, self.every, solution.fit, flipped)
        other = predicted_distances(solution.model, self.every, solution.fit, ~flipped)
        turn = ~solution.used & ~self.data.order & (other < predicted)
        flipped = flipped ^ turn
        predicted = np.where(turn, other, predicted)
        return used | (self.usable & (predicted < limits(freedom, scale))), flipped


def best_first(solutions: Sequence[Solution]) -> list[Solution]:
    """By their loss, but of those with the captures of the best one the cheapest first."""
    ordered = sorted(solutions, key=lambda solution: solution.loss)
    alike = [solution for solution in ordered if np.array_equal(solution.used, ordered[0].used)]
    others = [solution for solution in ordered if not np.array_equal(solution.used, ordered[0].used)]
    return sorted(alike, key=lambda solution: solution.fit.at.cost) + others


def _worst(solution: Solution, of_captures: float, of_arrivals: float) -> Mask:
    """Of the captures used, those to go next: the worst first, since it draws the others away too."""
    d, arrival = solution.distances, solution.model.arrival
    over = d.captures / limits(d.freedom, of_captures)
    whole = d.arrivals / limits(np.full(len(d.arrivals), 6.0), of_arrivals)
    # An arrival whose captures agree with each other is wrong as a whole.
    agree = d.within <= limits(d.within_freedom, of_captures)
    whole = np.where(agree, whole, 0.0)
    if whole.max() > 1 and not np.any((over > 1) & ~agree[arrival]):
        return np.asarray(arrival == np.argmax(whole))
    apart = np.where(agree[arrival] & (whole[arrival] > 1), 0.0, over)
    return np.asarray((apart > 1) & (apart >= apart.max()))


def _by_reading(data: CaptureArrays) -> Indices:
    """(k,): numbers of arrivals, such that an arrival's active readings agree."""
    numbers = np.empty(len(data), dtype=np.intp)
    count = 0
    for label in dict.fromkeys(data.arrivals.tolist()):
        left = np.flatnonzero(data.arrivals == label)
        while len(left):
            middle = np.median(data.active[left], axis=0)
            nearest = left[np.argmin(np.abs(data.active[left] - middle).max(axis=1))]
            near = np.abs(data.active[left] - data.active[nearest]).max(axis=1) < _APART
            numbers[left[near]] = count
            count, left = count + 1, left[~near]
    return numbers


def excess(squares: float, freedom: int) -> float:
    """By what squares exceed those of the stated noise; 1 if that may be chance."""
    if freedom <= 0 or stats.chi2.sf(squares, freedom) > _SIGNIFICANT:
        return 1.0
    return max(1.0, squares / freedom)
