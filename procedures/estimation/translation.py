"""Second step of the paper: the two translations, once the rotations are known (section 5.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualcal_hal.transforms import Array, skew

RANK = 5


@dataclass(frozen=True)
class TranslationStep:
    """p_P_A (3,) and p_H_E (3,) in m; singular_values (6,) of J_T, of which the first five were used."""

    p_P_A: Array
    p_H_E: Array
    singular_values: Array


def estimate_translation(
    directions: Array,
    T_A_H: Array,
    p_P_T: Array,
    R_P_A: Array,
    z_H_E: Array,
    nominal_p_P_A: Array,
    nominal_p_H_E: Array,
) -> TranslationStep:
    """Least squares with exactly five singular values (eqs. 9 to 12, 34 to 36).

    directions: optical axis in P of each capture (k, 3); T_A_H (k, 4, 4); p_P_T: feature point in P (k, 3), m;
    R_P_A (3, 3), z_H_E (3,) from the first step; nominal positions (3,), m.
    The sixth direction is the camera's shift along its axis. With noise its singular value is not zero but
    some 1e-4 of the first, which no relative threshold tells safely from a weak direction: it is dropped
    by count, and this component of p_H_E keeps its nominal value.
    """
    R_P_H = R_P_A @ T_A_H[:, :3, :3]
    across = skew(directions)
    J = np.concatenate([across, across @ R_P_H], axis=2).reshape(-1, 6)
    camera = R_P_H @ nominal_p_H_E + T_A_H[:, :3, 3] @ R_P_A.T + nominal_p_P_A
    rho = np.cross(directions, p_P_T - camera).ravel()
    U, s, Vt = np.linalg.svd(J, full_matrices=False)
    dp = Vt[:RANK].T @ ((U.T @ rho)[:RANK] / s[:RANK])
    # With noise the five others lean a little towards the axis too; a shift along it moves no line.
    across_axis = dp[3:] - (dp[3:] @ z_H_E) * z_H_E
    return TranslationStep(nominal_p_P_A + dp[:3], nominal_p_H_E + across_axis, s)
