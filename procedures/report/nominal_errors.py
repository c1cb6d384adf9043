"""How far the nominal transforms were off, in the terms of the paper's Tables 3 and 4, and the paper's own figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualcal_hal.config import CellConfig, NominalConfig
from dualcal_hal.transforms import Array, smallest_rotation


@dataclass(frozen=True, eq=False)
class NominalErrors:
    """Found minus nominal.

    w: the rotation error of ``R_A_P = R_A_P_nominal dR(w)``, its axis times the sine of its angle (3,);
    dz: optical axis in the active flange, a difference of unit vectors (3,); dp_P_A, dp_H_E: m (3,);
    roll: of the camera about its optical axis, rad, beyond the smallest rotation that takes the nominal axis to it.
    NaN where nothing is said of it.
    """

    w: Array
    dz: Array
    dp_P_A: Array
    dp_H_E: Array
    roll: float

    def __sub__(self, other: NominalErrors) -> NominalErrors:
        return NominalErrors(
            w=self.w - other.w,
            dz=self.dz - other.dz,
            dp_P_A=self.dp_P_A - other.dp_P_A,
            dp_H_E=self.dp_H_E - other.dp_H_E,
            roll=self.roll - other.roll,
        )


def nominal_errors(T_P_A: Array, T_H_E: Array, nominal: NominalConfig) -> NominalErrors:
    """The errors that transforms (4, 4) show the nominal ones to have (paper, eqs. 19 and 21 to 23)."""
    turn = nominal.T_P_A[:3, :3] @ T_P_A[:3, :3].T
    skew = (turn - turn.T) / 2
    return NominalErrors(
        w=np.array([skew[2, 1], skew[0, 2], skew[1, 0]]),
        dz=T_H_E[:3, 2] - nominal.T_H_E[:3, 2],
        dp_P_A=T_P_A[:3, 3] - nominal.T_P_A[:3, 3],
        dp_H_E=T_H_E[:3, 3] - nominal.T_H_E[:3, 3],
        roll=_roll(T_H_E[:3, :3], nominal.T_H_E[:3, :3]),
    )


def _roll(R: Array, nominal: Array) -> float:
    tilted = smallest_rotation(nominal[:, 2], R[:, 2]) @ nominal
    x, y = tilted[:, :2].T @ R[:, 0]
    return float(np.arctan2(y, x))


PAPER_ERRORS = NominalErrors(
    w=np.array([-0.0122, 0.0805, -0.1579]),
    dz=np.array([-0.0978, -0.0076, -0.0001]),
    dp_P_A=np.array([18.2, 113.0, 11.5]) / 1000,
    dp_H_E=np.array([7.3, -6.8, -0.57]) / 1000,
    roll=np.nan,
)
"""Tables 3 and 4; dz as printed, which the paper adds to the nominal axis before it normalises the sum."""

PAPER_MISMATCH_MM = {"mean": (60.8, 6.2), "max": (106.1, 11.3)}
"""Fig. 8: before and after."""

PAPER_UPDATE = 0.01
"""Fig. 7: what the updates have fallen below when the paper stops."""


def is_papers_cell(cell: CellConfig) -> bool:
    """Whether the paper's figures belong beside this cell's: one that is named after it."""
    return cell.name.startswith("paper")
