"""The estimate of camera and target from views of a cell with one arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dualcal_hal.config import OneArmCell, OneArmConfig
from dualcal_hal.errors import UsageError
from dualcal_hal.robot import Joints
from dualcal_hal.session.captures import CaptureRecord
from dualcal_hal.transforms import Array
from procedures.analysis.knowns import arrays, inexact_knowns
from procedures.estimation.refined import Inexact, Refined
from procedures.estimation.refined.arms import Inverted
from procedures.estimation.refined.data import Knowns
from procedures.estimation.refined.one_arm import JointReadings, Placement, Views, refined_views
from procedures.one_arm.sorting import joints_of, stops


def placement_of(config: OneArmConfig) -> Placement:
    return Placement.ON_ARM if config.camera_on_arm else Placement.FIXED


def joint_sigma(config: OneArmConfig) -> float:
    """rad: by which a reading misses where the arm stood: its arrival's error and that of the mean of two readings."""
    return float(np.hypot(config.arm.joint_sigma, config.arm.encoder_sigma / np.sqrt(2)))


def views_of(config: OneArmConfig, joints: Sequence[Joints], corners: Sequence[Array]) -> Views:
    """joints: of the arm at each view, rad; corners: (n, 2) px each, NaN for one not seen."""
    intrinsics = config.camera.intrinsics
    return Views(
        arm=JointReadings(config.arm.chain, np.array(joints), joint_sigma(config)),
        pixels=np.stack(corners),
        corners=config.target.board.corners,
        matrix=intrinsics.matrix,
        distortion=intrinsics.distortion,
    )


def views_of_captures(cell: OneArmCell, captures: Sequence[CaptureRecord]) -> Views:
    """With all that captures may say: their order, where another program saw the target, and how exactly."""
    data, config = arrays(captures, cell), cell.one_arm
    views = views_of(config, [joints_of(capture) for capture in captures], list(data.pixels))
    return replace(
        views,
        order_known=data.order_known,
        board_poses=data.board_poses,
        weights=data.weights,
        stops=stops(captures, config),
    )


def estimate(
    config: OneArmConfig,
    views: Views,
    *,
    keep_all: bool = False,
    find_noise: bool = False,
    inexact: Sequence[Inexact] = (),
    estimate_inexact: bool = True,
) -> Refined:
    """By the noise that the cell file states, or that the views show; the nominal is one start of several.

    Raises Degenerate for views that do not determine both transforms, UsageError where corners are said to be exact.
    """
    if config.camera.sigma_px == 0:
        raise UsageError("camera.sigma_px: the estimate needs to know how exact a corner is; 0 is not possible")
    return refined_views(
        views,
        placement_of(config),
        config.camera.sigma_px,
        further_starts=[(config.nominal.camera, config.nominal.target)],
        keep_all=keep_all,
        estimate_noise=find_noise,
        inexact=inexact,
        estimate_inexact=estimate_inexact,
    )


def inexact_of(config: OneArmConfig, free: Sequence[str]) -> list[Inexact]:
    """Knowns that carry a sigma in the cell file, and those that are to be free."""
    if refused := [name for name in free if name != "intrinsics"]:
        raise UsageError(f"--free {refused[0]}: with one arm only intrinsics can be free; the target is sought anyway")
    found = [_of_the_arm(one) for one in inexact_knowns(config.as_two_arms(), free)]
    return found if config.camera_on_arm else [_of_inverted(one) for one in found]


def _of_the_arm(one: Inexact) -> Inexact:
    def said(text: str) -> str:
        return text.replace("the active arm", "the arm").replace("the passive arm", "the arm")

    return replace(one, what=said(one.what), names=tuple(map(said, one.names)))


def _of_inverted(one: Inexact) -> Inexact:
    """The same of an arm that is looked at from its flange, and is the active one then."""

    def shifted(knowns: Knowns, by: Array) -> Knowns:
        if not isinstance(knowns.active, Inverted):
            return one.shifted(knowns, by)
        there = one.shifted(replace(knowns, passive=knowns.active.arm), by)
        return replace(there, active=Inverted(there.passive), passive=knowns.passive)

    return replace(one, shifted=shifted)
