"""The camera's pose from points whose places are known: linear, for a first value."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from dualcal_hal.transforms import Array, Mask, inverse, rotation_from_vector, transform
from procedures.estimation.refined.closed_form import rotations
from procedures.estimation.refined.data import Indices

# Those of a cube: no rotation is farther than 63 deg from one of them.
_TURNS = np.array(
    [
        turn
        for order in permutations(np.eye(3))
        for signs in product((1.0, -1.0), repeat=3)
        if np.linalg.det(turn := np.array(signs)[:, None] * np.array(order)) > 0
    ]
)
_MOST_STEPS = 100
_STEADY = 1e-6


def resect(points: Array, rays: Array, weights: Array, groups: Indices, count: int) -> Array:
    """T_E_P (count, 4, 4) of groups of captures, each group's points being one target that is not plane.

    points (k, n, 3) in P; rays (k, n, 2): normalised undistorted coordinates; weights (k, n), 0 for a corner not
    seen; groups (k,): the group of each capture, below ``count``. The direct linear transform: a group of fewer than
    six points, or of points in one plane, comes to nonsense.
    """
    total = _summed(weights.sum(axis=1), groups, count)
    centre = _summed(np.einsum("kn,kni->ki", weights, points), groups, count) / np.maximum(total, 1e-12)[:, None]
    apart = points - centre[groups][:, None]
    square = _summed(np.einsum("kn,kni->k", weights, apart**2), groups, count) / np.maximum(total, 1e-12)
    scale = np.sqrt(3 / np.maximum(square, 1e-12))
    places = np.concatenate([apart * scale[groups][:, None, None], np.ones((*points.shape[:2], 1))], axis=-1)
    equations = np.zeros((*points.shape[:2], 2, 12))
    equations[:, :, 0, :4] = equations[:, :, 1, 4:8] = places
    equations[:, :, :, 8:] = -rays[..., None] * places[:, :, None, :]
    rows = (equations * np.sqrt(weights)[..., None, None]).reshape(len(points), 2 * points.shape[1], 12)
    camera = np.linalg.eigh(_summed(np.swapaxes(rows, 1, 2) @ rows, groups, count))[1][..., 0].reshape(-1, 3, 4)
    # Points are in front of a camera that is no mirror.
    camera = camera * np.where(np.linalg.det(camera[:, :, :3]) < 0, -1.0, 1.0)[:, None, None]
    size = np.linalg.norm(camera[:, :, :3], axis=(1, 2)) / np.sqrt(3)
    R = rotations(camera[:, :, :3])
    p = camera[:, :, 3] / (size * scale)[:, None] - (R @ centre[..., None])[..., 0]
    return transform(R, p)


def few_point_poses(points: Array, rays: Array) -> Array:
    """T_E_P candidates (24, 4, 4) from at least three points (n, 3) in P that are not on one line, and their rays
    (n, 2): the orthogonal iteration of Lu, Hager and Mjolsness (IEEE Trans. PAMI 22, 2000) from rotations all round.
    """
    sight = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    along = sight[:, :, None] * sight[:, None, :] / np.sum(sight**2, axis=1)[:, None, None]
    across = np.eye(3) - along
    inner = np.linalg.pinv(across.sum(axis=0))
    middle = points - points.mean(axis=0)
    R = _TURNS
    for _ in range(_MOST_STEPS):
        turned = points @ np.swapaxes(R, 1, 2)
        p = -np.einsum("nij,snj->si", across, turned) @ inner
        on_rays = np.einsum("nij,snj->sni", along, turned + p[:, None])
        before, R = R, rotations(np.swapaxes(on_rays, 1, 2) @ middle)
        if np.abs(R - before).max() < _STEADY:
            break
    return transform(R, -np.einsum("nij,snj->si", across, points @ np.swapaxes(R, 1, 2)) @ inner)


def plane_poses(corners: Array, rays: Array, seen: Mask) -> Array:
    """T_E_T candidates (k, 2, 4, 4) of a plane board from its corners (n, 3) in T and rays (k, n, 2): a homography, and
    its twin with the tilt reversed, which looks alike from afar.

    Captures with fewer than four corners give nonsense.
    """
    scale = np.sqrt(np.mean(corners**2)) + 1e-12
    plane = np.concatenate([corners[:, :2] / scale, np.ones((len(corners), 1))], axis=1)
    equations = np.zeros((len(rays), len(corners), 2, 9))
    equations[:, :, 0, :3] = equations[:, :, 1, 3:6] = plane
    equations[:, :, :, 6:] = -rays[..., None] * plane[:, None, :]
    rows = (equations * seen[..., None, None]).reshape(len(rays), -1, 9)
    H = np.linalg.eigh(np.swapaxes(rows, 1, 2) @ rows)[1][..., 0].reshape(-1, 3, 3)
    H = H * np.where(H[:, 2, 2] < 0, -1.0, 1.0)[:, None, None]
    size = np.linalg.norm(H[:, :, :2], axis=(1, 2)) / np.sqrt(2)
    sides = H[:, :, :2] / size[:, None, None]
    R = rotations(np.concatenate([sides, np.cross(sides[:, :, 0], sides[:, :, 1])[..., None]], axis=2))
    p = H[:, :, 2] / size[:, None] * scale
    sight = p / np.linalg.norm(p, axis=1, keepdims=True)
    twin = rotation_from_vector(np.pi * sight) @ R @ np.diag([-1.0, -1.0, 1.0])
    return transform(np.stack([R, twin], axis=1), p[:, None])


def camera_poses(T_P_T: Array, T_E_T: Array) -> Array:
    """T_P_E of boards (..., 4, 4) seen at T_E_T."""
    return np.asarray(T_P_T @ inverse(T_E_T))


def _summed(values: Array, groups: Indices, count: int) -> Array:
    total = np.zeros((count, *values.shape[1:]))
    np.add.at(total, groups, values)
    return total
