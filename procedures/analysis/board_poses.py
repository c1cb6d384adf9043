"""Captures that say where the target was seen in place of its corners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dualcal_hal.config import CellConfig
from dualcal_hal.session.captures import CaptureRecord, Captures
from dualcal_hal.transforms import Array, apply, skew
from procedures.estimation.projection import project, project_with_jacobian


def with_corners(captures: Captures, cell: CellConfig) -> Captures:
    """The same with the corners and the feature point where the camera would see them on a target in that pose."""
    return replace(captures, captures=tuple(_with_corners(capture, cell) for capture in captures.captures))


def _with_corners(capture: CaptureRecord, cell: CellConfig) -> CaptureRecord:
    if capture.board_pose is None or capture.corners is not None:
        return capture
    camera, board = cell.camera.intrinsics, cell.target.board
    seen = project(apply(np.array(capture.board_pose.matrix), board.corners), camera.matrix, camera.distortion)
    if not np.all(np.isfinite(seen)):
        return capture
    corners = tuple((float(u), float(v)) for u, v in seen)
    return replace(capture, corners=corners, feature=corners[board.feature])


def weights_of(captures: Sequence[CaptureRecord], cell: CellConfig) -> Array | None:
    """(k, 2n, 2n) that make of the corners' errors those of the poses, where these have a covariance; None where none
    has. The information on the pose is then the inverse of that covariance, to first order; of another pose than the
    camera saw corners say nothing.
    """
    if not any(capture.board_pose is not None and capture.board_pose.covariance for capture in captures):
        return None
    n = 2 * len(cell.target.board.corners)
    weights = np.tile(np.eye(n), (len(captures), 1, 1))
    for index, capture in enumerate(captures):
        if capture.board_pose is not None and capture.board_pose.covariance is not None:
            weights[index] = _weights(
                np.array(capture.board_pose.matrix), np.array(capture.board_pose.covariance), cell
            )
    return weights


def _weights(T_E_T: Array, covariance: Array, cell: CellConfig) -> Array:
    """The symmetric root of the information that the corners have by the pose."""
    camera, sigma = cell.camera.intrinsics, cell.camera.sigma_px
    corners = cell.target.board.corners
    _, J_pixel = project_with_jacobian(apply(T_E_T, corners), camera.matrix, camera.distortion)
    # A motion (v, w) of T_E_T in T moves a corner c by R (v + w x c).
    moves = T_E_T[:3, :3] @ np.concatenate([np.tile(np.eye(3), (len(corners), 1, 1)), -skew(corners)], axis=-1)
    J = (J_pixel @ moves).reshape(-1, 6) / sigma
    back = np.linalg.pinv(J)
    information = back.T @ np.linalg.inv(covariance) @ back
    values, axes = np.linalg.eigh((information + information.T) / 2)
    values[:-6] = 0.0
    return np.asarray((axes * np.sqrt(np.maximum(values, 0.0))) @ axes.T)
