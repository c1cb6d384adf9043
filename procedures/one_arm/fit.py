"""The estimate of camera and target from views of a cell with one arm."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dualcal_hal.config import OneArmConfig
from dualcal_hal.robot import Joints
from dualcal_hal.transforms import Array
from procedures.estimation.refined.inexact import Inexact
from procedures.estimation.refined.one_arm import JointReadings, OneArm, Placement, Views, one_arm

LEAST_PIXEL, LEAST_JOINT = 1e-3, 1e-7
"""px and rad: what corners and joints scatter by at least, where a cell file says that they do not."""


def views_of(
    config: OneArmConfig, joints: Sequence[Joints], corners: Sequence[Array], order_known: Sequence[bool] | None = None
) -> Views:
    """joints: of the arm at each view, rad; corners: (n, 2) px each, NaN for one not seen."""
    arm, intrinsics = config.arm, config.camera.intrinsics
    return Views(
        arm=JointReadings(arm.chain, np.array(joints), max(_sigma(config), LEAST_JOINT)),
        pixels=np.stack(corners),
        corners=config.target.board.corners,
        matrix=intrinsics.matrix,
        distortion=intrinsics.distortion,
        order_known=None if order_known is None else np.array(order_known),
    )


def estimate(
    config: OneArmConfig,
    views: Views,
    *,
    keep_all: bool = False,
    find_noise: bool = False,
    inexact: Sequence[Inexact] = (),
) -> OneArm:
    """By the noise that the cell file states, or that the views show; the nominal is one start of several.

    Raises Degenerate for views that do not determine both transforms.
    """
    nominal = config.nominal
    return one_arm(
        views,
        placement_of(config),
        max(config.camera.sigma_px, LEAST_PIXEL),
        further_starts=[(nominal.camera, nominal.target)],
        keep_all=keep_all,
        estimate_noise=find_noise,
        inexact=inexact,
    )


def placement_of(config: OneArmConfig) -> Placement:
    return Placement.ON_ARM if config.camera_on_arm else Placement.FIXED


def _sigma(config: OneArmConfig) -> float:
    """rad: by which a reading misses where the arm stood: what it repeats by, and what its encoders scatter by."""
    return float(np.hypot(config.arm.joint_sigma, config.arm.encoder_sigma / np.sqrt(2)))
