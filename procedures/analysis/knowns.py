"""Captures and cell as the refined estimate takes them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from dualcal_hal.config import CellConfig, RobotConfig
from dualcal_hal.errors import UsageError
from dualcal_hal.session.captures import CaptureRecord
from dualcal_hal.transforms import Array
from procedures.analysis.board_poses import weights_of
from procedures.analysis.verification import joints
from procedures.estimation.refined import (
    CaptureArrays,
    Inexact,
    Knowns,
    Noise,
    free_intrinsics,
    intrinsics,
    joint_zeros,
    link_parameters,
    square_size,
    target_mount,
)


def arrays(captures: Sequence[CaptureRecord], cell: CellConfig) -> CaptureArrays:
    """All corners that were measured; of a capture without corners its feature point."""
    board = cell.target.board
    active, passive = joints(captures, cell)
    pixels = np.full((len(captures), len(board.corners), 2), np.nan)
    for index, capture in enumerate(captures):
        if capture.corners is None and capture.board_pose is None:
            pixels[index, board.feature] = capture.feature
        elif capture.corners is not None:
            pixels[index] = [corner or (np.nan, np.nan) for corner in capture.corners]
    return CaptureArrays(
        active=active,
        passive=passive,
        arrivals=np.array([capture.active_arrival for capture in captures]),
        pixels=pixels,
        order_known=np.array([capture.order_known for capture in captures], dtype=bool),
        board_poses=[None if capture.board_pose is None else capture.board_pose.matrix for capture in captures],
        weights=weights_of(captures, cell),
    )


def given_knowns(cell: CellConfig) -> Knowns:
    camera = cell.camera.intrinsics
    return Knowns(
        active=cell.active.chain,
        passive=cell.passive.chain,
        T_F_T=cell.passive.target_mount_transform,
        corners=cell.target.board.corners,
        matrix=camera.matrix,
        distortion=camera.distortion,
    )


def stated_noise(cell: CellConfig) -> Noise:
    """Of the cell file: an arm misses its reading by its arrival's error and by that of the mean of two readings.
    Raises UsageError where corners are said to be exact.
    """
    if cell.camera.sigma_px == 0:
        raise UsageError("camera.sigma_px: method refined needs to know how exact a corner is; 0 is not possible")
    return Noise(cell.camera.sigma_px, _joint_sigma(cell.active), _joint_sigma(cell.passive))


def _joint_sigma(robot: RobotConfig) -> float:
    return float(np.hypot(robot.joint_sigma, robot.encoder_sigma / np.sqrt(2)))


def inexact_knowns(cell: CellConfig, free: Sequence[str]) -> list[Inexact]:
    """Those that carry a sigma, and those that are to be ``free``, which then have no other prior."""
    found = [*_of_target(cell, free), *_of_camera(cell, free)]
    for arm, robot in (("active", cell.active), ("passive", cell.passive)):
        zeros, rows = robot.kinematics.joint_zero_sigma_deg, robot.kinematics.dh_sigma
        if zeros is not None and any(zeros):
            found.append(joint_zeros(arm, np.radians(zeros).tolist()))
        if rows is not None and (rows.length_mm or rows.angle_deg):
            found.append(link_parameters(arm, robot.chain, rows.length_mm / 1000, float(np.radians(rows.angle_deg))))
    return found


def _of_target(cell: CellConfig, free: Sequence[str]) -> Iterator[Inexact]:
    mount, square = cell.passive.target_mount_sigma, cell.target.square_sigma_mm
    if "target_mount" in free:
        yield target_mount(np.inf, np.inf)
    elif mount is not None and (mount.translation_mm or mount.rotation_deg):
        yield target_mount(mount.translation_mm / 1000, float(np.radians(mount.rotation_deg)))
    if square:
        yield square_size(square / cell.target.square_mm)


def _of_camera(cell: CellConfig, free: Sequence[str]) -> Iterator[Inexact]:
    sigma = cell.camera.intrinsics_sigma
    if "intrinsics" in free:
        yield free_intrinsics()
    elif sigma is not None and (sigma.focal_px or sigma.centre_px or any(sigma.distortion)):
        yield intrinsics(sigma.focal_px, sigma.centre_px, sigma.distortion)


def feature_points(captures: Sequence[CaptureRecord], cell: CellConfig) -> Array:
    """Where the arm held the feature point, (k, 3) in P, m."""
    _, passive = joints(captures, cell)
    return np.asarray((cell.passive.chain.forward(passive) @ cell.passive.target_mount_transform)[:, :3, 3])
