"""Least squares over the parameters of a camera and the poses of all views together (bundle adjustment).

Levenberg's and Marquardt's method; each view's pose is eliminated before the step of the parameters is sought (Schur's
complement), so that the work grows with the number of views alone. It is our own, because OpenCV's adds up in several
threads: the same corners would not give the same camera to the last bit, and a replay not the same run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

from dualcal_hal.errors import DegenerateCaptures
from dualcal_hal.transforms import Array

PARAMETERS = 9
"""fx, fy, cx, cy, k1, k2, p1, p2, k3."""

_POSE = 6
_MOST_STEPS = 200
_SMALLEST_GAIN = 1e-13  # of the sum of squares, in parts of it
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-12, 1e10


@dataclass(frozen=True, eq=False)
class SeenCorners:
    """points: (n, 3) m in T; pixels: (n, 2)."""

    points: Array
    pixels: Array


@dataclass(frozen=True, eq=False)
class Adjusted:
    """parameters: (9,) in the order above; poses: (k, 6) rotation vector (rad) and translation (m) of each view."""

    parameters: Array
    poses: Array


def adjust(views: Sequence[SeenCorners], start: Adjusted, free: NDArray[np.bool_]) -> Adjusted:
    """The solution next to ``start``; of the parameters those that are ``free`` (9,) are sought.

    Raises DegenerateCaptures where none is found.
    """
    here, cost = start, _cost(views, start)
    damping = _FIRST_DAMPING
    if not np.isfinite(cost):
        raise DegenerateCaptures("intrinsics: the views determine no camera")
    for _ in range(_MOST_STEPS):
        equations = [_equations(view, here.parameters, pose) for view, pose in zip(views, here.poses, strict=True)]
        while damping < _MOST_DAMPING:
            there = _step(equations, here, free, damping)
            then = np.inf if there is None else _cost(views, there)
            if there is not None and then < cost:
                break
            damping *= 10
        else:
            return here  # nothing near is better
        gain = (cost - then) / max(cost, 1e-300)
        here, cost, damping = there, then, max(damping / 10, _LEAST_DAMPING)
        if gain < _SMALLEST_GAIN:
            return here
    return here


def project_with_jacobian(points: Array, pose: Array, parameters: Array) -> tuple[Array, Array]:
    """Pixels (n, 2) of the points (n, 3), and d pixels / d (pose, parameters), (2n, 15)."""
    rotation, translation, matrix, distortion = _for_opencv(pose, parameters)
    pixels, J = cv2.projectPoints(points, rotation, translation, matrix, distortion)
    return np.asarray(pixels, dtype=float).reshape(-1, 2), np.asarray(J, dtype=float)[:, : _POSE + PARAMETERS]


def information(J: Array) -> Array:
    """(9, 9): what a view's Jacobian (2n, 15) says of the parameters, its pose being found from the same corners."""
    of_pose, of_camera = J[:, :_POSE], J[:, _POSE:]
    across = of_pose.T @ of_camera
    return np.asarray(of_camera.T @ of_camera - across.T @ np.linalg.pinv(of_pose.T @ of_pose) @ across)


@dataclass(frozen=True, eq=False)
class _Equations:
    """One view's part of the normal equations: J^T J and J^T r in blocks of its pose (p) and of the camera (c)."""

    pp: Array
    pc: Array
    cc: Array
    p: Array
    c: Array


def _equations(view: SeenCorners, parameters: Array, pose: Array) -> _Equations:
    pixels, J = project_with_jacobian(view.points, pose, parameters)
    r = (view.pixels - pixels).ravel()
    P, C = J[:, :_POSE], J[:, _POSE:]
    return _Equations(P.T @ P, P.T @ C, C.T @ C, P.T @ r, C.T @ r)


def _step(equations: Sequence[_Equations], here: Adjusted, free: NDArray[np.bool_], damping: float) -> Adjusted | None:
    """Where a step leads with so much damping, in parts of the diagonal; None where there is none."""
    cc = np.sum([one.cc for one in equations], axis=0)
    reduced, right = cc + damping * np.diag(np.diag(cc)), np.sum([one.c for one in equations], axis=0)
    try:
        inverses = [np.linalg.inv(one.pp + damping * np.diag(np.diag(one.pp))) for one in equations]
        for one, inverse in zip(equations, inverses, strict=True):
            reduced = reduced - one.pc.T @ inverse @ one.pc
            right = right - one.pc.T @ inverse @ one.p
        d_camera = np.zeros(PARAMETERS)
        d_camera[free] = np.linalg.solve(reduced[np.ix_(free, free)], right[free])
    except np.linalg.LinAlgError:
        return None
    d_poses = [inverse @ (one.p - one.pc @ d_camera) for one, inverse in zip(equations, inverses, strict=True)]
    return Adjusted(here.parameters + d_camera, here.poses + np.array(d_poses))


def _cost(views: Sequence[SeenCorners], at: Adjusted) -> float:
    """The sum of squares, px^2; inf where a corner is not before the camera, or a focal length not above zero."""
    if not np.all(at.parameters[:2] > 0):
        return np.inf
    total = 0.0
    for view, pose in zip(views, at.poses, strict=True):
        rotation, translation, matrix, distortion = _for_opencv(pose, at.parameters)
        depth = view.points @ cv2.Rodrigues(rotation)[0][2] + pose[5]
        if not np.all(depth > 0):
            return np.inf
        pixels, _ = cv2.projectPoints(view.points, rotation, translation, matrix, distortion)
        total += float(np.sum((view.pixels - np.asarray(pixels).reshape(-1, 2)) ** 2))
    return total if np.isfinite(total) else np.inf


def _for_opencv(pose: Array, parameters: Array) -> tuple[MatLike, MatLike, MatLike, MatLike]:
    fx, fy, cx, cy = parameters[:4]
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return pose[:3], pose[3:], matrix, parameters[4:]
