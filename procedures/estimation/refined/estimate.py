"""Both transforms by joint maximum likelihood, with what they are worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.transforms import Array, Mask
from procedures.estimation.degenerate import Degenerate
from procedures.estimation.refined.data import CaptureArrays, Knowns, Noise
from procedures.estimation.refined.fit import Fit, minimise, noise_contributions
from procedures.estimation.refined.geometry import refuse_few, refuse_one_axis
from procedures.estimation.refined.inexact import Inexact, Known, WithInexact, fit_inexact
from procedures.estimation.refined.model import CELL, Model
from procedures.estimation.refined.motion import motion_between
from procedures.estimation.refined.mount import counted_from, find_mount, is_free_mount
from procedures.estimation.refined.noise import FoundNoise, find_noise
from procedures.estimation.refined.outliers import (
    between_arrivals,
    limits,
    predicted_distances,
)
from procedures.estimation.refined.search import (
    FEW,
    LESS_THAN_HALF,
    STANDS_OUT,
    Search,
    Solution,
    best_first,
    excess,
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

_KNOWN_ROUNDS = 6  # of knowns found from captures, and captures judged with these knowns
_NOISE_ROUNDS = 2  # what is found for the noise moves the estimate, which hardly moves what is found
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
    search = Search.of(data, result.knowns, noise, keep_all=fixed[1])
    if search.keep_all or (result.scale == 1 and np.array_equal(result.used, search.usable)):
        return result
    # Knowns found from captures that do not belong hide these, and may make others look as if they did not.
    begun, seen_before = _different([result.used, first.used, search.usable]), [result.used]
    for _ in range(_KNOWN_ROUNDS):
        near = [Start(result.T_P_A, result.T_H_E, result.flipped, np.inf, used) for used in begun]
        tried = search.trimmed_with(knowns, inexact, near)
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
    search = Search.of(data, knowns, noise, keep_all)
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
        solutions = best_first(solutions + search.solutions(thorough, True))
        if solutions and not search.explained(solutions[0], FEW):
            # Where knowns or noise are wrong all captures are off, and the fewer are left, the better these agree.
            search = replace(search, farther=STANDS_OUT)
            solutions = best_first(search.solutions(plain, False) + search.solutions(thorough, True))
            if solutions and not search.explained(solutions[0], LESS_THAN_HALF):
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


def _alternatives(best: Solution, others: Sequence[Solution]) -> tuple[Alternative, ...]:
    found: list[Alternative] = []
    cost = max(best.fit.at.cost, 1e-12)
    for other in others:
        fewer = int(other.used.sum()) < int(best.used.sum())
        ratio = other.fit.at.cost / cost
        known = [(best.fit.state.T_P_A, best.fit.state.T_H_E), *((a.T_P_A, a.T_H_E) for a in found)]
        if not fewer and ratio < SECOND and all(_elsewhere(best, other, *cell) for cell in known):
            found.append(Alternative(other.fit.state.T_P_A, other.fit.state.T_H_E, float(ratio)))
    return tuple(found)


def _elsewhere(best: Solution, other: Solution, T_P_A: Array, T_H_E: Array) -> bool:
    """Whether another solution is more than three sigma, and more than rounding, from a cell."""
    state = other.fit.state
    d = np.concatenate([motion_between(T_P_A, state.T_P_A), motion_between(T_H_E, state.T_H_E)])
    return bool(d @ best.fit.at.normal @ d > 9 and np.abs(d).max() > 1e-6)


def _result(
    search: Search,
    best: Solution,
    alternatives: tuple[Alternative, ...],
    warnings: tuple[str, ...],
    observable: Limits,
) -> Refined:
    model, fit, used = best.model, best.fit, best.used
    freedom = model.measurements - CELL
    between, between_freedom = between_arrivals(fit)
    scale = best.scale
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


def _widened(search: Search, best: Solution, contributions: dict[str, Array], scale: float) -> dict[str, Array]:
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
    left = excess(*between_arrivals(minimise(Model(kept, knowns, shown), there)))
    return {what: left * ratios[what] ** 2 * part for what, part in contributions.items()}


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


def _dropped(search: Search, best: Solution) -> tuple[Dropped, ...]:
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
