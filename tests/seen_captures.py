"""Captures whose corners are detected in rendered images, for what errors of the images do to the mismatch."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from backends.simulator.mechanics import Approach
from backends.simulator.rendering import Renderer
from backends.simulator.truth import Truth
from dualcal_hal.camera import Image
from dualcal_hal.config import CellConfig, SimulationConfig
from dualcal_hal.session.captures import CaptureRecord, read_captures
from dualcal_hal.transforms import Array
from procedures.detection import Detection, Detector
from procedures.estimation import mismatch
from tools.benchmarks.errors import POSES, Errors, fit_to_all_corners, paper_cell

_NOISE = 2.0  # grey levels
_INSTANTS = 5  # that an exposure is made of


@dataclass(frozen=True)
class Seen:
    """Mean mismatch in mm of a fit to all corners, on the verification captures; rms of the corners' errors in px."""

    mismatch: float
    corners: float


def seen(errors: Errors, since_rest: float = 0.0) -> Seen:
    """Of the reference captures, each target detected in an image with noise that does not depend on the errors.

    since_rest: s from the arms' coming to rest, where the reference has them, to the shutter's opening.
    """
    cell, simulation = paper_cell(errors)
    reference = read_captures(POSES)
    captures = replace(reference, captures=_detected(cell, simulation, reference.captures, since_rest))
    fit = fit_to_all_corners(cell, captures)
    poses = [capture for capture in captures.captures if capture.use == "verification"]
    T_A_H = cell.active.chain.forward([pose.active_joints for pose in poses])
    T_P_T = cell.passive.chain.forward([pose.passive_joints for pose in poses]) @ cell.passive.target_mount_transform
    after = mismatch(fit.T_P_A, fit.T_H_E, T_A_H, T_P_T[:, :3, 3])
    off = np.subtract(*([pose.corners for pose in c.captures] for c in (captures, reference)))
    return Seen(1e3 * float(after.mean()), float(np.sqrt(np.mean(off**2))))


def _detected(
    cell: CellConfig, simulation: SimulationConfig, poses: tuple[CaptureRecord, ...], since_rest: float
) -> tuple[CaptureRecord, ...]:
    truth, target, camera = Truth(cell, simulation), cell.target, cell.camera.intrinsics
    renderer = Renderer(target.board, target.margin, camera, simulation.noise.blur_px, simulation.errors)
    detector, rng = Detector(target.board, camera.size), np.random.default_rng(1)
    instants = since_rest + np.linspace(0.0, simulation.errors.motion_blur.exposure, _INSTANTS)
    arms = {name: (robot.home, Approach.at_rest(6)) for name, robot in cell.robots.items()}
    detected = []
    for pose in poses:
        for name, q in ((cell.active_name, pose.active_joints), (cell.passive_name, pose.passive_joints)):
            before, approach = arms[name]
            arms[name] = np.array(q), truth.approach(approach, [np.array(q) - before], 0.0)
        places = []
        for when in instants.tolist():
            q_a, q_p = (truth.link_angles(name, *arms[name], when) for name in (cell.active_name, cell.passive_name))
            places.append(truth.T_E_T(q_a, q_p, when))
        outcome = detector.detect(_with_noise(renderer.expose(places), rng), np.array(pose.corners))
        assert isinstance(outcome, Detection), outcome
        corners = tuple(map(tuple, outcome.corners.tolist()))
        detected.append(replace(pose, feature=tuple(outcome.feature.tolist()), corners=corners))
    return tuple(detected)


def _with_noise(image: Array, rng: np.random.Generator) -> Image:
    noisy = cv2.add(image, _NOISE * rng.standard_normal(image.shape, dtype=np.float32))
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
