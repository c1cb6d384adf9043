"""AXB = YCZ in closed form, without a start: rotations by a Kronecker product, then translations by least squares.

With the rows of a matrix one after the other, vec(P M Q) = (P kron Q^T) vec(M). So R_A R_X R_B = R_Y R_C R_Z is
linear in vec(R_X) and in the 81 entries of R_Y kron R_Z^T, as Wu, Wang, Qi, Wang and Ren note for quaternions
("Simultaneous Hand-Eye, Tool-Flange, and Robot-Robot Calibration for Comanipulation by Solving the AXB = YCZ
Problem", IEEE Transactions on Robotics 32(2), 2016). The 81 are eliminated here: R_X is the eigenvector of a
9 x 9 matrix. Once R_X is known, R_Y and R_Z are those of Shah's AX = YB ("Solving the Robot-World/Hand-Eye
Calibration Problem Using the Kronecker Product", Journal of Mechanisms and Robotics 5(3), 2013).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from dualcal_hal.transforms import Array, rotation_from_vector, transform, vector_from_rotation

FEWEST_FOR_KRONECKER = 10
"""Nine equations each, of which 90 unknowns up to their scale need 89."""

# Triples that the rotations are sought with where nothing is known of them; more add nothing to a start.
_MOST_TO_SEARCH = 40
_COARSE_STEPS = 4
_FINE_STEPS = 20
_PROMISING = 12
_LARGEST_TURN = 0.5  # rad a step, so that far starts do not jump about


@dataclass(frozen=True)
class Solution:
    """X, Y, Z (4, 4), m."""

    X: Array
    Y: Array
    Z: Array


def solve_in_closed_form(A: Array, B: Array, C: Array) -> Solution:
    """From at least :data:`FEWEST_FOR_KRONECKER` triples (n, 4, 4); ValueError for fewer.

    Rotations and then translations; all triples weigh the same. Degenerate triples are not noticed here.
    """
    if len(A) < FEWEST_FOR_KRONECKER:
        raise ValueError(f"{len(A)} triples, the closed form needs {FEWEST_FOR_KRONECKER}")
    R_X = _first_rotation(A[:, :3, :3], B[:, :3, :3], C[:, :3, :3])
    return _with_translations(A, B, C, np.concatenate([R_X[None], _other_rotations(A, B, C, R_X[None])[:, 0]]))


def find_start(A: Array, B: Array, C: Array) -> Solution:
    """From triples (n, 4, 4): what a search over all rotations finds, the closed form among its starts where there are
    enough triples.

    Measured: the refinement ended where it ends from the truth in all of 1,400 sets of 4 to 270 triples, with joints
    anywhere or within 0.5 rad of each other.
    """
    chosen = np.unique(np.linspace(0, len(A) - 1, _MOST_TO_SEARCH).round().astype(int))
    some = A[chosen], B[chosen], C[chosen]
    R_X = _all_over()
    if len(A) >= FEWEST_FOR_KRONECKER:
        R_X = np.concatenate([_first_rotation(A[:, :3, :3], B[:, :3, :3], C[:, :3, :3])[None], R_X])
    rotations, misfits = _search(*some, np.stack([R_X, *_other_rotations(*some, R_X)], axis=1), _COARSE_STEPS)
    rotations, misfits = _search(*some, rotations[np.argsort(misfits, kind="stable")[:_PROMISING]], _FINE_STEPS)
    return _with_translations(A, B, C, rotations[np.argmin(misfits)])


def _first_rotation(R_A: Array, R_B: Array, R_C: Array) -> Array:
    """R_X (3, 3): least squares over vec(R_X) and the 81 others, these eliminated.

    |M x - K c|^2 summed over the triples, with M = R_A kron R_B^T orthogonal and c = vec(R_C), is least over K for
    K = (sum M x c^T) G^-1 with G = sum c c^T, and then x^T (n I - sum M_i^T M_j (c_i^T G^-1 c_j)) x.
    """
    n = len(R_A)
    c = R_C.reshape(n, 9)
    M = np.einsum("nak,nlb->nabkl", R_A, R_B).reshape(n, 81)
    values, vectors = np.linalg.eigh(c.T @ c)
    # C that are turned little leave G nearly singular, and some of the 81 undetermined: these are then set to zero.
    kept = values > 1e-9 * values[-1]
    white = (c @ (vectors[:, kept] / np.sqrt(values[kept]))).T @ M
    white = white.reshape(-1, 9)
    x = np.linalg.eigh(n * np.eye(9) - white.T @ white)[1][:, 0].reshape(3, 3)
    return np.asarray(_nearest_rotations(x if np.linalg.det(x) > 0 else -x))


def _other_rotations(A: Array, B: Array, C: Array, R_X: Array) -> Array:
    """R_Y and R_Z (2, s, 3, 3) to R_X (s, 3, 3), by Shah's singular vectors: vec(R_Y) = (D kron R_C) vec(R_Z^T) with
    D = R_A R_X R_B.
    """
    D = _chained(A[:, :3, :3], R_X[:, None], B[:, :3, :3])
    c = C[:, :3, :3].reshape(-1, 9)
    products = np.swapaxes(D.reshape(len(R_X), -1, 9), 1, 2) @ c
    kron = np.swapaxes(products.reshape(-1, 3, 3, 3, 3), 2, 3).reshape(-1, 9, 9)
    U, _, Vt = np.linalg.svd(kron)
    R_Y, R_Z_transposed = U[:, :, 0].reshape(-1, 3, 3), Vt[:, 0].reshape(-1, 3, 3)
    sign = np.where(np.linalg.det(R_Y) < 0, -1.0, 1.0)[:, None, None]
    return _nearest_rotations(np.stack([sign * R_Y, np.swapaxes(sign * R_Z_transposed, 1, 2)]))


def _search(A: Array, B: Array, C: Array, rotations: Array, steps: int) -> tuple[Array, Array]:
    """Gauss-Newton on the rotations (s, 3, 3, 3) of X, Y, Z from s starts at once; misfits (s,): rms angle, rad."""
    R_A, R_B, R_C = (each[:, :3, :3] for each in (A, B, C))
    R_B_inverse = np.swapaxes(R_B, 1, 2)
    for _ in range(steps):
        R_Z = rotations[:, 2, None]
        angles = _misfit(R_A, R_B, R_C, rotations)
        # A small turn (x, y, z) from the right of each changes the angle by z + (R_C R_Z)^T y - R_B^T x.
        shape = (*angles.shape[:2], 3, 3)
        J = np.concatenate(
            [np.broadcast_to(-R_B_inverse, shape), np.swapaxes(R_C @ R_Z, -1, -2), np.broadcast_to(np.eye(3), shape)],
            axis=-1,
        ).reshape(len(rotations), -1, 9)
        normal = np.swapaxes(J, 1, 2) @ J + 1e-9 * len(A) * np.eye(9)
        step = -np.linalg.solve(normal, np.swapaxes(J, 1, 2) @ angles.reshape(len(rotations), -1, 1)).reshape(-1, 3, 3)
        largest = np.linalg.norm(step, axis=-1).max(axis=-1)
        step *= np.minimum(1.0, _LARGEST_TURN / np.maximum(largest, 1e-300))[:, None, None]
        rotations = rotations @ rotation_from_vector(step)
        if largest.max() < 1e-6:
            break
    angles = _misfit(R_A, R_B, R_C, rotations)
    return rotations, np.asarray(np.sqrt(np.mean(np.sum(angles**2, axis=-1), axis=-1)))


def _misfit(R_A: Array, R_B: Array, R_C: Array, rotations: Array) -> Array:
    """(s, n, 3): rotation vectors from R_A R_X R_B to R_Y R_C R_Z, rad."""
    R_X, R_Y, R_Z = (rotations[:, i, None] for i in range(3))
    left, right = _chained(R_A, R_X, R_B), _chained(R_Y, R_C, R_Z)
    return vector_from_rotation(np.swapaxes(left, -1, -2) @ right)


def _chained(first: Array, second: Array, third: Array) -> Array:
    return np.asarray(first @ second @ third)


def _with_translations(A: Array, B: Array, C: Array, rotations: Array) -> Solution:
    """R_A p_X - p_Y - R_Y R_C p_Z = R_Y p_C - p_A - R_A R_X p_B by least squares."""
    R_X, R_Y, R_Z = rotations
    R_A = A[:, :3, :3]
    left = np.concatenate([R_A, np.broadcast_to(-np.eye(3), R_A.shape), -R_Y @ C[:, :3, :3]], axis=2)
    right = C[:, :3, 3] @ R_Y.T - A[:, :3, 3] - (R_A @ (B[:, :3, 3] @ R_X.T)[:, :, None])[:, :, 0]
    flat = left.reshape(-1, 9)
    values, vectors = np.linalg.eigh(flat.T @ flat)
    kept = values > 1e-12 * values[-1]
    p = vectors[:, kept] @ ((vectors[:, kept].T @ (flat.T @ right.ravel())) / values[kept])
    return Solution(transform(R_X, p[:3]), transform(R_Y, p[3:6]), transform(R_Z, p[6:]))


def _nearest_rotations(M: Array) -> Array:
    """(..., 3, 3), as :func:`dualcal_hal.transforms.nearest_rotation` of each."""
    U, _, Vt = np.linalg.svd(M)
    U[..., :, 2] *= np.linalg.det(U @ Vt)[..., None]
    return np.asarray(U @ Vt)


@cache
def _all_over() -> Array:
    """(60, 3, 3): the rotations of an icosahedron; every rotation is within 45 deg of one of them."""
    return np.asarray(Rotation.create_group("I").as_matrix())
