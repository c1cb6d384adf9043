"""Both transforms by joint maximum likelihood, with what they are worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from dualcal_hal.transforms import Array, Mask
from procedures.estimation.degenerate import Degenerate
from procedures.estimation.refined.data import CaptureArrays, Indices, Knowns, Noise
from procedures.estimation.refined.fit import Fit, minimise, noise_contributions
from procedures.estimation.refined.geometry import refuse_few, refuse_one_axis
from procedures.estimation.refined.inexact import Inexact, Known, WithInexact, fit_inexact
from procedures.estimation.refined.model import CELL, Model
from procedures.estimation.refined.motion import motion_between
from procedures.estimation.refined.mount import counted_from, find_mount, is_free_mount
from procedures.estimation.refined.noise import FoundNoise, find_noise
from procedures.estimation.refined.outliers import (
    Distances,
    between_arrivals,
    distances,
    limits,
    predicted_distances,
)
from procedures.estimation.refined.start import Start, camera_candidates, starts
from procedures.estimation.refined.uncertainty import (
    Direction,
    Limits,
    SpatialError,
    condition,
    directions,
    spatial_error,
)

SECOND = 1.5
"""A second solution that costs at most so many times what the best one does is told of."""

# Captures of one arrival whose active readings differ by more than this are taken for two arrivals.
_APART = 5e-3  # rad

_SUSPICIOUS = 4.0  # squares this many times larger than the noise says: perhaps not the right optimum
_MOST_ROUNDS = 12
_KNOWN_ROUNDS = 6  # of knowns found from captures, and captures judged with these knowns

# Captures that are all off, each in its own way, differ more from each other than noisy ones do: an outlier among them
# is twice as far off as it is among others.
_STANDS_OUT = 4.0  # a square

# What share may be left out: where all may be off together, and where those that stand out explain all.
_FEW, _LESS_THAN_HALF = 1 / 3, 0.49

_MISFIT = 900.0  # squares larger by more than this are not of arms, mounts or cameras that are somewhat off

_NOISE_ROUNDS = 2  # what is found for the noise moves the estimate, which hardly moves what is found
_SIGNIFICANT = 1e-3
_UNCONVERGED = "the estimate has not converged"
_LARGE = 0.005  # m; a predicted sigma above it is warned of


@dataclass(frozen=True)
class Dropped:
    """A capture, by its index, that is not used, and why; distance: from where the others put it, in sigmas rms."""

    capture: int
    reason: str
    distance: float


@dataclass(frozen=True)
class Alternative:
    """Another optimum, (4, 4) each, and its cost over the best one's."""

    T_P_A: Array
    T_H_E: Array
    ratio: float


@dataclass(frozen=True)
class Refined:
    """T_P_A, T_H_E (4, 4); covariance (12, 12) of error = log(T_est^-1 T_true), translation (m) then rotation (rad) in
    the child frame, of T_P_A then of T_H_E.

    directions: of these twelve; condition: of the whitened problem. cost: sum of squares in units of sigma, of
    ``freedom`` degrees of freedom; between and between_freedom: the part in which the arrivals differ from one cell.
    scale: by how much squares exceed those of the stated noise, 1 if that may be chance; if it is not, the covariance
    is that of this estimate under the noise which the captures themselves show, where that is larger.
    residuals (k, n, 2): pixels in units of sigma, NaN for corners not seen and captures not used; distances (k,):
    squared Mahalanobis distance of each capture from where the others put it, NaN for those not used; freedoms (k,):
    its degrees of freedom. flipped (k,): captures taken with their corners from the other end. used (k,). captures:
    those used, with their corners in order.

    noise, knowns: what was reckoned with; found: what the captures themselves say of the noise, if that was asked for;
    inexact: knowns that were not taken as exact, counted from ``prior``, and known: what they are after the estimate;
    joint_covariance (12 + m, 12 + m): of the cell with their m numbers. contributions: to the covariance (12, 12), of
    pixels, of the joints of both arms and of each inexact known. Captures used, squares, residuals and scale are those
    of the fit in which the inexact knowns are where they fit best, if they are only reckoned with too.
    """

    T_P_A: Array
    T_H_E: Array
    covariance: Array
    directions: tuple[Direction, ...]
    condition: float
    cost: float
    freedom: int
    between: float
    between_freedom: int
    scale: float
    residuals: Array
    distances: Array
    freedoms: Array
    used: Mask
    flipped: Mask
    captures: CaptureArrays
    dropped: tuple[Dropped, ...]
    alternatives: tuple[Alternative, ...]
    warnings: tuple[str, ...]
    noise: Noise
    knowns: Knowns
    prior: Knowns
    contributions: dict[str, Array]
    joint_covariance: Array
    found: FoundNoise | None = None
    inexact: tuple[Inexact, ...] = ()
    known: tuple[Known, ...] = ()

    def spatial_error(self, points: ArrayLike) -> SpatialError:
        """Predicted at points (..., 3) of the passive base, m."""
        return spatial_error(self.T_P_A, self.covariance, points)


def refined(
    data: CaptureArrays,
    knowns: Knowns,
    noise: Noise,
    *,
    further_starts: Sequence[tuple[ArrayLike, ArrayLike]] = (),
    keep_all: bool = False,
    estimate_noise: bool = False,
    inexact: Sequence[Inexact] = (),
    estimate_inexact: bool = True,
    observable: Limits | None = None,
) -> Refined:
    """Estimate T_P_A and T_H_E from captures alone.

    further_starts: pairs of T_P_A and T_H_E, such as the nominal ones, tried besides those found from the captures.
    keep_all: no capture is dropped however badly it fits. estimate_noise: the sigmas are found from the captures; of
    ``noise`` only the ratio of both arms counts then, and where to begin. Raises Degenerate for captures that do not
    determine both transforms. inexact: knowns with a sigma, estimated with it as their prior, or else only reckoned
    with in the covariance; one that is free is estimated anyway, and Degenerate is raised if it cannot be seen. A
    target mount that is free is sought without what is given of it.
    """
    fixed = (further_starts, keep_all, observable or Limits())
    given = knowns
    if any(is_free_mount(one) for one in inexact):
        mount = find_mount(data, knowns, noise)
        knowns = given if mount is None else replace(given, T_F_T=mount)
    # What does not belong, and how large the noise is, is told only once the knowns are about right.
    result = _estimate(data, knowns, noise, *fixed)
    if inexact:
        result = _with_knowns_that_fit(data, knowns, noise, result, inexact, fixed)
    there, found = result.knowns, None
    for _ in range(_NOISE_ROUNDS if estimate_noise else 0):
        found = find_noise(result.captures, there, noise, result.T_P_A, result.T_H_E)
        result = _estimate(data, there, found.noise, *fixed)
    if found is not None:
        result = replace(result, found=found, warnings=(*result.warnings, *_noise_warnings(found)))
    if inexact:
        found_knowns = _with_inexact(knowns, result.noise, result, inexact, estimate_inexact)
        result = replace(_combined(result, counted_from(given, found_knowns), inexact, fixed[2]), prior=knowns)
    return replace(result, warnings=(*_uncertain(result.directions), *result.warnings))


def _with_knowns_that_fit(
    data: CaptureArrays,
    knowns: Knowns,
    noise: Noise,
    first: Refined,
    inexact: Sequence[Inexact],
    fixed: tuple[Sequence[tuple[ArrayLike, ArrayLike]], bool, Limits],
) -> Refined:
    """The estimate with the knowns where they fit best the captures that it uses, from one with these as given."""
    result = _estimate(data, _with_inexact(knowns, noise, first, inexact, True).knowns, noise, *fixed)
    search = _Search.of(data, result.knowns, noise, keep_all=fixed[1])
    if search.keep_all or (result.scale == 1 and np.array_equal(result.used, search.usable)):
        return result
    # Knowns found from captures that do not belong hide these, and may make others look as if they did not.
    begun, seen_before = _different([result.used, first.used, search.usable]), [result.used]
    for _ in range(_KNOWN_ROUNDS):
        tried = search.trimmed_with(knowns, inexact, result, begun)
        if tried is None:
            break
        result = _estimate(data, tried.model.knowns, noise, *fixed)
        if any(np.array_equal(result.used, before) for before in (tried.used, *seen_before)):
            break
        seen_before.append(result.used)
        begun = [result.used]
    return result


def _different(sets: Sequence[Mask]) -> list[Mask]:
    """Each once, in their order."""
    return list({used.tobytes(): used for used in sets}.values())


def _with_inexact(
    knowns: Knowns, noise: Noise, result: Refined, inexact: Sequence[Inexact], estimated: bool
) -> WithInexact:
    start = Model(result.captures, knowns, noise).state(result.T_P_A, result.T_H_E)
    return fit_inexact(result.captures, knowns, noise, start, inexact, estimated)


def _combined(result: Refined, found: WithInexact, inexact: Sequence[Inexact], observable: Limits) -> Refined:
    """With the inexact knowns in estimate and covariance; what was widened for the residuals stays so."""
    joint = found.covariance.copy()
    joint[:CELL, :CELL] += result.covariance - np.linalg.inv(found.fit.at.normal)
    covariance = joint[:CELL, :CELL]
    hidden = [known.name for known in found.known if not known.seen]
    words = [f"cannot be seen in the captures: {', '.join(hidden)}"] if hidden else []
    if not found.fit.converged and _UNCONVERGED not in result.warnings:
        words.append(_UNCONVERGED)
    return replace(
        result,
        T_P_A=found.fit.state.T_P_A,
        T_H_E=found.fit.state.T_H_E,
        covariance=covariance,
        joint_covariance=joint,
        directions=directions(covariance, observable),
        inexact=tuple(inexact),
        known=found.known,
        knowns=found.knowns,
        contributions={**result.contributions, **found.contributions},
        warnings=(*result.warnings, *words),
    )


def _estimate(
    data: CaptureArrays,
    knowns: Knowns,
    noise: Noise,
    further_starts: Sequence[tuple[ArrayLike, ArrayLike]],
    keep_all: bool,
    observable: Limits,
) -> Refined:
    search = _Search.of(data, knowns, noise, keep_all)
    data, every, usable = search.data, search.every, search.usable
    reached = np.unique(every.arrival[usable])
    refuse_few(len(reached))
    candidates = camera_candidates(every, data.order, data.board_poses, False)
    refuse_one_axis(every.T_A_H[reached], candidates.optical_axes, noise.active, knowns.words)
    everybody = np.ones(len(data), dtype=bool)
    further = [
        Start(np.asarray(T_P_A, dtype=float), np.asarray(T_H_E, dtype=float), ~everybody, np.inf, everybody)
        for T_P_A, T_H_E in further_starts
    ]
    plain = starts(every, candidates, False)
    solutions = search.solutions(plain, False)
    if not solutions or search.suspicious(solutions[0]):
        candidates = camera_candidates(every, data.order, data.board_poses, True)
        thorough = starts(every, candidates, True) + further
        solutions = _best_first(solutions + search.solutions(thorough, True))
        if solutions and not search.explained(solutions[0], _FEW):
            # Where knowns or noise are wrong all captures are off, and the fewer are left, the better these agree.
            search = replace(search, farther=_STANDS_OUT)
            solutions = _best_first(search.solutions(plain, False) + search.solutions(thorough, True))
            if solutions and not search.explained(solutions[0], _LESS_THAN_HALF):
                solutions = [one for one in solutions if search.off_alike(one)] or solutions
    if not solutions:
        raise Degenerate(
            f"nothing explains the {knowns.words.captures}, even roughly:"
            " see that arms, camera and target are the right ones"
        )
    best = solutions[0]
    axes = best.model.arrival_poses(best.fit.state)[0][:, :3, 2]
    warnings = refuse_one_axis(best.model.T_A_H, axes, noise.active, knowns.words)
    return _result(search, best, _alternatives(best, solutions[1:]), warnings, observable)


@dataclass(frozen=True)
class _Solution:
    """A fit to the captures ``used`` (k,), those ``flipped`` (k,) from the other end of their corners; loss: how far
    all captures are off, by the logarithm, so that those which do not belong hardly count.
    """

    model: Model
    fit: Fit
    used: Mask
    flipped: Mask
    distances: Distances
    loss: float


@dataclass(frozen=True)
class _Search:
    """farther: than the least probable capture that belongs, in squares, is one that does not."""

    data: CaptureArrays
    every: Model
    usable: Mask
    keep_all: bool
    farther: float = 1.0

    @classmethod
    def of(cls, data: CaptureArrays, knowns: Knowns, noise: Noise, keep_all: bool) -> _Search:
        data = replace(data, arrivals=_by_reading(data))
        every = Model(data, knowns, noise)
        return cls(data, every, every.seen.sum(axis=1) > 0, keep_all)

    def share_out(self, solution: _Solution) -> float:
        """Of the captures, those left out."""
        return float(1 - solution.used.sum() / self.usable.sum())

    def explained(self, solution: _Solution, most_out: float) -> bool:
        """Whether outliers explain all that is off: the others fit the noise, and are enough to be believed."""
        out = self.share_out(solution)
        return out == 0 or (out <= most_out and _scale(solution) == 1)

    def off_alike(self, solution: _Solution) -> bool:
        """Whether it may be one misfit that all captures share, but for a few."""
        return self.share_out(solution) <= _FEW and _scale(solution) <= _MISFIT

    def solutions(self, found: Sequence[Start], only_fitting: bool) -> list[_Solution]:
        """From all starts, best first; only_fitting: at first with the captures that fit the start."""
        results = []
        for start in found:
            used = self.usable & start.fits if only_fitting and not self.keep_all else self.usable
            solution = self._fitted(start.T_P_A, start.T_H_E, used, start.flipped)
            if solution is not None:
                results.append(solution if self.keep_all else self._trimmed(solution))
        return _best_first(results)

    def suspicious(self, solution: _Solution) -> bool:
        """Whether another start may do better."""
        dropped = not np.array_equal(solution.used, self.usable)
        return dropped or max(solution.distances.scale()) > _SUSPICIOUS or not solution.fit.converged

    def _fitted(self, T_P_A: Array, T_H_E: Array, used: Mask, flipped: Mask) -> _Solution | None:
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
        return _Solution(model, fit, used, flipped, off, float(apart[self.usable].sum()))

    def _trimmed(self, solution: _Solution) -> _Solution:
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

    def trimmed_with(
        self, knowns: Knowns, inexact: Sequence[Inexact], near: Refined, begun: Sequence[Mask]
    ) -> _Solution | None:
        """The best from the cell of another estimate and each of the sets of captures ``begun`` (k,), or the first that
        explains all, as :meth:`_trimmed_with`.
        """
        found = []
        for used in begun:
            solution = self._trimmed_with(knowns, inexact, near, used)
            if solution is not None:
                found.append(solution)
                if self.explained(solution, _FEW):
                    break
        return _best_first(found)[0] if found else None

    def _trimmed_with(self, knowns: Knowns, inexact: Sequence[Inexact], near: Refined, used: Mask) -> _Solution | None:
        """As :meth:`_trimmed`, with the knowns found anew each time from the captures that are left."""
        T_P_A, T_H_E, flipped = near.T_P_A, near.T_H_E, near.flipped
        solution: _Solution | None = None
        seen_before: list[Mask] = []
        for _ in range(len(self.data)):
            seen_before.append(used)
            kept = self.data.turned(flipped).only(used)
            start = Model(kept, near.knowns, self.every.noise).state(T_P_A, T_H_E)
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

    def _judged(self, solution: _Solution) -> tuple[Mask, Mask]:
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


def _best_first(solutions: Sequence[_Solution]) -> list[_Solution]:
    """By their loss, but of those with the captures of the best one the cheapest first."""
    ordered = sorted(solutions, key=lambda solution: solution.loss)
    alike = [solution for solution in ordered if np.array_equal(solution.used, ordered[0].used)]
    others = [solution for solution in ordered if not np.array_equal(solution.used, ordered[0].used)]
    return sorted(alike, key=lambda solution: solution.fit.at.cost) + others


def _worst(solution: _Solution, of_captures: float, of_arrivals: float) -> Mask:
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


def _alternatives(best: _Solution, others: Sequence[_Solution]) -> tuple[Alternative, ...]:
    found: list[Alternative] = []
    cost = max(best.fit.at.cost, 1e-12)
    for other in others:
        fewer = int(other.used.sum()) < int(best.used.sum())
        ratio = other.fit.at.cost / cost
        known = [(best.fit.state.T_P_A, best.fit.state.T_H_E), *((a.T_P_A, a.T_H_E) for a in found)]
        if not fewer and ratio < SECOND and all(_elsewhere(best, other, *cell) for cell in known):
            found.append(Alternative(other.fit.state.T_P_A, other.fit.state.T_H_E, float(ratio)))
    return tuple(found)


def _elsewhere(best: _Solution, other: _Solution, T_P_A: Array, T_H_E: Array) -> bool:
    """Whether another solution is more than three sigma, and more than rounding, from a cell."""
    state = other.fit.state
    d = np.concatenate([motion_between(T_P_A, state.T_P_A), motion_between(T_H_E, state.T_H_E)])
    return bool(d @ best.fit.at.normal @ d > 9 and np.abs(d).max() > 1e-6)


def _result(
    search: _Search,
    best: _Solution,
    alternatives: tuple[Alternative, ...],
    warnings: tuple[str, ...],
    observable: Limits,
) -> Refined:
    model, fit, used = best.model, best.fit, best.used
    freedom = model.measurements - CELL
    between, between_freedom = between_arrivals(fit)
    scale = _scale(best)
    contributions = noise_contributions(fit, model.arrival)
    if scale > 1:
        contributions = _widened(search, best, contributions, scale)
    covariance = sum(contributions.values(), np.zeros((CELL, CELL)))
    found = directions(covariance, observable)
    k, n = search.every.seen.shape
    residuals, squares = np.full((k, n, 2), np.nan), np.full(k, np.nan)
    residuals[used] = np.where(model.seen[..., None], model.residuals(fit.state), np.nan)
    squares[used] = best.distances.captures
    return Refined(
        T_P_A=fit.state.T_P_A,
        T_H_E=fit.state.T_H_E,
        covariance=covariance,
        directions=found,
        condition=condition(fit.at.normal),
        cost=fit.at.cost,
        freedom=freedom,
        between=between,
        between_freedom=between_freedom,
        scale=scale,
        residuals=residuals,
        distances=squares,
        freedoms=search.every.freedom,
        used=used,
        flipped=best.flipped,
        captures=search.data.turned(best.flipped).only(used),
        dropped=_dropped(search, best),
        alternatives=alternatives,
        warnings=(*warnings, *_warnings(fit, scale, alternatives)),
        noise=search.every.noise,
        knowns=search.every.knowns,
        prior=search.every.knowns,
        contributions=contributions,
        joint_covariance=covariance,
    )


def _widened(search: _Search, best: _Solution, contributions: dict[str, Array], scale: float) -> dict[str, Array]:
    """What each source contributes when it is as large as the captures show it, if that is larger than stated; and all
    of them by as much more as the arrivals still differ from one cell under such noise: what is wrong with knowns and
    arms shows there, and is no noise.
    """
    stated, state, knowns = search.every.noise, best.fit.state, search.every.knowns
    kept = search.data.turned(best.flipped).only(best.used)
    found = find_noise(kept, knowns, stated, state.T_P_A, state.T_H_E).noise
    if min(stated.active, stated.passive) == 0:
        return {what: scale * part for what, part in contributions.items()}
    ratios = {
        "pixels": max(1.0, found.pixel / stated.pixel),
        "active joints": max(1.0, found.active / stated.active),
        "passive joints": max(1.0, found.passive / stated.passive),
    }
    active, passive = ratios["active joints"], ratios["passive joints"]
    shown = Noise(ratios["pixels"] * stated.pixel, active * stated.active, passive * stated.passive)
    # The arms' errors are counted in sigmas.
    there = replace(state, active=state.active / active, passive=state.passive / passive)
    left = _excess(*between_arrivals(minimise(Model(kept, knowns, shown), there)))
    return {what: left * ratios[what] ** 2 * part for what, part in contributions.items()}


def _scale(solution: _Solution) -> float:
    """By what its squares exceed those of the stated noise, those between arrivals by themselves too."""
    between = _excess(*between_arrivals(solution.fit))
    return max(_excess(solution.fit.at.cost, solution.model.measurements - CELL), between)


def _excess(squares: float, freedom: int) -> float:
    """By what squares exceed those of the stated noise; 1 if that may be chance."""
    if freedom <= 0 or stats.chi2.sf(squares, freedom) > _SIGNIFICANT:
        return 1.0
    return max(1.0, squares / freedom)


def _uncertain(found: Sequence[Direction]) -> list[str]:
    words = []
    large = [d for d in found if d.name.startswith("translation") and d.sigma > _LARGE]
    if large:
        names = ", ".join(f"{d.name} by {1e3 * d.sigma:.1f} mm" for d in large)
        words.append(f"uncertain (1 sigma): {names}; captures with the active flange turned further would help")
    hidden = [d.name for d in found if not d.observable and d not in large]
    if hidden:
        words.append(f"not observable: {', '.join(hidden)}")
    return words


def _warnings(fit: Fit, scale: float, alternatives: Sequence[Alternative]) -> list[str]:
    words = []
    if not fit.converged:
        words.append(_UNCONVERGED)
    if scale > 1:
        words.append(
            f"residuals are {np.sqrt(scale):.1f} times what the stated noise explains; the covariance is widened"
        )
    words += [f"a second solution costs only {alternative.ratio:.2f} times as much" for alternative in alternatives]
    return words


def _noise_warnings(found: FoundNoise) -> list[str]:
    unknown = [
        f"{name} of at most {scale * sigma.upper:.3g} {unit} cannot be told from none"
        for name, sigma, scale, unit in (
            ("a pixel sigma", found.pixel, 1, "px"),
            ("a joint sigma", found.joint, 1e3, "mrad"),
        )
        if not sigma.identified
    ]
    return [f"{words}; it was reckoned with" for words in unknown]


def _dropped(search: _Search, best: _Solution) -> tuple[Dropped, ...]:
    gone = np.flatnonzero(search.usable & ~best.used)
    unseen = [Dropped(int(k), "no corner was seen", np.nan) for k in np.flatnonzero(~search.usable)]
    if not len(gone):
        return tuple(unseen)
    every = search.every
    freedom = np.maximum(every.freedom, 1)
    predicted = predicted_distances(best.model, every, best.fit, best.flipped)
    turned = predicted_distances(best.model, every, best.fit, ~best.flipped)
    reached = limits(freedom, max(best.distances.scale()))
    named = []
    for k in gone:
        sigmas = float(np.sqrt(predicted[k] / freedom[k]))
        together = (every.arrival == every.arrival[k]) & search.usable
        if turned[k] < reached[k]:
            reason = "its corners are listed from the other end"
        elif together.sum() > 1 and not best.used[together].any():
            reason = "all captures of its arrival are off: the active arm stood elsewhere than it was read"
        elif np.isinf(sigmas):
            reason = f"its board should be behind the camera, by where the other {every.knowns.words.captures} put it"
        else:
            reason = f"{sigmas:.0f} sigma (rms) from where the other {every.knowns.words.captures} put it"
        named.append(Dropped(int(k), reason, sigmas))
    return (*unseen, *named)
