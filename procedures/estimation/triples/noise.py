"""How exact the poses of triples are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.transforms import Array

Sigmas = tuple[float, float]
"""Of a pose, per axis: translation in m, rotation in rad."""


@dataclass(frozen=True, eq=False)
class TripleNoise:
    """Covariances of the errors of A, B and C: (6, 6), the same for all triples, or (n, 6, 6), [translation; rotation]
    in the child frame, m and rad. A and C may be exact, all zero; B must not be. Errors of different triples are taken
    as independent. ValueError for what is no covariance.
    """

    A: Array
    B: Array
    C: Array

    def __post_init__(self) -> None:
        for name in ("A", "B", "C"):
            values = np.asarray(getattr(self, name), dtype=float)
            _require_covariance(values, name)
            object.__setattr__(self, name, values.reshape(-1, 6, 6))
        if np.any(np.linalg.eigvalsh(_unitless(self.B))[:, 0] <= 1e-12) or np.any(_diagonals(self.B) == 0):
            raise ValueError("the covariance of B is singular: B must not be exact in any direction")

    @classmethod
    def of_sigmas(cls, A: Sigmas, B: Sigmas, C: Sigmas) -> TripleNoise:
        """The same for all triples and all axes."""
        return cls(*(np.diag(np.repeat(np.square(np.asarray(each, dtype=float)), 3)) for each in (A, B, C)))

    def require_count(self, n: int) -> None:
        """ValueError unless there is one covariance for all, or one for each of n triples."""
        for name in ("A", "B", "C"):
            count = len(getattr(self, name))
            if count not in (1, n):
                raise ValueError(f"{count} covariances of {name} for {n} triples")

    def rotation_sigma(self, name: str) -> float:
        """Of A, B or C: rms over the triples and axes, rad."""
        return float(np.sqrt(np.mean(_diagonals(getattr(self, name))[:, 3:])))

    def translation_sigma(self, name: str) -> float:
        """Of A, B or C: rms over the triples and axes, m."""
        return float(np.sqrt(np.mean(_diagonals(getattr(self, name))[:, :3])))


def root(covariance: ArrayLike) -> Array:
    """(n, 6, 6) with root root^T = covariance (n, 6, 6), which may be singular."""
    C = np.asarray(covariance, dtype=float)
    scale = np.sqrt(_diagonals(C))
    values, vectors = np.linalg.eigh(_unitless(C))
    return np.asarray(scale[:, :, None] * vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :])


def _require_covariance(values: Array, name: str) -> None:
    if values.shape[-2:] != (6, 6) or values.ndim not in (2, 3):
        raise ValueError(f"the covariance of {name} has shape {values.shape}, not (6, 6) or (n, 6, 6)")
    if not np.all(np.isfinite(values)):
        raise ValueError(f"the covariance of {name} is not finite")
    values = values.reshape(-1, 6, 6)
    if np.any(_diagonals(values) < 0):
        raise ValueError(f"the covariance of {name} has a negative variance")
    unitless = _unitless(values)
    if not np.allclose(unitless, np.swapaxes(unitless, 1, 2), rtol=0.0, atol=1e-9):
        raise ValueError(f"the covariance of {name} is not symmetric")
    if np.linalg.eigvalsh(unitless).min() < -1e-9:
        raise ValueError(f"the covariance of {name} has a direction with a negative variance")


def _unitless(covariance: Array) -> Array:
    """Correlations (n, 6, 6); zero where the variance is."""
    scale = np.sqrt(_diagonals(covariance))
    inverse_scale = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0)
    return np.asarray(covariance * inverse_scale[:, :, None] * inverse_scale[:, None, :])


def _diagonals(covariance: Array) -> Array:
    return np.asarray(np.diagonal(covariance, axis1=1, axis2=2))
