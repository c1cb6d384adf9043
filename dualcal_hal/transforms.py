"""Rigid transforms as plain arrays.

``T_X_Y`` is a (4, 4) array that takes coordinates in frame Y to coordinates in frame X, so
``T_X_Z = T_X_Y @ T_Y_Z``. Lengths in metres, angles in radians, quaternions (x, y, z, w).
Functions accept any leading batch dimensions where the docstring writes ``...``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def transform(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """(..., 3, 3) rotation and (..., 3) translation in m to (..., 4, 4)."""
    R = np.asarray(rotation, dtype=float)
    p = np.asarray(translation, dtype=float)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], p.shape[:-1]), 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = p
    T[..., 3, 3] = 1.0
    return T


def inverse(T: ArrayLike) -> Array:
    """Inverse of (..., 4, 4) rigid transforms."""
    T = np.asarray(T, dtype=float)
    R_inverse = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform(R_inverse, -(R_inverse @ T[..., :3, 3:])[..., 0])


def apply(T: ArrayLike, points: ArrayLike) -> Array:
    """Coordinates (..., n, 3) in frame Y to frame X by ``T_X_Y`` (..., 4, 4)."""
    T = np.asarray(T, dtype=float)
    turned = np.asarray(points, dtype=float) @ np.swapaxes(T[..., :3, :3], -1, -2)
    return np.asarray(turned + T[..., None, :3, 3])


def skew(v: ArrayLike) -> Array:
    """(..., 3) to (..., 3, 3) with ``skew(v) @ u == cross(v, u)`` (paper, eq. 20)."""
    v = np.asarray(v, dtype=float)
    S = np.zeros((*v.shape[:-1], 3, 3))
    S[..., 0, 1], S[..., 0, 2] = -v[..., 2], v[..., 1]
    S[..., 1, 0], S[..., 1, 2] = v[..., 2], -v[..., 0]
    S[..., 2, 0], S[..., 2, 1] = -v[..., 1], v[..., 0]
    return S


def rotation_from_vector(vector: ArrayLike) -> Array:
    """Rotation vector(s) (..., 3) in rad to rotation matrices (..., 3, 3)."""
    v = np.asarray(vector, dtype=float)
    return np.asarray(Rotation.from_rotvec(v.reshape(-1, 3)).as_matrix()).reshape(*v.shape[:-1], 3, 3)


def vector_from_rotation(rotation: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) to rotation vectors (..., 3) in rad, of length at most pi."""
    R = np.asarray(rotation, dtype=float)
    flat = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec()
    return np.asarray(flat).reshape(*R.shape[:-2], 3)


def quaternion_from_rotation(rotation: ArrayLike) -> Array:
    """Rotation matrix (3, 3) to the unit quaternion (x, y, z, w) with w >= 0."""
    return np.asarray(Rotation.from_matrix(np.asarray(rotation)).as_quat(canonical=True))


def rotation_from_quaternion(xyzw: ArrayLike) -> Array:
    """Quaternion (x, y, z, w), normalised here, to a rotation matrix (3, 3)."""
    return np.asarray(Rotation.from_quat(np.asarray(xyzw)).as_matrix())


def rotation_angle(R_1: ArrayLike, R_2: ArrayLike) -> Array:
    """Angle in rad of the rotation that takes R_2 (..., 3, 3) to R_1."""
    relative = np.asarray(R_1, dtype=float) @ np.swapaxes(np.asarray(R_2, dtype=float), -1, -2)
    return np.asarray(np.linalg.norm(vector_from_rotation(relative), axis=-1))


def smallest_rotation(start: ArrayLike, end: ArrayLike) -> Array:
    """The (3, 3) rotation by the smallest angle that turns direction ``start`` into ``end``.

    For opposite directions the axis is not determined; one perpendicular to ``start`` is taken.
    """
    a = np.asarray(start, dtype=float) / np.linalg.norm(start)
    b = np.asarray(end, dtype=float) / np.linalg.norm(end)
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-15:
        if cosine > 0:
            return np.eye(3)
        axis = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
        return rotation_from_vector(np.pi * axis / np.linalg.norm(axis))
    return rotation_from_vector(np.arctan2(sine, cosine) * axis / sine)


def is_rotation(R: ArrayLike, tolerance: float = 1e-6) -> bool:
    """Whether a (3, 3) array is orthonormal and right-handed within ``tolerance`` per entry."""
    R = np.asarray(R, dtype=float)
    return bool(
        R.shape == (3, 3)
        and np.all(np.isfinite(R))
        and np.allclose(R @ R.T, np.eye(3), rtol=0.0, atol=tolerance)
        and np.linalg.det(R) > 0
    )


def nearest_rotation(M: ArrayLike) -> Array:
    """The rotation (3, 3) closest to M in the Frobenius norm (orthogonal Procrustes)."""
    U, _, Vt = np.linalg.svd(np.asarray(M, dtype=float))
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
