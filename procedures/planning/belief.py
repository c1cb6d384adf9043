"""What planning and the servo's start believe of the two sought transforms; never data for the estimate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualcal_hal.config import NominalConfig
from dualcal_hal.transforms import Array

NOMINAL_SIGMA_BASE = (0.12, 0.2)
"""The error a nominal ``T_P_A`` may have, 1 sigma per axis: translation in m, rotation in rad."""

NOMINAL_SIGMA_CAMERA = (0.01, 0.1)
"""The same of a nominal ``T_H_E``."""


@dataclass(frozen=True, eq=False)
class Belief:
    """Both transforms (4, 4), with the covariance (12, 12) of their errors.

    Errors are right perturbations, T_true = T exp(xi): of ``T_P_A`` translation (m), rotation (rad), then of
    ``T_H_E`` the same. ``source`` says in words where it comes from.
    """

    T_P_A: Array
    T_H_E: Array
    covariance: Array
    source: str

    @staticmethod
    def nominal(nominal: NominalConfig) -> Belief:
        """What the cell file says."""
        sigma = np.repeat([*NOMINAL_SIGMA_BASE, *NOMINAL_SIGMA_CAMERA], 3)
        return Belief(nominal.T_P_A, nominal.T_H_E, np.diag(sigma**2), "the nominal transforms")

    def rotation_sigma(self, T_A_H: Array) -> float:
        """How well the camera's orientation in P is known with the active flange at ``T_A_H``: rad, rms per axis."""
        R_A_E = T_A_H[:3, :3] @ self.T_H_E[:3, :3]
        turn = np.zeros((3, 12))
        turn[:, 3:6], turn[:, 9:12] = R_A_E.T, np.eye(3)
        return float(np.sqrt(np.trace(turn @ self.covariance @ turn.T) / 3))
