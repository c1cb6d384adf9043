"""Detected corners against the truth, over random views through a lens with distortion.

python -m tools.benchmarks.corners --views 200
python -m tools.benchmarks.corners --views 500 --noise-grey 10 --blur-px 1.5
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from backends.simulator.rendering import Renderer
from dualcal_hal.camera import Intrinsics
from dualcal_hal.cellfile import load_cell
from dualcal_hal.target import Target
from dualcal_hal.transforms import Array, rotation_from_vector, transform
from procedures.detection import Detection, Detector

CELL = Path("cells/paper.yaml")
DISTORTION = np.array([-0.12, 0.05, 0.001, -0.0005, 0.0])
FACING = np.diag([1.0, -1.0, -1.0])
"""R_E_T of a board seen straight from the front, upright."""


def project(board: Target, camera: Intrinsics, T_E_T: Array, points: Array | None = None) -> Array:
    """(n, 2) px of the corners, or of ``points`` (n, 3) in T, by OpenCV."""
    rvec, _ = cv2.Rodrigues(T_E_T[:3, :3])
    points = board.corners if points is None else points
    pixels, _ = cv2.projectPoints(points, rvec, T_E_T[:3, 3], camera.matrix, camera.distortion)
    return np.asarray(pixels, dtype=float).reshape(-1, 2)


def random_view(rng: np.random.Generator, board: Target, camera: Intrinsics) -> Array:
    """T_E_T (4, 4) at 0.3 to 0.5 m, tilted by up to 45 deg, with the pattern and a rim in view."""
    rim = board.outline + 0.25 * board.square * np.sign(board.outline - board.outline.mean(axis=0))
    while True:
        tilt_axis = rng.uniform(-np.pi, np.pi)
        tilt = np.deg2rad(rng.uniform(0.0, 45.0)) * np.array([np.cos(tilt_axis), np.sin(tilt_axis), 0.0])
        R = rotation_from_vector([0.0, 0.0, rng.uniform(-np.pi, np.pi)]) @ rotation_from_vector(tilt) @ FACING
        T_E_T = transform(R, rng.uniform(0.3, 0.5) * np.array([*rng.uniform(-0.6, 0.6, 2), 1.0]))
        pixels = project(board, camera, T_E_T, rim)
        if np.all(pixels > 0) and np.all(pixels < np.array(camera.size) - 1):
            return T_E_T


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--noise-grey", type=float, help="grey levels; the cell's own where left out")
    parser.add_argument("--blur-px", type=float, help="sigma in px; the cell's own where left out")
    options = parser.parse_args()
    file = load_cell(CELL)
    assert file.simulation is not None
    given = {"image_grey": options.noise_grey, "blur_px": options.blur_px}
    update = {name: value for name, value in given.items() if value is not None}
    noise, board = file.simulation.noise.model_copy(update=update), file.cell.target.board
    camera = Intrinsics(file.cell.camera.intrinsics.matrix, DISTORTION, file.cell.camera.intrinsics.size)
    renderer = Renderer(board, file.cell.target.margin, camera, noise.blur_px)
    detector = Detector(board, camera.size)
    rng = np.random.default_rng(options.seed)
    errors, missed = [], 0
    for _ in range(options.views):
        T_E_T = random_view(rng, board, camera)
        truth = project(board, camera, T_E_T)
        noisy = renderer.render(T_E_T) + noise.image_grey * rng.standard_normal(camera.size[::-1], dtype=np.float32)
        seen = detector.detect(np.clip(np.rint(noisy), 0, 255).astype(np.uint8), truth)
        if isinstance(seen, Detection):
            errors.append(seen.corners - truth)
        else:
            missed += 1
    error = np.concatenate(errors)
    rms, mean = np.sqrt(np.mean(error**2, axis=0)), error.mean(axis=0)
    print(
        f"{options.views} views, {missed} missed: rms {rms[0]:.4f} and {rms[1]:.4f} px, "
        f"mean {mean[0]:+.5f} and {mean[1]:+.5f} px, max {np.abs(error).max():.3f} px"
    )


if __name__ == "__main__":
    main()
