"""Where the corners of rendered images are, found without the detector, and where they should be."""

from __future__ import annotations

import cv2
import numpy as np

from backends.simulator.pattern import Values
from dualcal_hal.camera import Image, Intrinsics
from dualcal_hal.target import Checkerboard
from dualcal_hal.transforms import Array, rotation_from_vector, transform

MATRIX = np.array([[812.0, 0.0, 511.5], [0.0, 812.0, 383.5], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.12, 0.05, 0.001, -0.0005, 0.01])
CAMERA = Intrinsics(MATRIX, DISTORTION, (1024, 768))
BOARD = Checkerboard(3, 3, 0.025, 4)
MARGIN = 0.01
FACING = np.diag([1.0, -1.0, -1.0])  # R_E_T of a board seen straight from the front, upright


def project(points: Array, T_E_T: Array, camera: Intrinsics = CAMERA) -> Array:
    rotation, _ = cv2.Rodrigues(T_E_T[:3, :3])
    pixels, _ = cv2.projectPoints(points, rotation, T_E_T[:3, 3], camera.matrix, camera.distortion)
    return np.asarray(pixels).reshape(-1, 2)


def random_view(rng: np.random.Generator, distance: float) -> Array:
    """A view of the board, tilted by up to 40 deg, with its pattern wholly in the image."""
    while True:
        direction = rng.uniform(0, 2 * np.pi)
        tilt = np.radians(rng.uniform(0, 40)) * np.array([np.cos(direction), np.sin(direction), 0.0])
        turn = [0.0, 0.0, rng.uniform(-np.pi, np.pi)]
        R = rotation_from_vector(turn) @ rotation_from_vector(tilt) @ FACING
        T_E_T = transform(R, distance * np.array([*rng.uniform(-0.5, 0.5, 2), 1.0]))
        pixels = project(BOARD.outline, T_E_T)
        if np.all(pixels > 8) and np.all(pixels < np.array(CAMERA.size) - 9):
            return T_E_T


def saddle(image: Image, start: Array) -> Array:
    """Saddle point of the quadratic that fits the smoothed patch around ``start`` best."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.5)
    v, u = (grid.ravel() for grid in np.mgrid[-5.0:6.0, -5.0:6.0])
    terms = np.stack([u * u, u * v, v * v, u, v, np.ones_like(u)], axis=1)
    point = start.copy()
    for _ in range(5):
        patch = cv2.getRectSubPix(smooth, (11, 11), (float(point[0]), float(point[1])))
        a, b, c, d, e, _ = np.linalg.lstsq(terms, patch.ravel(), rcond=None)[0]
        point = point + np.linalg.solve([[2 * a, b], [b, 2 * c]], [-d, -e])
    return point


def corners_found(image: Values, start: Array) -> Array:
    """(n, 2) px: the corners next to ``start`` (n, 2) in a noise-free image, after rounding to 8 bits."""
    rounded = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    return np.array([saddle(rounded, corner) for corner in start])
