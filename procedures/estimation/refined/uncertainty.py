"""What a covariance of the cell means: for each direction, and in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from dualcal_hal.transforms import Array, apply, inverse, skew

FRAMES = ("active_base", "camera")
"""Children of the two transforms, in whose axes the twelve directions are."""


@dataclass(frozen=True)
class Limits:
    """Posterior sigmas above which a direction counts as not observable: m, rad."""

    translation: float = 0.005
    rotation: float = float(np.radians(1.0))

    @property
    def sigmas(self) -> Array:
        """(12,) of the twelve directions."""
        return np.tile(np.repeat([self.translation, self.rotation], 3), 2)


@dataclass(frozen=True)
class Direction:
    """One of the twelve: its posterior sigma (m or rad), and whether that is below the limit."""

    name: str
    sigma: float
    observable: bool


def directions(covariance: Array, limits: Limits, frames: tuple[str, str] = FRAMES) -> tuple[Direction, ...]:
    """Of the covariance (12, 12) of two transforms, by default T_P_A, then T_H_E; frames: their children."""
    names = (
        f"{what} {axis} of {f}" for f in frames for what in ("translation along", "rotation about") for axis in "xyz"
    )
    sigmas = np.sqrt(np.diag(covariance))
    return tuple(
        Direction(name, float(sigma), bool(sigma < limit))
        for name, sigma, limit in zip(names, sigmas, limits.sigmas, strict=True)
    )


def condition(normal: Array) -> float:
    """Largest over smallest singular value of the whitened problem (12, 12) with its columns scaled to one, so that
    metres and radians do not count; infinite where a direction is not seen at all.
    """
    scale = np.sqrt(np.diag(normal))
    if not np.all(scale > 0):
        return np.inf
    values = np.linalg.eigvalsh(normal / np.outer(scale, scale))
    return float(np.sqrt(values[-1] / values[0])) if values[0] > 0 else np.inf


def point_covariance(T_P_A: Array, covariance: Array, points: ArrayLike) -> Array:
    """Of where the estimate puts points (..., 3) of P in the active base, (..., 3, 3) m^2.

    covariance (12, 12): error = log(T_est^-1 T_true), translation then rotation, T_P_A first.
    """
    in_active = apply(inverse(T_P_A), np.asarray(points, dtype=float).reshape(-1, 3))
    J = np.concatenate([np.broadcast_to(-np.eye(3), (len(in_active), 3, 3)), skew(in_active)], axis=-1)
    spread = J @ covariance[:6, :6] @ np.swapaxes(J, 1, 2)
    return np.asarray(spread.reshape(*np.shape(points)[:-1], 3, 3))


@dataclass(frozen=True)
class SpatialError:
    """Of the distance between where a point is and where the estimate puts it: root mean square and 95 %, m."""

    rms: Array
    p95: Array


def spatial_error(T_P_A: Array, covariance: Array, points: ArrayLike) -> SpatialError:
    """At points (..., 3) of P, m; both fields (...)."""
    spread = point_covariance(T_P_A, covariance, points)
    variances: Array = np.asarray(np.linalg.eigvalsh(spread), dtype=float)
    return SpatialError(rms=np.sqrt(variances.sum(axis=-1)), p95=distance_quantile(variances, 0.95))


def distance_quantile(variances: Array, probability: float) -> Array:
    """Quantile of the length of a normal vector with variances (..., n) along its axes.

    By a chi-square of the same first three cumulants (Imhof, "Computing the distribution of quadratic forms in normal
    variables", 1961), which is exact for equal variances and for a single one, and within 1 % between.
    """
    variances = np.maximum(variances, 0.0)
    c1, c2, c3 = (np.sum(variances**n, axis=-1) for n in (1, 2, 3))
    freedom = c2**3 / np.maximum(c3**2, 1e-300)
    quantile = stats.chi2.ppf(probability, np.maximum(freedom, 1e-12))
    squared = c1 + (quantile - freedom) * np.sqrt(c2 / np.maximum(freedom, 1e-12))
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))
