"""Knowns that are not exact: estimated with what is known of them as a prior, or only reckoned with.

Each is a few numbers by which the knowns are off, zero where they are exact, with a sigma each; an infinite sigma frees
one. The cell and the arms are fitted for given knowns; the knowns follow by Levenberg-Marquardt on what that leaves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from dualcal_hal.kinematics import Chain, Row
from dualcal_hal.transforms import Array, Mask
from procedures.estimation.degenerate import Degenerate
from procedures.estimation.refined.data import CaptureArrays, Knowns, Noise
from procedures.estimation.refined.fit import Fit, minimise
from procedures.estimation.refined.model import CELL, Model, State
from procedures.estimation.refined.motion import moved

UNSEEN = 0.98
"""Of its prior sigma: what the captures do not make smaller than this, they do not see."""

_STEP = 1e-5  # m, rad, or a part of one: of the differences
_MOST_STEPS = 25
_DAMPING = (1e-4, 1e10)  # at first, and where no step helps any more
_LEAST_DAMPING = 1e-9
_FREE_STEP = 1.0  # damping below which a step goes about as far as it would without

# In units of sigma squared, as large as the captures show them: what the fit of cell and arms leaves, too.
_SMALLEST_GAIN = 1e-4
_SINGULAR = 1e-8  # of the scaled information, a square


@dataclass(frozen=True)
class Inexact:
    """names, units (m, rad, px, or "" for a part of one) and sigmas (m,) of the numbers by which ``shifted`` says
    knowns are off; scale (m,): of what counts as a small change of each.
    """

    what: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    sigmas: Array
    scale: Array
    shifted: Callable[[Knowns, Array], Knowns]

    @property
    def is_free(self) -> bool:
        """Whether some of it has no prior: then all of it is estimated."""
        return not bool(np.all(np.isfinite(self.sigmas)))


def target_mount(translation: float, rotation: float) -> Inexact:
    """T_F_T, moved in T: sigmas in m and rad."""

    def shifted(knowns: Knowns, by: Array) -> Knowns:
        return replace(knowns, T_F_T=moved(knowns.T_F_T, by))

    names = tuple(f"target mount, {what} {axis}" for what in ("along", "about") for axis in "xyz")
    sigmas = np.repeat([translation, rotation], 3)
    return _without_exact("target mount", names, ("m",) * 3 + ("rad",) * 3, sigmas, np.ones(6), shifted)


def square_size(relative: float) -> Inexact:
    """All squares by one part."""

    def shifted(knowns: Knowns, by: Array) -> Knowns:
        return replace(knowns, corners=knowns.corners * (1 + by[0]))

    return Inexact("square size", ("square size",), ("",), np.array([relative]), np.ones(1), shifted)


def intrinsics(focal: float, centre: float, distortion: Sequence[float]) -> Inexact:
    """Sigmas of both focal lengths and of the principal point, px, and of the five coefficients."""

    def shifted(knowns: Knowns, by: Array) -> Knowns:
        matrix = knowns.matrix.copy()
        matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += by[:4]
        return replace(knowns, matrix=matrix, distortion=knowns.distortion + by[4:])

    sigmas = np.array([focal, focal, centre, centre, *distortion], dtype=float)
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    units = ("px",) * 4 + ("",) * 5
    return _without_exact("intrinsics", names, units, sigmas, np.array([1e3] * 4 + [1.0] * 5), shifted)


# Sigmas of what lenses have, with room: of a coefficient either the captures know far more, or it moves no corner that
# was seen.
_LENS = (1.0, 10.0, 0.05, 0.05, 100.0)


def free_intrinsics() -> Inexact:
    """Focal lengths and principal point free, the coefficients within what lenses have: a board that is only seen in
    the middle of the image shows nothing of them.
    """
    return intrinsics(np.inf, np.inf, _LENS)


def joint_zeros(arm: str, sigmas: Sequence[float]) -> Inexact:
    """Of the ``active`` or ``passive`` arm, one sigma a joint, rad."""

    def shifted(knowns: Knowns, by: Array) -> Knowns:
        rows = getattr(knowns, arm).rows
        turned = tuple(replace(row, theta=row.theta + float(angle)) for row, angle in zip(rows, by, strict=True))
        return _with_arm(knowns, arm, turned)

    names = tuple(f"zero of joint {i + 1} of the {arm} arm" for i in range(len(sigmas)))
    values = np.asarray(sigmas, dtype=float)
    return _without_exact(
        f"joint zeros of the {arm} arm", names, ("rad",) * len(values), values, np.ones(len(values)), shifted
    )


def link_parameters(arm: str, chain: Chain, length: float, angle: float) -> Inexact:
    """Of each row of the ``active`` or ``passive`` arm with this chain: d, a and alpha, or a, alpha and beta of a
    Hayati row, whose d is that of its neighbour; sigmas in m and rad.
    """
    kinds = [("d", "a", "alpha") if row.beta is None else ("a", "alpha", "beta") for row in chain.rows]

    def shifted(knowns: Knowns, by: Array) -> Knowns:
        rows: tuple[Row, ...] = getattr(knowns, arm).rows
        moved_rows = []
        for row, kind, numbers in zip(rows, kinds, by.reshape(-1, 3), strict=True):
            changed = {what: getattr(row, what) + float(number) for what, number in zip(kind, numbers, strict=True)}
            moved_rows.append(replace(row, **changed))
        return _with_arm(knowns, arm, tuple(moved_rows))

    every = [(what, i + 1) for i, kind in enumerate(kinds) for what in kind]
    names = tuple(f"{what} of row {i} of the {arm} arm" for what, i in every)
    units = tuple("m" if what in ("d", "a") else "rad" for what, _ in every)
    sigmas = np.array([length if unit == "m" else angle for unit in units])
    return _without_exact(f"links of the {arm} arm", names, units, sigmas, np.ones(len(sigmas)), shifted)


def common_scale(relative: float) -> Inexact:
    """All lengths of both arms by one part. Raises Degenerate for an infinite sigma: only squares of exactly known size
    show it, and hardly.
    """
    if not np.isfinite(relative):
        raise Degenerate(f"cannot be seen in the captures, so cannot be free: {COMMON_SCALE}")

    def shifted(knowns: Knowns, by: Array) -> Knowns:
        factor = 1 + float(by[0])
        return _scaled(_scaled(knowns, "active", factor), "passive", factor)

    return Inexact(COMMON_SCALE, (COMMON_SCALE,), ("",), np.array([relative]), np.ones(1), shifted)


COMMON_SCALE = "common scale of both arms"


def _scaled(knowns: Knowns, arm: str, factor: float) -> Knowns:
    rows: tuple[Row, ...] = getattr(knowns, arm).rows
    return _with_arm(knowns, arm, tuple(replace(row, d=factor * row.d, a=factor * row.a) for row in rows))


def _with_arm(knowns: Knowns, arm: str, rows: tuple[Row, ...]) -> Knowns:
    return replace(knowns, active=Chain(rows)) if arm == "active" else replace(knowns, passive=Chain(rows))


def _without_exact(
    what: str,
    names: tuple[str, ...],
    units: tuple[str, ...],
    sigmas: Array,
    scale: Array,
    shifted: Callable[[Knowns, Array], Knowns],
) -> Inexact:
    """Numbers with a sigma of zero stay where they are."""
    moving = sigmas > 0

    def of_all(knowns: Knowns, by: Array) -> Knowns:
        every = np.zeros(len(sigmas))
        every[moving] = by
        return shifted(knowns, every)

    kept = np.flatnonzero(moving)
    return Inexact(
        what, tuple(names[i] for i in kept), tuple(units[i] for i in kept), sigmas[moving], scale[moving], of_all
    )


@dataclass(frozen=True)
class Known:
    """One number after the estimate: by how much the knowns were off, in ``unit`` ("" for a part of one), its sigma
    before and after, and whether the captures see it at all.
    """

    name: str
    unit: str
    value: float
    prior: float
    sigma: float
    seen: bool


@dataclass(frozen=True)
class WithInexact:
    """The fit with the knowns where they fit best, or as given where they are only reckoned with; covariance
    (12 + m, 12 + m) of the cell and of these; contributions: of each of them to the cell's (12, 12), by what it is.
    """

    fit: Fit
    model: Model
    knowns: Knowns
    covariance: Array
    known: tuple[Known, ...]
    contributions: dict[str, Array]


def fit_inexact(
    data: CaptureArrays, knowns: Knowns, noise: Noise, start: State, inexact: Sequence[Inexact], estimated: bool
) -> WithInexact:
    """From a fit to captures that belong, with their corners in order. estimated: False leaves knowns with a sigma as
    they are and adds what they may be off by to the covariance. Raises Degenerate for a freed number that cannot be
    seen.
    """
    sigmas = np.concatenate([one.sigmas for one in inexact])
    precision = np.where(np.isfinite(sigmas), 1 / sigmas**2, 0.0)
    sought = np.concatenate([np.full(len(one.sigmas), estimated or one.is_free) for one in inexact])
    search = _Search(data, knowns, noise, inexact, precision, sought)
    there, converged = search.descended(search.at(np.zeros(len(sigmas)), start))
    model, fit, cross, theta = there.model, there.fit, there.cross, there.theta
    left, size = search.left(there), search.size(there)
    posterior = np.sqrt(np.diag(_inverted(left, size, inexact, np.ones_like(sought))))
    covariance = _inverted(left, size, inexact, sought) if sought.any() else np.zeros_like(left)
    # What is only reckoned with draws along what is sought.
    through_sought = np.diag(np.where(sought, 0.0, 1.0))
    through_sought -= covariance @ left @ through_sought
    spread = covariance + through_sought @ np.diag(np.where(sought, 0.0, sigmas) ** 2) @ through_sought.T
    follow = np.linalg.solve(fit.at.normal, cross)  # by how much the cell follows a change of the knowns, reversed
    of_cell = np.linalg.inv(fit.at.normal) + follow @ spread @ follow.T
    together = -follow @ spread
    # How the error of each sigma's number comes through: of a prior, and of what is only reckoned with.
    through = follow @ (covariance @ np.diag(precision) + through_sought)
    return WithInexact(
        fit=replace(fit, converged=fit.converged and converged),
        model=model,
        knowns=model.knowns,
        covariance=np.block([[of_cell, together], [together.T, spread]]),
        known=tuple(_known(inexact, theta, sigmas, posterior, sought)),
        contributions={
            one.what: through[:, at]
            @ np.diag(np.where(np.isfinite(one.sigmas), one.sigmas, 0.0) ** 2)
            @ through[:, at].T
            for one, at in zip(inexact, _slices(inexact), strict=True)
        },
    )


@dataclass(frozen=True)
class _There:
    """The fit of cell and arms with knowns that are off by ``theta`` (m,), what it says of these (see
    :func:`information`), and the cost with that of their priors.
    """

    theta: Array
    model: Model
    fit: Fit
    cross: Array
    own: Array
    gradient: Array
    cost: float


@dataclass(frozen=True)
class _Search:
    """For the numbers ``sought`` (m,), of prior ``precision`` (m,), by which knowns are off."""

    data: CaptureArrays
    knowns: Knowns
    noise: Noise
    inexact: Sequence[Inexact]
    precision: Array
    sought: Mask

    def at(self, theta: Array, start: State) -> _There:
        model = Model(self.data, _shifted(self.knowns, self.inexact, theta), self.noise)
        fit = minimise(model, start)
        cost = fit.at.cost + float(theta @ (self.precision * theta))
        if not np.isfinite(cost):
            none = np.zeros(0)
            return _There(theta, model, fit, none, none, none, np.inf)
        return _There(
            theta, model, fit, *information(self.data, self.knowns, self.noise, self.inexact, theta, model, fit), cost
        )

    def left(self, there: _There) -> Array:
        """Information (m, m) on the numbers, cell and arms marginalised."""
        cross = there.cross
        return np.asarray(there.own - cross.T @ np.linalg.solve(there.fit.at.normal, cross) + np.diag(self.precision))

    def size(self, there: _There) -> Array:
        """(m,): roots of the information there would be if all else were known."""
        return np.asarray(np.sqrt(np.diag(there.own) + self.precision))

    def descended(self, there: _There) -> tuple[_There, bool]:
        """Where the cost is least, and whether that was reached."""
        if not np.isfinite(there.cost):
            raise Degenerate("nothing explains the captures, even roughly: some board should be behind the camera")
        damping, most = _DAMPING
        for _ in range(_MOST_STEPS if self.sought.any() else 0):
            size = self.size(there)[self.sought]
            scaled = self.left(there)[np.ix_(self.sought, self.sought)] / np.outer(size, size)
            slope = (there.gradient + self.precision * there.theta)[self.sought] / size
            theta = there.theta.copy()
            theta[self.sought] -= np.linalg.solve(scaled + damping * np.eye(len(size)), slope) / size
            tried = self.at(theta, there.fit.state)
            gain, least = there.cost - tried.cost, _SMALLEST_GAIN * max(1.0, there.cost / there.model.measurements)
            if gain > -least:
                there, damping = tried, max(damping / 10, _LEAST_DAMPING)
                if gain < least and damping < _FREE_STEP:
                    return there, True
            else:
                damping *= 10
                if damping > most:
                    return there, False
        return there, not self.sought.any()


def information(
    data: CaptureArrays,
    knowns: Knowns,
    noise: Noise,
    inexact: Sequence[Inexact],
    theta: Array,
    model: Model,
    fit: Fit,
) -> tuple[Array, Array, Array]:
    """Of the cell with the knowns (12, m), of these among themselves (m, m), the arms marginalised from both; gradient
    (m,) at the fit, where the arms' errors already are at their best.
    """
    D = by_inexact(data, knowns, noise, inexact, fit.state, theta)
    at = fit.at
    r = model.residuals(fit.state).reshape(model.captures, -1)
    towards_pose = np.swapaxes(model.jacobian(fit.state), 1, 2) @ D

    own = np.einsum("kri,krj->ij", D, D)
    passive = np.swapaxes(at.towards_passive, 1, 2) @ towards_pose
    folded = np.linalg.solve(_inner(at.towards_passive, at.pixel_normal), passive)
    own -= np.einsum("kni,knj->ij", passive, folded)
    towards_pose = towards_pose - at.pixel_normal @ at.towards_passive @ folded

    summed = np.zeros((model.arrivals, *towards_pose.shape[1:]))
    np.add.at(summed, model.arrival, towards_pose)
    active = np.swapaxes(at.towards_active, 1, 2) @ summed
    folded = np.linalg.solve(_inner(at.towards_active, at.arrival_normal), active)
    own -= np.einsum("ani,anj->ij", active, folded)
    summed = summed - at.arrival_normal @ at.towards_active @ folded
    cross = np.einsum("aci,acm->im", at.towards_cell, summed)
    return cross.reshape(CELL, -1), own, np.einsum("kri,kr->i", D, r)


def by_inexact(
    data: CaptureArrays,
    knowns: Knowns,
    noise: Noise,
    inexact: Sequence[Inexact],
    state: State,
    theta: Array | None = None,
) -> Array:
    """(k, 2n, m): how the residuals, in units of sigma, change with the numbers by which knowns are off, around
    ``theta`` (m,), zero by default.
    """
    steps = np.concatenate([np.zeros(0), *(_STEP * one.scale for one in inexact)])
    there = np.zeros(len(steps)) if theta is None else theta
    columns = np.empty((len(data), 2 * data.pixels.shape[1], len(steps)))
    for i, step in enumerate(np.diag(steps)):
        ends = (Model(data, _shifted(knowns, inexact, there + by), noise).residuals(state) for by in (step, -step))
        columns[..., i] = np.subtract(*ends).reshape(len(data), -1) / (2 * steps[i])
    return columns


def _inner(towards: Array, normal: Array) -> Array:
    return np.asarray(np.eye(towards.shape[-1]) + np.swapaxes(towards, 1, 2) @ normal @ towards)


def _inverted(information: Array, size: Array, inexact: Sequence[Inexact], sought: Mask) -> Array:
    """(m, m), zero but for the numbers ``sought`` (m,), the others being known. size (m,): roots of the information
    there would be if all else were known.
    """
    names = np.array([name for one in inexact for name in one.names])[sought]
    free = np.concatenate([~np.isfinite(one.sigmas) for one in inexact])[sought]
    inverse = np.zeros_like(information)
    information, size = information[np.ix_(sought, sought)], size[sought]
    values, axes = np.linalg.eigh(information / np.outer(size, size))
    if values[0] < _SINGULAR and free.any():
        hidden = [names[i] for i in np.flatnonzero(free & (np.abs(axes[:, 0]) > 0.3))]
        raise Degenerate(f"cannot be seen in the captures, so cannot be free: {', '.join(hidden) or 'what was freed'}")
    inverse[np.ix_(sought, sought)] = (axes / np.maximum(values, _SINGULAR)) @ axes.T / np.outer(size, size)
    return inverse


def _shifted(knowns: Knowns, inexact: Sequence[Inexact], theta: Array) -> Knowns:
    for one, at in zip(inexact, _slices(inexact), strict=True):
        knowns = one.shifted(knowns, theta[at])
    return knowns


def _slices(inexact: Sequence[Inexact]) -> list[slice]:
    ends = np.cumsum([0, *(len(one.sigmas) for one in inexact)])
    return [slice(int(begin), int(end)) for begin, end in pairwise(ends)]


def _known(inexact: Sequence[Inexact], theta: Array, prior: Array, posterior: Array, sought: Mask) -> list[Known]:
    names = [both for one in inexact for both in zip(one.names, one.units, strict=True)]
    return [
        Known(*both, float(value), float(before), float(after if found else before), bool(after < UNSEEN * before))
        for both, value, before, after, found in zip(names, theta, prior, posterior, sought, strict=True)
    ]
