"""What would show what the captures that were taken do not determine: other captures, or a known measured better."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from dualcal_hal.kinematics import Chain
from dualcal_hal.transforms import Array, apply, inverse, rotation_from_vector, transform
from procedures.estimation.projection import project
from procedures.estimation.refined.arms import Arm
from procedures.estimation.refined.data import CaptureArrays, Indices
from procedures.estimation.refined.estimate import Refined
from procedures.estimation.refined.fit import Fit
from procedures.estimation.refined.inexact import information
from procedures.estimation.refined.model import CELL, Model

_TURN = float(np.radians(40.0))
_SHIFT = 0.15  # m
_DEPTH = 0.1  # m
_SAME = "as many captures again, of the same kinds"
_AS_GOOD = 0.7  # of a sigma: what twice as many captures once more would make of it
_HELPS = 0.9  # of the sigma now; what leaves more does not help
_BETTER = 2.0  # times as exact is a known that is measured better


def would_help(result: Refined, captures: CaptureArrays) -> tuple[str, ...]:
    """A line for each thing that helps with a direction that is not observable, few of them; empty where all are.

    Kinds of captures are reckoned with as if as many as there are were taken again in that way, each inexact known as
    if it were measured twice as exactly. Named is what leaves about the smallest sigma. captures: those of the
    estimate, all of them, in its order.
    """
    hidden = [index for index, direction in enumerate(result.directions) if not direction.observable]
    if not hidden:
        return ()
    known = _Known.of(result)
    left = {words: known.with_captures(gain).sigmas() for words, gain in _gains(result, captures)}
    left |= {f"measure the {what} better": known.measured(numbers).sigmas() for what, numbers in _measurable(result)}
    now = known.sigmas()
    good = {i: _good({words: float(sigmas[i] / now[i]) for words, sigmas in left.items()}) for i in hidden}
    said: dict[str, list[str]] = {}
    while good:
        best = max(left, key=lambda words: _helped(words, good.values()))
        said[best] = [result.directions[i].name for i in good if best in good[i]]
        good = {i: each for i, each in good.items() if best not in each}
    return tuple(f"{words}, for {', '.join(names)}" for words, names in said.items())


def _good(left: Mapping[str, float]) -> Mapping[str, float]:
    """Of what leaves these parts of a sigma, what is about as good as the best; more of the same where that will do."""
    least = min(left, key=lambda words: left[words])
    good = {words: part for words, part in left.items() if _AS_GOOD * part <= left[least] and part < _HELPS}
    if _SAME in good:
        return {_SAME: good[_SAME]}
    return good or {least: left[least]}


def _helped(words: str, good: Iterable[Mapping[str, float]]) -> tuple[int, float]:
    """With how many directions it helps, and by how much with all of them."""
    parts = [each[words] for each in good if words in each]
    return len(parts), -sum(parts)


def _measurable(result: Refined) -> Iterator[tuple[str, Array]]:
    """Each inexact known, and how much more would be known of its numbers, after the cell's 12: 1 / sigma^2."""
    begin = CELL
    for one in result.inexact:
        precision = np.zeros(CELL + len(result.known))
        precision[begin : begin + len(one.sigmas)] = (_BETTER**2 - 1) / one.sigmas**2
        begin += len(one.sigmas)
        yield one.what, precision


@dataclass(frozen=True)
class _Known:
    """sought, reckoned: which of the cell's 12 and the m numbers by which knowns are off are found, and which are only
    reckoned with, indices. found (s, s): information on the former, what was known of them before included; both
    (s, r): on them together with the latter; spread (r, r): the covariance of these, whatever captures say of them.
    """

    sought: Indices
    reckoned: Indices
    found: Array
    both: Array
    spread: Array

    @classmethod
    def of(cls, result: Refined) -> _Known:
        joint = result.joint_covariance
        # What is only reckoned with is as uncertain after the estimate as before.
        as_before = np.array([False] * CELL + [known.sigma == known.prior for known in result.known])
        sought, reckoned = np.flatnonzero(~as_before), np.flatnonzero(as_before)
        spread = joint[np.ix_(reckoned, reckoned)]
        follow = np.linalg.solve(spread, joint[np.ix_(reckoned, sought)]).T
        alone = joint[np.ix_(sought, sought)] - follow @ spread @ follow.T
        found = np.asarray(np.linalg.inv(alone), dtype=float)
        return cls(sought, reckoned, found, -found @ follow, spread)

    def sigmas(self) -> Array:
        """(12,) of the cell, m and rad."""
        follow = np.linalg.solve(self.found, self.both)
        covariance = np.linalg.inv(self.found) + follow @ self.spread @ follow.T
        return np.asarray(np.sqrt(np.diag(covariance)[:CELL]))

    def with_captures(self, gain: Array) -> _Known:
        """With information (12 + m, 12 + m) of captures on cell and knowns added."""
        found = self.found + gain[np.ix_(self.sought, self.sought)]
        return replace(self, found=found, both=self.both + gain[np.ix_(self.sought, self.reckoned)])

    def measured(self, precision: Array) -> _Known:
        """With 1 / sigma^2 (12 + m,) more known, by other means than captures."""
        spread = np.linalg.inv(np.linalg.inv(self.spread) + np.diag(precision[self.reckoned]))
        return replace(self, found=self.found + np.diag(precision[self.sought]), spread=spread)


@dataclass(frozen=True)
class _Kind:
    """turn, rad, and shift, m, in the camera's frame, one this way and the next one that: of the camera at arrivals of
    their own, the boards before it where they are, or of the boards, more of them at the same arrivals.
    """

    words: str
    arrivals: bool
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def again(self, result: Refined, captures: CaptureArrays) -> CaptureArrays:
        """As many captures of this kind; one that an arm does not reach is taken where it was."""
        model = Model(captures, result.knowns, result.noise)
        knowns, arrival = result.knowns, model.arrival
        T_E_T = inverse(result.T_P_A @ model.T_A_H @ result.T_H_E)[arrival] @ model.T_P_F @ knowns.T_F_T
        active = model.active
        if self.arrivals:
            moved = model.T_A_H @ result.T_H_E @ self._moves(model.arrivals) @ inverse(result.T_H_E)
            active, arrival = _reaching(knowns.active, active, moved), arrival + model.arrivals
        else:
            moves = self._moves(model.captures)
            T_E_T = transform(moves[:, :3, :3] @ T_E_T[:, :3, :3], T_E_T[:, :3, 3] + moves[:, :3, 3])
        T_P_E = (result.T_P_A @ knowns.active.forward(active) @ result.T_H_E)[model.arrival]
        passive = _reaching(knowns.passive, captures.passive, T_P_E @ T_E_T @ inverse(knowns.T_F_T))
        there = inverse(T_P_E) @ knowns.passive.forward(passive) @ knowns.T_F_T
        pixels = project(apply(there, knowns.corners), knowns.matrix, knowns.distortion)
        return CaptureArrays(
            active=active[model.arrival],
            passive=passive,
            arrivals=arrival,
            pixels=np.where(np.isfinite(captures.pixels), pixels, np.nan),
            weights=captures.weights,
        )

    def _moves(self, count: int) -> Array:
        """(count, 4, 4)."""
        way = np.where(np.arange(count) % 2 == 0, 1.0, -1.0)[:, None]
        return transform(rotation_from_vector(way * self.turn), way * self.shift)


_KINDS = (
    _Kind(_SAME, True),
    _Kind("constraints with the camera rolled about its optical axis", True, turn=(0, 0, _TURN)),
    _Kind("constraints with the camera turned about its x-axis", True, turn=(_TURN, 0, 0)),
    _Kind("constraints with the camera turned about its y-axis", True, turn=(0, _TURN, 0)),
    _Kind("constraints with the camera farther to the sides", True, shift=(_SHIFT, _SHIFT, 0)),
    _Kind("more positions on the same constraints", False),
    _Kind("positions at more distances from the camera", False, shift=(0, 0, _DEPTH)),
    _Kind("positions with the board tilted more about the camera's x-axis", False, turn=(_TURN, 0, 0)),
    _Kind("positions with the board tilted more about the camera's y-axis", False, turn=(0, _TURN, 0)),
)


def _reaching(arm: Arm, q: Array, flange: Array) -> Array:
    """(k, n): joint angles near q that bring the flange there, or q itself; what is no chain of joints stands."""
    if not isinstance(arm, Chain):
        return q
    limits = np.full(arm.joints, np.inf)
    found, reached = arm.inverse(flange, q, -limits, limits)
    return np.where(reached[:, None], found, q)


def _gains(result: Refined, captures: CaptureArrays) -> Iterator[tuple[str, Array]]:
    """Information (12 + m, 12 + m) that each kind adds; less where captures scatter more than stated."""
    taken = captures.turned(result.flipped).only(result.used)
    taken = replace(taken, arrivals=Model(taken, result.knowns, result.noise).arrival)
    before = _information(result, taken)
    for kind in _KINDS:
        after = _information(result, _together(taken, kind.again(result, taken)))
        yield kind.words, (after - before) / result.scale


def _information(result: Refined, captures: CaptureArrays) -> Array:
    """(12 + m, 12 + m): of captures on the cell and on the numbers by which knowns are off."""
    model = Model(captures, result.knowns, result.noise)
    state = model.state(result.T_P_A, result.T_H_E)
    fit = Fit(state, model.linearised(state), True, 0)
    at_zero = np.zeros(len(result.known))
    both, numbers, _ = information(captures, result.knowns, result.noise, result.inexact, at_zero, model, fit)
    return np.block([[fit.at.normal, both], [both.T, numbers]])


def _together(first: CaptureArrays, second: CaptureArrays) -> CaptureArrays:
    weights = None
    if first.weights is not None and second.weights is not None:
        weights = np.concatenate([first.weights, second.weights])
    return CaptureArrays(
        active=np.concatenate([first.active, second.active]),
        passive=np.concatenate([first.passive, second.passive]),
        arrivals=np.concatenate([first.arrivals, second.arrivals]),
        pixels=np.concatenate([first.pixels, second.pixels]),
        weights=weights,
    )
