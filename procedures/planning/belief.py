"""What planning and the servo's start believe of the two sought transforms; never data for the estimate."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dualcal_hal.config import NominalConfig
from dualcal_hal.geometry import Placement
from dualcal_hal.transforms import Array

NOMINAL_SIGMA_CAMERA = (0.01, 0.1)
"""The error a nominal ``T_H_E`` may have, 1 sigma per axis: translation in m, rotation in rad."""

LEAST_ERROR = (0.015, float(np.deg2rad(0.6)))
"""The error of a fitted ``T_P_A`` that is always allowed for, m and rad: its covariance knows of pixels alone."""


@dataclass(frozen=True, eq=False)
class Belief:
    """Both transforms (4, 4), with the covariance (12, 12) of their errors.

    Errors are right perturbations, T_true = T exp(xi): of ``T_P_A`` translation (m), rotation (rad), then of
    ``T_H_E`` the same. ``source`` says in words where it comes from; ``placement`` how the bases stand, with the
    error to keep clear of.
    """

    T_P_A: Array
    T_H_E: Array
    covariance: Array
    source: str
    placement: Placement

    @staticmethod
    def nominal(nominal: NominalConfig) -> Belief:
        """What the cell file says: its largest error is taken for one sigma, which holds nothing back."""
        placement = nominal.placement
        bases = np.maximum([placement.translation, placement.rotation], LEAST_ERROR)
        sigma = np.repeat([*bases, *NOMINAL_SIGMA_CAMERA], 3)
        return Belief(nominal.T_P_A, nominal.T_H_E, np.diag(sigma**2), "the nominal transforms", placement)

    def taken_as_exact(self) -> Belief:
        """The same without an error to keep clear of."""
        return replace(self, placement=Placement(self.T_P_A))

    def as_if_looked(self) -> Belief:
        """The same with only the error to keep clear of that is always left after the first looks."""
        return replace(self, placement=Placement(self.T_P_A, *LEAST_ERROR))

    @staticmethod
    def fitted(T_P_A: Array, T_H_E: Array, covariance: Array, source: str) -> Belief:
        """From a fit: three sigma of its covariance (12, 12), at least the error that is always allowed for."""
        sigma = [float(np.sqrt(np.linalg.eigvalsh(covariance[i : i + 3, i : i + 3])[-1])) for i in (0, 3)]
        translation, rotation = (max(3 * s, least) for s, least in zip(sigma, LEAST_ERROR, strict=True))
        return Belief(T_P_A, T_H_E, covariance, source, Placement(T_P_A, translation, rotation))

    def rotation_sigma(self, T_A_H: Array) -> float:
        """How well the camera's orientation in P is known with the active flange at ``T_A_H``: rad, rms per axis."""
        R_A_E = T_A_H[:3, :3] @ self.T_H_E[:3, :3]
        turn = np.zeros((3, 12))
        turn[:, 3:6], turn[:, 9:12] = R_A_E.T, np.eye(3)
        return float(np.sqrt(np.trace(turn @ self.covariance @ turn.T) / 3))
