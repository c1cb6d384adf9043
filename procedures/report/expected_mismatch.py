"""How large a mismatch a refined result predicts on captures: of its own covariance and the noise of both arms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dualcal_hal.config import CellConfig
from dualcal_hal.session.accuracy import Accuracy
from dualcal_hal.session.captures import CaptureRecord
from dualcal_hal.session.result import Result
from dualcal_hal.transforms import Array, apply, inverse, skew


def expected_mismatch(cell: CellConfig, captures: Sequence[CaptureRecord], result: Result, accuracy: Accuracy) -> Array:
    """Root mean square (k,) of the distance between feature point and optical axis, m.

    To first order; what the alignment left is in it as it was measured.
    """
    q_a = np.array([capture.active_joints for capture in captures])
    q_p = np.array([capture.passive_joints for capture in captures])
    T_A_H, T_P_F = cell.active.chain.forward(q_a), cell.passive.chain.forward(q_p)
    p_P = (T_P_F @ cell.passive.target_mount_transform)[:, :3, 3]
    T_E_A = inverse(T_A_H @ result.T_H_E)
    T_E_P = T_E_A @ inverse(result.T_P_A)
    p_A = apply(inverse(result.T_P_A), p_P)
    p_E = np.einsum("kij,kj->ki", T_E_P[:, :3, :3], p_P) + T_E_P[:, :3, 3]

    minus = np.broadcast_to(-np.eye(3), (len(captures), 3, 3))
    of_base = T_E_A[:, :3, :3] @ np.concatenate([minus, skew(p_A)], axis=-1)
    of_camera = np.concatenate([minus, skew(p_E)], axis=-1)
    J = np.concatenate([of_base, of_camera], axis=-1)
    spread = J @ np.array(accuracy.covariance) @ np.swapaxes(J, 1, 2)
    for jacobian, lever, R, milliradians in (
        (cell.active.chain.jacobian(q_a), p_A - T_A_H[:, :3, 3], T_E_A, accuracy.noise.active_joint_mrad),
        (cell.passive.chain.jacobian(q_p), p_P - T_P_F[:, :3, 3], T_E_P, accuracy.noise.passive_joint_mrad),
    ):
        moved = R[:, :3, :3] @ (jacobian[:, :3] - skew(lever) @ jacobian[:, 3:])
        spread = spread + (1e-3 * milliradians) ** 2 * moved @ np.swapaxes(moved, 1, 2)
    left = _offsets(cell, captures) * p_E[:, 2:]
    return np.asarray(np.sqrt(np.sum(left**2, axis=1) + spread[:, 0, 0] + spread[:, 1, 1]))


def _offsets(cell: CellConfig, captures: Sequence[CaptureRecord]) -> Array:
    """Of the feature points from the optical axis, (k, 2) at a distance of 1; too small for distortion to matter."""
    intrinsics = cell.camera.intrinsics
    pixels = np.array([capture.feature for capture in captures]) - intrinsics.principal_point
    return np.asarray(pixels / np.diag(intrinsics.matrix)[:2])
