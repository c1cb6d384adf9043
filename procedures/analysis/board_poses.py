"""Captures that say where the target was seen in place of its corners."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from dualcal_hal.config import CellConfig
from dualcal_hal.errors import FormatError, Problem, UsageError
from dualcal_hal.session.captures import CaptureRecord, Captures
from dualcal_hal.transforms import Array, apply, skew
from procedures.estimation.projection import project, project_with_jacobian


def with_corners(captures: Captures, cell: CellConfig) -> Captures:
    """The same with the corners and the feature point where the camera would see them on a target in that pose.

    Raises FormatError for all poses of a target that no camera sees there.
    """
    if problems := list(_impossible(captures.captures, cell)):
        raise FormatError(problems)
    return replace(captures, captures=tuple(_with_corners(capture, cell) for capture in captures.captures))


def _impossible(captures: Sequence[CaptureRecord], cell: CellConfig) -> Iterator[Problem]:
    for capture in captures:
        if capture.board_pose is None:
            continue
        pose = np.array(capture.board_pose.matrix)
        if np.any(apply(pose, cell.target.board.corners)[:, 2] <= 0):
            yield Problem(capture.id, "target_in_camera: has the target behind the camera, whose z must point forward")
        elif pose[:3, 2] @ pose[:3, 3] >= 0:
            yield Problem(capture.id, "target_in_camera: is seen from behind; the target's z must point to the viewer")


def _with_corners(capture: CaptureRecord, cell: CellConfig) -> CaptureRecord:
    if capture.board_pose is None or capture.corners is not None:
        return capture
    camera, board = cell.camera.intrinsics, cell.target.board
    seen = project(apply(np.array(capture.board_pose.matrix), board.corners), camera.matrix, camera.distortion)
    corners = tuple((float(u), float(v)) for u, v in seen)
    return replace(capture, corners=corners, feature=corners[board.feature])


def refuse_what_poses_hide(captures: Captures, cell: CellConfig, free: Sequence[str]) -> None:
    """UsageError where lens or squares are to be found, or reckoned with, and a capture has a pose in place of corners.

    What a lens or a square that is off does to such a pose was decided by the program that made it, so one of them is
    enough: it would be taken for one that the true lens and squares have seen.
    """
    posed = [capture.id for capture in captures.captures if capture.board_pose is not None]
    sigma = cell.camera.intrinsics_sigma
    asked = {
        "--free intrinsics": "intrinsics" in free,
        "camera.intrinsics_sigma": sigma is not None
        and bool(sigma.focal_px or sigma.centre_px or any(sigma.distortion)),
        "target.square_sigma_mm": bool(cell.target.square_sigma_mm),
    }
    unfit = [name for name, given in asked.items() if given]
    if posed and unfit:
        raise UsageError(
            f"{' and '.join(unfit)}: {len(posed)} captures, the first {posed[0]}, have target_in_camera in place of"
            " corners, and a pose does not show lens or squares; go without, or use captures with corners alone"
        )


def refuse_two_kinds_of_noise(captures: Captures) -> None:
    """UsageError where poses say themselves how exact they are, and other captures do not: what is found of the noise
    is one factor on all.
    """
    stated = [c.id for c in captures.captures if c.board_pose is not None and c.board_pose.covariance is not None]
    if stated and len(stated) < len(captures.captures):
        raise UsageError(
            f"--noise estimate: {len(stated)} of {len(captures.captures)} captures, the first {stated[0]}, say with"
            " target_in_camera how exact they are, and one sigma is found for all; leave out their covariance"
        )


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
