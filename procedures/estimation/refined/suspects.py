"""What may be wrong where captures are not as predicted: what, left to all captures, would explain them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from dualcal_hal.kinematics import Chain
from dualcal_hal.transforms import Array, Mask
from procedures.estimation.degenerate import Degenerate
from procedures.estimation.refined.again import Again, fit_again
from procedures.estimation.refined.data import CaptureArrays, Noise
from procedures.estimation.refined.estimate import Refined
from procedures.estimation.refined.inexact import Inexact, Known, joint_zeros, link_parameters, target_mount
from procedures.estimation.refined.model import CELL
from procedures.estimation.refined.noise import find_noise
from procedures.estimation.refined.outliers import distances
from procedures.estimation.refined.verification import LEAST_PROBABILITY, corner_squares, in_order

# Far more than any of them is off in a cell that somebody calibrated: what is found is what the captures say.
_MOUNT = (0.02, float(np.radians(5.0)))  # m, rad
_ZERO = float(np.radians(1.0))
_LINK = (0.002, float(np.radians(0.3)))  # m, rad

_MOST_OF_IT = 0.5  # of what is too much
_LOOSE = "looseness: backlash, sag, a camera or target that is not tight"
_FEWEST_ARRIVALS = 3


@dataclass(frozen=True)
class Suspect:
    """words: what to look at, and by how much it would have to be off; share: of the squares that are more than chance
    makes them, what it takes away; explains: whether what is left may be chance.
    """

    words: str
    share: float
    explains: bool


TOGETHER = Suspect("the estimate: all captures together fit one cell, so calibrate with more of them", 1.0, True)
"""Where nothing else is to be looked at."""


def next_suspects(result: Refined, captures: CaptureArrays, names: Sequence[str] | None = None) -> tuple[Suspect, ...]:
    """In the order in which to look at them: what explains the captures first, then what explains most of what is too
    much, then the rest; in each group what is most often wrong first in real cells: the target's mount, the zeros of
    the joints, the calibration of the arms, a capture or an arrival that alone is off, and what no calibration mends,
    which is all the same as joint sigmas that are stated too small. Before these corners that are off whatever board,
    with the pixel sigma that explains them if one does, and before them the capture that alone has them off; and none
    of these where one cell fits all captures.

    captures: all of them, in any order; names: of each, by default its index.
    """
    captures = in_order(result, captures)
    called = [str(k) for k in range(len(captures))] if names is None else list(names)
    try:
        as_given = _fitted(result, captures, result.inexact)
    except (Degenerate, np.linalg.LinAlgError):
        return (Suspect(_LOOSE, 0.0, False),)
    corners: tuple[Suspect, ...] = ()
    if as_given.corners_off():
        corners = (*_pixel_sigma(result, captures, as_given), _CORNERS)
        if not as_given.corners_alike():
            corners = (*_one_capture(result, captures, as_given, called), *corners)
    if as_given.explains():
        return corners or (TOGETHER,)
    if any(suspect.explains for suspect in corners):
        return corners
    found = [*_knowns(result, captures, as_given), *_left_out(result, captures, as_given, called)]
    explaining = [one for one in found if one.explains]
    mostly = [one for one in found if not one.explains and one.share >= _MOST_OF_IT]
    hardly = [one for one in found if not one.explains and one.share < _MOST_OF_IT]
    loose = Suspect(_LOOSE, 0.0, False) if explaining else _loose(result, captures, as_given)
    return (*corners, *explaining, *mostly, loose, *hardly)


_CORNERS = Suspect(
    "the corners, which are off any board by more than the stated pixel sigma: focus, light, intrinsics, a board that "
    "is not flat",
    0.0,
    False,
)


@dataclass(frozen=True)
class _Fitted:
    """Captures fitted with some knowns left to them: squares of boards that are elsewhere than the cell has them, and
    their degrees of freedom; corners and corner_freedoms (k,): those of corners that are elsewhere than their board has
    them.
    """

    again: Again
    squares: float
    freedom: float
    corners: Array
    corner_freedoms: Array

    def corners_off(self) -> bool:
        return bool(stats.chi2.sf(self.corners.sum(), max(self.corner_freedoms.sum(), 1)) < LEAST_PROBABILITY)

    def corners_alike(self) -> bool:
        """Whether no capture's corners are farther off than chance makes the worst of so many."""
        chances = stats.chi2.sf(self.corners, np.maximum(self.corner_freedoms, 1))
        return bool(len(chances) * chances.min() >= LEAST_PROBABILITY)

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


def _fitted(
    result: Refined, captures: CaptureArrays, inexact: Sequence[Inexact], noise: Noise | None = None
) -> _Fitted:
    again = fit_again(result, captures, inexact, noise)
    corners, ranks = corner_squares(again.model, again.fit.state)
    numbers = sum(1 - min(one.sigma / one.prior, 1.0) ** 2 for one in again.known)
    squares = max(again.fit.at.cost - float(corners.sum()), 0.0)
    return _Fitted(again, squares, float(ranks.sum()) - CELL - numbers, corners, again.model.freedom - ranks)


def _pixel_sigma(result: Refined, captures: CaptureArrays, as_given: _Fitted) -> Iterator[Suspect]:
    """The one that the corners themselves show, if that alone explains the captures."""
    ratio = float(np.sqrt(as_given.corners.sum() / as_given.corner_freedoms.sum()))
    noise = replace(result.noise, pixel=ratio * result.noise.pixel)
    try:
        fitted = _fitted(result, captures, result.inexact, noise)
    except (Degenerate, np.linalg.LinAlgError):
        return
    if fitted.explains() and fitted.corners_alike():
        words = f"{_stated(result)} pixel sigma: {noise.pixel:.2g} px would explain the captures"
        yield Suspect(words, 1.0, True)


def _loose(result: Refined, captures: CaptureArrays, as_given: _Fitted) -> Suspect:
    """Where no known alone explains the captures: with the joint sigmas that would, if they do for all boards alike."""
    stated, state = result.noise, as_given.again.fit.state
    nothing = Suspect(f"{_LOOSE}; nothing else alone explains the captures", 0.0, False)
    if stated.passive == 0 or as_given.corners_off():
        return nothing
    found = find_noise(captures, as_given.again.model.knowns, stated, state.T_P_A, state.T_H_E).noise
    try:
        fitted = _fitted(result, captures, result.inexact, replace(found, pixel=stated.pixel))
        off = distances(fitted.again.model, fitted.again.fit)
    except (Degenerate, np.linalg.LinAlgError):
        return nothing
    boards = off.captures - fitted.corners
    chances = stats.chi2.cdf(boards, np.maximum(off.freedom - fitted.corner_freedoms, 1))
    if not fitted.explains() or stats.kstest(chances, "uniform").pvalue < LEAST_PROBABILITY:
        return nothing
    times = f"{found.passive / stated.passive:.2g} times as much would explain the captures"
    return Suspect(f"{_LOOSE}; {_stated(result)} joint sigmas: {times}", 1.0, True)


def _stated(result: Refined) -> str:
    return "the stated" if result.found is None else "the found"


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
        known = [one for one in fitted.again.known if one.name in names]
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
    yield from _one_capture(result, captures, as_given, called)
    model = as_given.again.model
    arrival = model.arrival == int(np.argmax(distances(model, as_given.again.fit).arrivals))
    ids = ", ".join(called[int(k)] for k in np.flatnonzero(arrival))
    if _all_fit(result, captures, as_given, ~arrival):
        yield _alone_off(f"where the active arm stood at {ids}", "it alone being off")


def _one_capture(
    result: Refined, captures: CaptureArrays, as_given: _Fitted, called: Sequence[str]
) -> Iterator[Suspect]:
    """The one that fits worst, if that is all that is wrong; and whether its corners are but listed the other way."""
    off = distances(as_given.again.model, as_given.again.fit)
    worst = np.arange(len(captures)) == int(np.argmax(off.captures / np.maximum(off.freedom, 1)))
    what = f"capture {called[int(np.argmax(worst))]}"
    if not _all_fit(result, captures, as_given, ~worst):
        return
    if _all_fit(result, captures.turned(worst), as_given, np.ones(len(captures), dtype=bool)):
        yield _alone_off(what, "its corners alone being listed from the other end")
    else:
        yield _alone_off(what, "it alone being off")


def _alone_off(what: str, words: str) -> Suspect:
    return Suspect(f"{what}: {words} would explain the captures", 1.0, True)


def _all_fit(result: Refined, captures: CaptureArrays, as_given: _Fitted, kept: Mask) -> bool:
    """Whether the captures ``kept`` (k,) fit one cell, boards and corners."""
    if len(np.unique(as_given.again.model.arrival[kept])) < _FEWEST_ARRIVALS:
        return False
    try:
        fitted = _fitted(result, captures.only(kept), result.inexact)
    except (Degenerate, np.linalg.LinAlgError):
        return False
    return fitted.explains() and not fitted.corners_off()
