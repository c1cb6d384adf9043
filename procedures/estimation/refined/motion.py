"""Small motions: (..., 6) [translation in m; rotation vector in rad] in the child frame of the transform they move."""

from __future__ import annotations

import numpy as np

from dualcal_hal.transforms import Array, inverse, rotation_from_vector, skew, transform, vector_from_rotation


def moved(T: Array, motion: Array) -> Array:
    """T (..., 4, 4) after motions (..., 6)."""
    return np.asarray(T @ transform(rotation_from_vector(motion[..., 3:]), motion[..., :3]))


def motion_between(T: Array, goal: Array) -> Array:
    """(..., 6): what :func:`moved` takes to get from T to the goal."""
    between = inverse(T) @ goal
    return np.concatenate([between[..., :3, 3], vector_from_rotation(between[..., :3, :3])], axis=-1)


def logarithm(T: Array, goal: Array) -> Array:
    """(..., 6): log(T^-1 goal) on SE(3), translation then rotation; what covariances are of."""
    motion = motion_between(T, goal)
    w = motion[..., 3:]
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    S = skew(w)
    with np.errstate(divide="ignore", invalid="ignore"):
        half = angle / 2
        factor = np.where(angle > 1e-4, (1 - half / np.tan(half)) / angle**2, 1 / 12)
    along = (np.eye(3) - S / 2 + factor * (S @ S)) @ motion[..., :3, None]
    return np.concatenate([along[..., 0], w], axis=-1)


def adjoint(T: Array) -> Array:
    """(..., 6, 6): takes a motion in frame Y to the same motion in frame X, for T_X_Y (..., 4, 4)."""
    R = T[..., :3, :3]
    Ad = np.zeros((*T.shape[:-2], 6, 6))
    Ad[..., :3, :3] = Ad[..., 3:, 3:] = R
    Ad[..., :3, 3:] = skew(T[..., :3, 3]) @ R
    return Ad


def in_flange(jacobian: Array, flange: Array) -> Array:
    """A geometric Jacobian (..., 6, n) in the base to motions of the flange (..., 4, 4) in its own frame."""
    R = np.swapaxes(flange[..., :3, :3], -1, -2)
    return np.concatenate([R @ jacobian[..., :3, :], R @ jacobian[..., 3:, :]], axis=-2)
