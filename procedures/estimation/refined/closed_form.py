"""``A_k X M_k = Y`` in closed form: two fixed transforms from pairs of known ones."""

from __future__ import annotations

import numpy as np

from dualcal_hal.transforms import Array, transform


def solve(A: Array, M: Array) -> tuple[Array, Array]:
    """X and Y (..., 4, 4) from A, M (..., n, 4, 4), n >= 3, turned about two axes at least.

    Rotations first: vec(R_Y) = K_k vec(R_X) with orthogonal K_k, so that the first pair of singular vectors of their
    mean is what all agree on best (Shah, "Solving the robot-world/hand-eye calibration problem using the Kronecker
    product", 2013). Then both translations by linear least squares.
    """
    R_A, R_M = A[..., :3, :3], M[..., :3, :3]
    K = np.einsum("...kia,...kbj->...ijab", R_A, R_M) / A.shape[-3]
    K = K.reshape(*K.shape[:-4], 9, 9)
    _, _, V_T = np.linalg.svd(K)
    R_X = V_T[..., 0, :].reshape(*K.shape[:-2], 3, 3)
    R_X = rotations(R_X * np.sign(np.linalg.det(R_X))[..., None, None])
    R_Y = rotations(np.mean(R_A @ R_X[..., None, :, :] @ R_M, axis=-3))

    # R_A p_X - p_Y = -known; p_Y goes with the means.
    known = A[..., :3, 3] + (R_A @ R_X[..., None, :, :] @ M[..., :3, 3:])[..., 0]
    mean_R, mean_known = R_A.mean(axis=-3), known.mean(axis=-2)
    off_R, off_known = R_A - mean_R[..., None, :, :], known - mean_known[..., None, :]
    normal = np.einsum("...kia,...kib->...ab", off_R, off_R)
    normal = normal + 1e-12 * np.eye(3)  # degenerate sets are told by the fit, not here
    p_X = np.linalg.solve(normal, -np.einsum("...kia,...ki->...a", off_R, off_known)[..., None])
    p_Y = (mean_R @ p_X)[..., 0] + mean_known
    return transform(R_X, p_X[..., 0]), transform(R_Y, p_Y)


def rotations(M: Array) -> Array:
    """The rotations closest to M (..., 3, 3)."""
    U, _, V_T = np.linalg.svd(M)
    U[..., 2] *= np.sign(np.linalg.det(U @ V_T))[..., None]
    return np.asarray(U @ V_T)
