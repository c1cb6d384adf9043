"""Captures and arrivals that do not fit the others, by how far they are from where the others put them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from dualcal_hal.transforms import Array, Mask, inverse
from procedures.estimation.refined.fit import Fit
from procedures.estimation.refined.model import Model, State, marginalised

IMPROBABLE = 1e-6
"""A capture or an arrival less probable than this does not belong. In 28 good ones it strikes one set in 30,000, and
what does not belong is off by tens of sigma."""

_NO_LEVERAGE = 1e-6


@dataclass(frozen=True)
class Distances:
    """Squared Mahalanobis distances from where the other captures, or arrivals, put it: captures (k,) with freedom
    (k,) degrees of freedom, their numbers measured; arrivals (a,) with 6 each. within (a,): how far an arrival's
    captures are from one pose of the camera, whichever that be, with within_freedom (a,).
    """

    captures: Array
    freedom: Array
    arrivals: Array
    within: Array
    within_freedom: Array

    def scale(self) -> tuple[float, float]:
        """How many times larger the squares are than the noise says, of captures and arrivals, by the median: at least
        1, and hardly moved by a minority of others.
        """
        seen = self.freedom > 0
        of_captures = np.median(self.captures[seen] / stats.chi2.median(self.freedom[seen])) if seen.any() else 1.0
        of_arrivals = np.median(self.arrivals) / stats.chi2.median(6) if len(self.arrivals) > 3 else 1.0
        return max(1.0, float(of_captures)), max(1.0, float(of_arrivals))


def distances(model: Model, fit: Fit) -> Distances:
    """Of captures that were used in the fit, each left out in turn."""
    at, state = fit.at, fit.state
    cell = _pose_covariance_of_cell(fit)
    own = at.squares + np.sum(state.passive**2, axis=1)
    posterior = _pose_covariance(fit, cell)
    of_captures = own + _without(posterior[model.arrival], at.capture_normal, at.capture_gradient)
    freely = _solved(at.arrival_normal, at.arrival_gradient)
    of_arrivals = np.sum(state.active**2, axis=1) + freely + _without(cell, at.pose_normal, at.pose_gradient)
    freedom = model.freedom
    within = np.bincount(model.arrival, own, model.arrivals) - freely
    within_freedom = np.maximum(np.bincount(model.arrival, freedom, model.arrivals) - 6, 0.0)
    return Distances(of_captures, freedom, of_arrivals, within, within_freedom)


def between_arrivals(fit: Fit) -> tuple[float, int]:
    """How far the arrivals' poses are from one cell, in squared sigmas, and the degrees of freedom of that."""
    freely = _solved(fit.at.arrival_normal, fit.at.arrival_gradient)
    return float(np.sum(fit.state.active**2) + freely.sum()), 6 * len(freely) - len(fit.at.gradient)


def predicted_distances(model: Model, every: Model, fit: Fit, flipped: Mask) -> Array:
    """Squared Mahalanobis distances (k,) of all captures from where a fit to some of them, ``model``, puts them.

    every: the model of all captures; flipped (k,): whose corners are listed from the other end.
    """
    known = {label: a for a, label in enumerate(model.labels)}
    where = np.array([known.get(label, -1) for label in every.labels], dtype=np.intp)
    active = np.where((where >= 0)[:, None], fit.state.active[where], 0.0)
    state = State(fit.state.T_P_A, fit.state.T_H_E, active, np.zeros((every.captures, every.J_passive.shape[-1])))
    T_P_E, cell_moves, active_moves = every.arrival_poses(state)
    covariance = cell_moves @ np.linalg.inv(fit.at.normal) @ np.swapaxes(cell_moves, 1, 2)
    covariance += active_moves @ np.swapaxes(active_moves, 1, 2)
    seen = where >= 0
    if seen.any():
        covariance[seen] = _pose_covariance(fit, _pose_covariance_of_cell(fit))[where[seen]]
    spread = _root(covariance)[every.arrival]
    T_E_T = inverse(T_P_E)[every.arrival] @ every.T_P_F @ every.knowns.T_F_T
    sight = every.sight(T_E_T, np.arange(every.captures), flipped)
    behind = ~np.isfinite(sight.squares)
    normal = np.where(behind[:, None, None], 0.0, sight.normal)
    gradient = np.where(behind[:, None], 0.0, sight.gradient)
    towards = np.concatenate([sight.towards_passive, spread], axis=2)
    step = marginalised(normal, gradient, towards, np.zeros((every.captures, towards.shape[-1])))[3]
    own = np.einsum("bij,bi->bj", towards, gradient)
    return np.where(behind, np.inf, sight.squares + np.einsum("bj,bj->b", own, step))


def limits(freedom: Array, scale: float) -> Array:
    """(k,) of squared distances."""
    return np.asarray(scale * stats.chi2.isf(IMPROBABLE, np.maximum(freedom, 1)))


def _pose_covariance_of_cell(fit: Fit) -> Array:
    """(a, 6, 6): of T_P_E at each arrival as far as the cell goes."""
    G = fit.at.towards_cell
    return np.asarray(G @ np.linalg.inv(fit.at.normal) @ np.swapaxes(G, 1, 2))


def _pose_covariance(fit: Fit, of_cell: Array) -> Array:
    """(a, 6, 6): of T_P_E with the active arm's error, given all captures."""
    at = fit.at
    A, gain = at.towards_active, at.active_gain
    A_T = np.swapaxes(A, 1, 2)
    inner = np.eye(A.shape[-1]) + A_T @ at.arrival_normal @ A
    follow = np.eye(6) - A @ gain
    return np.asarray(follow @ of_cell @ np.swapaxes(follow, 1, 2) + A @ np.linalg.solve(inner, A_T))


def _without(covariance: Array, normal: Array, gradient: Array) -> Array:
    """(b,): gradient^T (covariance^-1 - normal)^-1 gradient: how far what is left out drew the pose to itself."""
    S = _root(covariance)
    S_T = np.swapaxes(S, 1, 2)
    leverage, axes = np.linalg.eigh(S_T @ normal @ S)
    along = (np.swapaxes(axes, 1, 2) @ S_T @ gradient[..., None])[..., 0]
    left = 1 - leverage
    return np.asarray(np.sum(np.where(left > _NO_LEVERAGE, along**2 / np.maximum(left, _NO_LEVERAGE), 0.0), axis=1))


def _solved(normal: Array, gradient: Array) -> Array:
    """(b,): gradient^T normal^+ gradient."""
    values, axes = np.linalg.eigh(normal)
    along = (np.swapaxes(axes, 1, 2) @ gradient[..., None])[..., 0]
    known = values > 1e-9 * values[:, -1:]
    return np.asarray(np.sum(np.where(known, along**2 / np.where(known, values, 1.0), 0.0), axis=1))


def _root(covariance: Array) -> Array:
    values, axes = np.linalg.eigh(covariance)
    return np.asarray(axes * np.sqrt(np.maximum(values, 0.0))[:, None, :])
