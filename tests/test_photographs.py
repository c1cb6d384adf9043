"""Real photographs: an industrial arm carries a ChArUco board in front of a fixed camera."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from dualcal_hal.camera import Image
from dualcal_hal.target import Charuco, Checkerboard
from dualcal_hal.transforms import Array, apply, inverse, rotation_from_quaternion, rotation_from_vector, transform
from procedures.detection import Detection, Detector, Missed
from procedures.estimation.projection import project

FOLDER = Path(__file__).parents[2] / "shared/data/abb-charuco"
OPENCV_FINDS = 225
"""Corners that OpenCV's own detector finds in the ten images."""

pytestmark = pytest.mark.skipif(not FOLDER.exists(), reason=f"the photographs are not at {FOLDER}")


@pytest.fixture(scope="module")
def told() -> dict[str, Any]:
    document: dict[str, Any] = json.loads((FOLDER / "views.json").read_text())
    return document


@pytest.fixture(scope="module")
def images(told: dict[str, Any]) -> list[Image]:
    read = [cv2.imread(str(FOLDER / view["image"]), cv2.IMREAD_GRAYSCALE) for view in told["views"]]
    return [np.asarray(image, dtype=np.uint8) for image in read]


@pytest.fixture(scope="module")
def board(told: dict[str, Any]) -> Charuco:
    target = told["target"]
    rows, columns = target["squares_y"] - 1, target["squares_x"] - 1
    square, marker = target["square_mm"] / 1000, target["marker_mm"] / 1000
    return Charuco(rows, columns, square, 9, marker, target["dictionary"])


@pytest.fixture(scope="module")
def corners(images: list[Image], board: Charuco) -> Array:
    """(views, n, 2) px, NaN where not seen."""
    detector = Detector(board, (1600, 1200))
    found = [detector.detect(image) for image in images]
    assert all(isinstance(detection, Detection) for detection in found), found
    return np.stack([detection.corners for detection in found if isinstance(detection, Detection)])


def test_more_corners_are_found_than_by_opencv(corners: Array) -> None:
    assert np.isfinite(corners[..., 0]).sum() > OPENCV_FINDS


def test_no_corner_is_far_from_where_the_arm_held_it(corners: Array, board: Charuco, told: dict[str, Any]) -> None:
    flange = np.stack([pose(view["flange_in_base"]) for view in told["views"]])
    camera, target = pose(told["guess"]["camera_in_base"]), pose(told["guess"]["target_in_flange"])
    matrix = np.array(told["camera"]["matrix"], dtype=float)
    seen = np.isfinite(corners[..., 0])

    def residuals(x: Array) -> Array:
        T_E_T = inverse(camera @ deviation(x[:6])) @ flange @ target @ deviation(x[6:12])
        lens = np.array([[x[12], 0.0, x[14]], [0.0, x[13], x[15]], [0.0, 0.0, 1.0]])
        return np.asarray((project(apply(T_E_T, board.corners), lens, x[16:]) - corners)[seen])

    start = np.concatenate([np.zeros(12), matrix[[0, 1, 0, 1], [0, 1, 2, 2]], np.zeros(5)])
    fit = least_squares(lambda x: residuals(x).ravel(), start, x_scale="jac")
    off = residuals(fit.x)
    assert np.sqrt(np.mean(off**2)) < 0.8
    assert np.linalg.norm(off, axis=1).max() < 4.0


def test_a_photograph_takes_less_than_150_ms(images: list[Image], board: Charuco) -> None:
    detector = Detector(board, (1600, 1200))
    times = []
    for image in images:
        start = time.process_time()
        detector.detect(image)
        times.append(time.process_time() - start)
    assert np.median(times) < 0.15


def test_a_plain_checkerboard_is_not_found_in_them(images: list[Image]) -> None:
    detector = Detector(Checkerboard(3, 3, 0.036195, 4), (1600, 1200))
    assert all(isinstance(detector.detect(image), Missed) for image in images)


def test_nothing_is_found_in_what_is_beside_the_board(images: list[Image], corners: Array, board: Charuco) -> None:
    rng = np.random.default_rng(1)
    detectors = [Detector(target, (640, 480)) for target in (board, Checkerboard(3, 3, 0.025, 4))]
    crops = 0
    for image, seen in zip(images, corners, strict=True):
        low, high = np.nanmin(seen, axis=0) - 150, np.nanmax(seen, axis=0) + 150
        for x, y in rng.integers(0, (1600 - 640, 1200 - 480), (20, 2)):
            if np.all((np.array([x, y]) < high) & (low < np.array([x + 640, y + 480]))):
                continue
            crops += 1
            crop = np.ascontiguousarray(image[y : y + 480, x : x + 640])
            assert all(isinstance(detector.detect(crop), Missed) for detector in detectors)
    assert crops >= 20


def pose(record: dict[str, list[float]]) -> Array:
    quaternion = np.array(record["quaternion_xyzw"])
    return transform(rotation_from_quaternion(quaternion / np.linalg.norm(quaternion)), record["translation_m"])


def deviation(x: Array) -> Array:
    return transform(rotation_from_vector(x[3:]), x[:3])
