"""What may be wrong where captures are not as predicted: what, left to all captures, would explain them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from dualcal_hal.kinematics import Chain
from dualcal_hal.transforms import Mask
from procedures.estimation.degenerate import Degenerate
from procedures.estimation.refined.data import CaptureArrays
from procedures.estimation.refined.estimate import Refined
from procedures.estimation.refined.fit import Fit, minimise
from procedures.estimation.refined.inexact import (
    Inexact,
    Known,
    fit_inexact,
    joint_zeros,
    link_parameters,
    target_mount,
)
from procedures.estimation.refined.model import CELL, Model
from procedures.estimation.refined.outliers import distances
from procedures.estimation.refined.verification import LEAST_PROBABILITY, corner_squares, in_order

# Far more than any of them is off in a cell that somebody calibrated: what is found is what the captures say.
_MOUNT = (0.02, float(np.radians(5.0)))  # m, rad
_ZERO = float(np.radians(1.0))
_LINK = (0.002, float(np.radians(0.3)))  # m, rad

_MOST_OF_IT = 0.5  # of what is too much
_LOOSE = "looseness: backlash, sag, a camera or target that is not tight"
_CORNERS = (
    "the corners, which are off any board by more than the stated pixel sigma: focus, light, intrinsics, a board that "
    "is not flat"
)
_TOGETHER = "the estimate: all captures together fit one cell, so calibrate with more of them"
_FEWEST_ARRIVALS = 3


@dataclass(frozen=True)
class Suspect:
    """words: what to look at, and by how much it would have to be off; share: of the squares that are more than chance
    makes them, what it takes away; explains: whether what is left may be chance.
    """

    words: str
    share: float
    explains: bool


def next_suspects(result: Refined, captures: CaptureArrays, names: Sequence[str] | None = None) -> tuple[Suspect, ...]:
    """In the order in which to look at them: what explains the captures first, then what explains most of what is too
    much, then the rest; in each group what is most often wrong in real cells first: the target's mount, the zeros of
    the joints, the calibration of the arms, a capture or an arrival that alone is off, and what no calibration mends.
    Before these corners that are off whatever board, and none of these where one cell fits all captures.

    captures: all of them, in any order; names: of each, by default its index.
    """
    captures = in_order(result, captures)
    called = [str(k) for k in range(len(captures))] if names is None else list(names)
    try:
        as_given = _fitted(result, captures, result.inexact)
    except (Degenerate, np.linalg.LinAlgError):
        return (Suspect(_LOOSE, 0.0, False),)
    corners = (Suspect(_CORNERS, 0.0, False),) if as_given.corners_off() else ()
    if as_given.explains():
        return corners or (Suspect(_TOGETHER, 1.0, True),)
    found = [*_knowns(result, captures, as_given), *_left_out(result, captures, as_given, called)]
    explaining = [one for one in found if one.explains]
    mostly = [one for one in found if not one.explains and one.share >= _MOST_OF_IT]
    hardly = [one for one in found if not one.explains and one.share < _MOST_OF_IT]
    told = _LOOSE if explaining else f"{_LOOSE}; nothing else alone explains the captures"
    return (*corners, *explaining, *mostly, Suspect(told, 0.0, False), *hardly)


@dataclass(frozen=True)
class _Fitted:
    """Captures fitted with some knowns left to them: squares of boards that are elsewhere than the cell has them, and
    their degrees of freedom; corners and corner_freedom: those of corners that are elsewhere than their board has them.
    """

    model: Model
    fit: Fit
    known: tuple[Known, ...]
    squares: float
    freedom: float
    corners: float
    corner_freedom: float

    def corners_off(self) -> bool:
        return self.corner_freedom > 0 and bool(stats.chi2.sf(self.corners, self.corner_freedom) < LEAST_PROBABILITY)

    @property
    def excess(self) -> float:
        return self.squares - self.freedom

    def explains(self) -> bool:
        return self.freedom > 0 and bool(stats.chi2.sf(self.squares, self.freedom) >= LEAST_PROBABILITY)

    def suspect(self, what: str, words: str, before: _Fitted) -> Suspect:
        """what: to look at; words: what then explains the captures."""
        share = float(np.clip(1 - self.excess / max(before.excess, 1e-12), 0.0, 1.0))
        if self.explains():
            return Suspect(f"{what}: {words} would explain the captures", share, True)
        if share >= _MOST_OF_IT:
            return Suspect(f"{what}: {words} would explain {100 * share:.0f} % of what is too much", share, False)
        return Suspect(what, share, False)


def _fitted(result: Refined, captures: CaptureArrays, inexact: Sequence[Inexact]) -> _Fitted:
    model = Model(captures, result.knowns, result.noise)
    start = model.state(result.T_P_A, result.T_H_E)
    known: tuple[Known, ...] = ()
    if inexact:
        found = fit_inexact(captures, result.knowns, result.noise, start, inexact, True)
        model, fit, known = found.model, found.fit, found.known
    else:
        fit = minimise(model, start)
    if not np.isfinite(fit.at.cost):
        raise Degenerate("a board should be behind the camera")
    of_corners, ranks = corner_squares(fit.at)
    corners, boards = float(of_corners.sum()), float(ranks.sum())
    numbers = sum(1 - min(one.sigma / one.prior, 1.0) ** 2 for one in known)
    squares = fit.at.cost - corners
    return _Fitted(model, fit, known, squares, boards - CELL - numbers, corners, model.measurements - boards)


def _knowns(result: Refined, captures: CaptureArrays, as_given: _Fitted) -> Iterator[Suspect]:
    arms = {"active": result.knowns.active, "passive": result.knowns.passive}
    chains = {arm: chain for arm, chain in arms.items() if isinstance(chain, Chain)}
    zeros = [joint_zeros(arm, [_ZERO] * chain.joints) for arm, chain in chains.items()]
    links = [link_parameters(arm, chain, *_LINK) for arm, chain in chains.items()]
    tried: list[tuple[str, list[Inexact], Callable[[Sequence[Known]], str]]] = [
        ("the target's mount on its flange", [target_mount(*_MOUNT)], _together),
        ("the zeros of the joints", zeros, _largest),
        ("the calibration of the arms", links, _largest),
    ]
    for what, inexact, words in tried:
        freed = {one.what for one in inexact}
        others = [one for one in result.inexact if one.what not in freed]
        try:
            fitted = _fitted(result, captures, [*inexact, *others])
        except (Degenerate, np.linalg.LinAlgError):
            yield Suspect(what, 0.0, False)
            continue
        names = {name for one in inexact for name in one.names}
        known = [one for one in fitted.known if one.name in names]
        yield fitted.suspect(what, words(known), as_given)


def _together(known: Sequence[Known]) -> str:
    """Of a pose."""
    shift, turn = (float(np.linalg.norm([one.value for one in known if one.unit == unit])) for unit in ("m", "rad"))
    return f"{1e3 * shift:.2g} mm and {np.degrees(turn):.2g} deg off"


def _largest(known: Sequence[Known]) -> str:
    """What stands out most, in sigmas, of what is seen."""
    seen = [one for one in known if one.seen] or list(known)
    most = max(seen, key=lambda one: abs(one.value) / one.sigma)
    size = abs(most.value)
    amount = f"{np.degrees(size):.2g} deg" if most.unit == "rad" else f"{1e3 * size:.2g} mm"
    return f"{most.name} off by {amount}"


def _left_out(result: Refined, captures: CaptureArrays, as_given: _Fitted, called: Sequence[str]) -> Iterator[Suspect]:
    """The capture that fits worst, and the captures of the arrival that does, each left out."""
    model = as_given.model
    off = distances(model, as_given.fit)
    capture = int(np.argmax(off.captures / np.maximum(off.freedom, 1)))
    arrival = model.arrival == int(np.argmax(off.arrivals))
    ids = ", ".join(called[int(k)] for k in np.flatnonzero(arrival))
    for what, out in (
        (f"capture {called[capture]}", np.arange(len(captures)) == capture),
        (f"where the active arm stood at {ids}", arrival),
    ):
        yield from _without(result, captures, as_given, what, out)


def _without(result: Refined, captures: CaptureArrays, as_given: _Fitted, what: str, out: Mask) -> Iterator[Suspect]:
    if len(np.unique(as_given.model.arrival[~out])) < _FEWEST_ARRIVALS:
        return
    try:
        fitted = _fitted(result, captures.only(~out), result.inexact)
    except (Degenerate, np.linalg.LinAlgError):
        return
    if fitted.explains():
        yield fitted.suspect(what, "it alone being off", as_given)
