"""Levenberg-Marquardt on both transforms, the arms' errors following."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dualcal_hal.transforms import Array
from procedures.estimation.refined.data import Indices
from procedures.estimation.refined.model import Linearised, Model, State

MOST_STEPS = 60
_MOST_DAMPING = 1e10
_LEAST_DAMPING = 1e-9

# In units of sigma squared: the estimate is then within a hundredth of a sigma of the optimum, and the next step, which
# converges quadratically, far nearer.
_SMALLEST_GAIN = 1e-4


@dataclass(frozen=True)
class Fit:
    """Where it ended, and the model linearised there; converged: False if the steps ran out first."""

    state: State
    at: Linearised
    converged: bool
    steps: int


def minimise(model: Model, state: State, damping: float = 1e-4, most_steps: int = MOST_STEPS) -> Fit:
    """From a state in which all seen corners are in front of the camera, else the cost stays infinite."""
    at = model.linearised(state)
    if not np.isfinite(at.cost):
        return Fit(state, replace(at, cost=np.inf), False, 0)
    for step in range(1, most_steps + 1):
        scale = np.diag(at.normal) + 1e-12 * np.trace(at.normal)
        try:
            change = _solved(at.normal + damping * np.diag(scale), -at.gradient)
        except np.linalg.LinAlgError:
            return Fit(state, at, False, step)
        tried = model.stepped(state, at, change)
        gain = at.cost - model.cost(tried)
        if gain >= -1e-9 * (1 + at.cost):
            state, damping = tried, max(damping / 10, _LEAST_DAMPING)
            at = model.linearised(state)
            if gain < _SMALLEST_GAIN and damping < 1e-2:
                return Fit(state, at, True, step)
        else:
            damping *= 10
            if not damping < _MOST_DAMPING:
                return Fit(state, at, False, step)
    return Fit(state, at, False, most_steps)


def noise_contributions(fit: Fit, arrival: Indices) -> dict[str, Array]:
    """What pixels and the joints of each arm contribute to the covariance (12, 12) of the cell; they add up to it.

    arrival (k,): of each capture.
    """
    at = fit.at
    spread = np.linalg.inv(at.normal)
    follow_active = np.eye(6) - np.swapaxes(at.towards_active @ at.active_gain, 1, 2)
    of_arrival = spread @ np.swapaxes(at.towards_cell, 1, 2) @ follow_active
    follow_passive = np.eye(6) - np.swapaxes(at.towards_passive @ at.passive_gain, 1, 2)
    of_capture = of_arrival[arrival] @ follow_passive
    roots = {
        "active joints": of_arrival @ at.arrival_normal @ at.towards_active,
        "passive joints": of_capture @ at.pixel_normal @ at.towards_passive,
    }
    parts = {what: np.einsum("bin,bjn->ij", root, root) for what, root in roots.items()}
    pixels = np.einsum("kia,kab,kjb->ij", of_capture, at.pixel_normal, of_capture)
    return {"pixels": np.asarray(pixels), **parts}


def _solved(normal: Array, right: Array) -> Array:
    return np.asarray(np.linalg.solve(normal, right), dtype=float)
