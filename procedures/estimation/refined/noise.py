"""Sigmas from the captures themselves, by restricted maximum likelihood.

The likelihood of what is left of the measurements once the cell is fitted (Patterson and Thompson, "Recovery of
inter-block information when block sizes are unequal", 1971), so that the fit's own unknowns do not make the noise look
smaller. The model is linearised once; after that a pair of sigmas costs only six by six matrices.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import optimize, stats

from dualcal_hal.transforms import Array
from procedures.estimation.refined.data import CaptureArrays, Indices, Knowns, Noise
from procedures.estimation.refined.model import Model, marginalised

_UNIT_JOINT = 1e-4  # rad
_LOWEST, _HIGHEST = -7.0, 7.0  # of the logarithm of a sigma over its unit; beyond, it counts as none, or as anything
_IDENTIFIED = float(stats.chi2.ppf(0.95, 1))
_ONE_SIDED = float(stats.chi2.ppf(0.90, 1))


@dataclass(frozen=True)
class Sigma:
    """value: the most likely one, in the unit of what it is of; lower, upper: 95 % interval of the profile likelihood
    where it is identified; where it is not, since the data are as likely without any, 0 and the 95 % upper bound.
    """

    value: float
    lower: float
    upper: float
    identified: bool


@dataclass(frozen=True)
class FoundNoise:
    """pixel: px per axis; joint: of the passive arm, rad; active_over_passive: as was stated, 1 where neither was."""

    pixel: Sigma
    joint: Sigma
    active_over_passive: float

    @property
    def noise(self) -> Noise:
        """To estimate with: what is not identified is taken at its upper bound."""
        joint = self.joint.value if self.joint.identified else self.joint.upper
        pixel = self.pixel.value if self.pixel.identified else self.pixel.upper
        return Noise(pixel, joint * self.active_over_passive, joint)


def find_noise(data: CaptureArrays, knowns: Knowns, stated: Noise, T_P_A: Array, T_H_E: Array) -> FoundNoise:
    """From captures that belong, with their corners in order, around an estimate of the cell. Only the ratio of the
    joints' sigmas is taken from ``stated``.
    """
    ratio = stated.active / stated.passive if stated.passive > 0 else 1.0
    likelihood = _Likelihood.at(data, knowns, Noise(stated.pixel, ratio * _UNIT_JOINT, _UNIT_JOINT), T_P_A, T_H_E)
    # The likelihood may have a ridge towards small joint sigmas: the search starts on both sides of it.
    begun = [
        optimize.minimize(likelihood, [0.0, joint], method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-3})
        for joint in (0.0, -3.0)
    ]
    best = min(begun, key=lambda found: found.fun)
    logarithms = np.clip(best.x, _LOWEST, _HIGHEST)
    sigmas = [_sigma(likelihood, logarithms, axis, unit) for axis, unit in enumerate((stated.pixel, _UNIT_JOINT))]
    return FoundNoise(sigmas[0], sigmas[1], ratio)


@dataclass(frozen=True)
class _Likelihood:
    """Minus twice the restricted log-likelihood, of the logarithms of pixel and joint sigma over their units."""

    squares: Array
    normal: Array
    gradient: Array
    towards_passive: Array
    towards_active: Array
    towards_cell: Array
    arrival: Indices
    measurements: int

    @classmethod
    def at(cls, data: CaptureArrays, knowns: Knowns, unit: Noise, T_P_A: Array, T_H_E: Array) -> _Likelihood:
        model = Model(data, knowns, unit)
        at = model.linearised(model.state(T_P_A, T_H_E))
        return cls(
            squares=at.squares,
            normal=at.pixel_normal,
            gradient=at.pixel_gradient,
            towards_passive=at.towards_passive,
            towards_active=at.towards_active,
            towards_cell=at.towards_cell,
            arrival=model.arrival,
            measurements=model.measurements,
        )

    def __call__(self, logarithms: Array) -> float:
        pixel, joint = np.exp(np.clip(logarithms, _LOWEST, _HIGHEST))
        squares, normal, gradient = (part / pixel**2 for part in (self.squares, self.normal, self.gradient))
        own, volume, W, gw = _folded(normal, gradient, joint * self.towards_passive)
        arrivals = len(self.towards_active)
        summed, towards = np.zeros((arrivals, 6, 6)), np.zeros((arrivals, 6))
        np.add.at(summed, self.arrival, W)
        np.add.at(towards, self.arrival, gw)
        own_active, volume_active, pose_normal, pose_gradient = _folded(summed, towards, joint * self.towards_active)
        G_T = np.swapaxes(self.towards_cell, 1, 2)
        cell = np.sum(G_T @ pose_normal @ self.towards_cell, axis=0)
        cell_gradient = np.sum((G_T @ pose_gradient[..., None])[..., 0], axis=0)
        quadratic = squares.sum() - own - own_active - cell_gradient @ np.linalg.solve(cell, cell_gradient)
        volumes = 2 * self.measurements * np.log(pixel) + volume + volume_active + np.linalg.slogdet(cell)[1]
        return float(volumes + quadratic)


def _folded(normal: Array, gradient: Array, towards: Array) -> tuple[float, float, Array, Array]:
    """Errors of unit sigma marginalised: what they explain, the logarithm of their volume, and what is left."""
    towards_T = np.swapaxes(towards, 1, 2)
    none = np.zeros((len(towards), towards.shape[-1]))
    W, gw, _, step = marginalised(normal, gradient, towards, none)
    explained = -np.sum((towards_T @ gradient[..., None])[..., 0] * step)
    inner = np.eye(towards.shape[-1]) + towards_T @ normal @ towards
    return float(explained), float(np.linalg.slogdet(inner)[1].sum()), W, gw


def _sigma(likelihood: _Likelihood, best: Array, axis: int, unit: float) -> Sigma:
    least = likelihood(best)
    other = float(best[1 - axis])

    def rise(logarithm: float) -> float:
        """Over the best, with the other sigma as it then fits best."""

        def with_other(x: float) -> float:
            return likelihood(np.array([logarithm, x] if axis == 0 else [x, logarithm]))

        found = optimize.minimize_scalar(
            with_other,
            bounds=(max(other - 1, _LOWEST), min(other + 1, _HIGHEST)),
            method="bounded",
            options={"xatol": 1e-2},
        )
        # The search may end in another valley than that of the best.
        return min(float(found.fun), with_other(other)) - least

    value = float(best[axis])
    identified = rise(_LOWEST) > _IDENTIFIED
    upper = _crossing(rise, value, _HIGHEST, _IDENTIFIED if identified else _ONE_SIDED)
    lower = _crossing(rise, value, _LOWEST, _IDENTIFIED) if identified else -np.inf
    return Sigma(unit * float(np.exp(value)), unit * float(np.exp(lower)), unit * float(np.exp(upper)), identified)


def _crossing(rise: Callable[[float], float], start: float, end: float, level: float) -> float:
    """Where the rise reaches the level on the way to the end; the end if it does not."""
    near = start
    for step in (0.1, 0.3, 1.0, 3.0, 20.0):
        far = start + np.sign(end - start) * min(step, abs(end - start))
        if rise(far) > level:
            return float(optimize.brentq(lambda x: rise(x) - level, near, far, xtol=1e-2))
        near = far
    return end
