"""ChArUco boards: drawn as OpenCV knows them, and found in part or whole."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from dualcal_hal.camera import Image
from dualcal_hal.cellfile import load_cell
from dualcal_hal.errors import CellFileError
from dualcal_hal.session.captures import read_captures
from dualcal_hal.target import Charuco
from dualcal_hal.transforms import Array
from procedures.detection import Detection, Detector, Miss, Missed, board_poses
from tests.board_images import FACING, Scene, clutter, intrinsics, project, random_view
from tests.cells import PAPER, SMALL
from tools.cli.app import app

CAMERA = intrinsics()
BOARD = Charuco(4, 4, 0.025, 5, 0.018, "DICT_4X4_50")
BOARDS = [BOARD, Charuco(3, 5, 0.025, 7, 0.0125, "DICT_6X6_250"), Charuco(5, 4, 0.025, 9, 0.015, "DICT_5X5_100", True)]
TARGET = (
    "target={kind: charuco, corners: [4, 4], feature_corner: [1, 1], square_mm: 25, marker_mm: 18,"
    " dictionary: DICT_4X4_50}"
)


@pytest.fixture(scope="module")
def detector() -> Detector:
    return Detector(BOARD, CAMERA.size)


@pytest.fixture(scope="module")
def facing() -> Array:
    T_E_T = np.eye(4)
    T_E_T[:3, :3], T_E_T[2, 3] = FACING, 0.4
    return T_E_T


@pytest.fixture
def image(facing: Array) -> Image:
    return Scene(BOARD, CAMERA, np.random.default_rng(1)).image(facing)


def detected(outcome: Detection | Missed) -> Detection:
    assert isinstance(outcome, Detection), outcome
    return outcome


def missed(outcome: Detection | Missed) -> Missed:
    assert isinstance(outcome, Missed)
    return outcome


def opencv_detector(board: Charuco) -> cv2.aruco.CharucoDetector:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    size = (board.columns + 1, board.rows + 1)
    known = cv2.aruco.CharucoBoard(size, board.square, board.marker, dictionary)
    known.setLegacyPattern(board.white_first)
    return cv2.aruco.CharucoDetector(known)


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: f"{board.rows}x{board.columns} {board.dictionary}")
def test_opencv_finds_each_corner_of_a_drawn_board_where_it_is(board: Charuco) -> None:
    rng = np.random.default_rng(2)
    scene, opencv = Scene(board, CAMERA, rng), opencv_detector(board)
    for _ in range(5):
        T_E_T = random_view(rng, board, CAMERA)
        corners, ids, _, _ = opencv.detectBoard(scene.image(T_E_T))
        assert 2 * len(ids) > board.rows * board.columns
        truth = project(board, CAMERA, T_E_T)[ids.ravel()]
        np.testing.assert_allclose(corners.reshape(-1, 2), truth, atol=0.5)


@pytest.mark.parametrize("predicted", [True, False])
@pytest.mark.parametrize("board", BOARDS, ids=lambda board: f"{board.rows}x{board.columns} {board.dictionary}")
def test_corners_are_found_in_their_order_whatever_the_roll_with_or_without_prediction(
    board: Charuco, predicted: bool
) -> None:
    rng = np.random.default_rng(3)
    scene, detector = Scene(board, CAMERA, rng), Detector(board, CAMERA.size)
    errors = []
    for _ in range(10):
        T_E_T = random_view(rng, board, CAMERA)
        truth = project(board, CAMERA, T_E_T)
        detection = detected(detector.detect(scene.image(T_E_T), truth + 20.0 if predicted else None))
        assert detection.order_known
        assert detection.seen.sum() >= len(truth) - 1
        errors.append((detection.corners - truth)[detection.seen])
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2)) < 0.02


def test_what_is_hidden_is_not_seen_and_the_rest_is(detector: Detector, image: Image, facing: Array) -> None:
    truth = project(BOARD, CAMERA, facing)
    image[:, int(truth[2, 0]) - 12 :] = 120
    detection = detected(detector.detect(image, truth))
    np.testing.assert_array_equal(detection.seen, np.tile([True, True, False, False], 4))
    np.testing.assert_allclose(detection.corners[detection.seen], truth[detection.seen], atol=0.06)
    T_E_T, _ = board_poses(detection.corners, BOARD, CAMERA)[0]
    np.testing.assert_allclose(T_E_T[:3, 3], facing[:3, 3], atol=2e-3)


def test_a_part_outside_the_image_is_not_seen_and_the_rest_is(detector: Detector, facing: Array) -> None:
    T_E_T = facing.copy()
    T_E_T[0, 3] = -0.24
    truth = project(BOARD, CAMERA, T_E_T)
    detection = detected(detector.detect(Scene(BOARD, CAMERA, np.random.default_rng(4)).image(T_E_T), truth))
    assert 4 <= detection.seen.sum() < len(truth)
    np.testing.assert_allclose(detection.corners[detection.seen], truth[detection.seen], atol=0.06)


def test_a_feature_point_that_is_hidden_has_no_place(detector: Detector, image: Image, facing: Array) -> None:
    x, y = np.rint(project(BOARD, CAMERA, facing)[BOARD.feature]).astype(int)
    image[y - 8 : y + 9, x - 8 : x + 9] = 120
    detection = detected(detector.detect(image))
    assert np.isnan(detection.feature).all()
    assert detection.seen.sum() == 15


def test_too_few_corners_in_view_means_occluded_or_at_the_border(
    detector: Detector, image: Image, facing: Array
) -> None:
    truth = project(BOARD, CAMERA, facing)
    hidden = image.copy()
    hidden[:, int(truth[1, 0]) - 30 :] = 120
    for corner in truth[[0, 4]]:
        x, y = np.rint(corner).astype(int)
        hidden[y - 6 : y + 7, x - 6 : x + 7] = 120
    assert missed(detector.detect(hidden, truth)).reason is Miss.OCCLUDED
    outside = facing.copy()
    outside[0, 3] = -0.285
    scene = Scene(BOARD, CAMERA, np.random.default_rng(5))
    assert missed(detector.detect(scene.image(outside), project(BOARD, CAMERA, outside))).reason is Miss.AT_BORDER


@pytest.mark.parametrize(("gain", "offset", "reason"), [(8.0, 30.0, Miss.SATURATED), (0.1, 0.0, Miss.TOO_DARK)])
def test_an_exposure_that_hides_the_board_is_the_reason(
    detector: Detector, image: Image, facing: Array, gain: float, offset: float, reason: Miss
) -> None:
    exposed = np.clip(gain * image + offset, 0, 255).astype(np.uint8)
    assert missed(detector.detect(exposed, project(BOARD, CAMERA, facing))).reason is reason


def test_a_blurred_board_is_refused(detector: Detector, facing: Array) -> None:
    image = Scene(BOARD, CAMERA, np.random.default_rng(6), blur=4.0).image(facing)
    assert missed(detector.detect(image, project(BOARD, CAMERA, facing))).reason is Miss.BLURRED


def test_markers_that_are_too_small_to_be_read_are_not_taken_for_hidden_ones() -> None:
    board = Charuco(5, 7, 0.015, 17, 0.011, "DICT_4X4_50")
    rng = np.random.default_rng(1)
    scene, detector = Scene(board, CAMERA, rng, blur=1.5, noise=10.0), Detector(board, CAMERA.size)
    views = [random_view(rng, board, CAMERA) for _ in range(20)]
    misses = [
        outcome
        for view in views
        if isinstance(outcome := detector.detect(scene.image(view), project(board, CAMERA, view)), Missed)
    ]
    assert len(misses) > 10
    assert {miss.reason for miss in misses} == {Miss.NOT_FOUND}
    assert sum("markers too small or image too noisy" in miss.detail for miss in misses) > 5


@pytest.mark.parametrize(
    ("marker", "noise", "blur", "found", "rms"),
    [
        (0.0125, 2.0, 0.6, 1.0, 0.010),
        pytest.param(0.018, 10.0, 1.5, 0.95, 0.05, marks=pytest.mark.slow),
        (0.012, 10.0, 1.5, 0.5, 0.05),
    ],
)
def test_corners_are_accurate_and_most_views_found_in_poor_images_too(
    marker: float, noise: float, blur: float, found: float, rms: float
) -> None:
    board = Charuco(4, 4, 0.025, 5, marker, "DICT_4X4_50")
    rng = np.random.default_rng(1)
    scene, detector = Scene(board, CAMERA, rng, blur=blur, noise=noise), Detector(board, CAMERA.size)
    views, errors = 40, []
    for _ in range(views):
        T_E_T = random_view(rng, board, CAMERA)
        truth = project(board, CAMERA, T_E_T)
        outcome = detector.detect(scene.image(T_E_T), truth)
        if isinstance(outcome, Detection):
            errors.append((outcome.corners - truth)[outcome.seen])
    assert len(errors) >= found * views
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0)).max() <= rms


def test_another_board_with_other_markers_is_not_this_one(detector: Detector, facing: Array) -> None:
    other = Charuco(4, 4, 0.025, 5, 0.018, "DICT_5X5_50")
    assert missed(detector.detect(Scene(other, CAMERA, np.random.default_rng(7)).image(facing))).reason is (
        Miss.NOT_FOUND
    )


def test_nothing_is_found_in_images_of_clutter(detector: Detector) -> None:
    rng = np.random.default_rng(8)
    for _ in range(15):
        assert missed(detector.detect(clutter(rng))).reason is Miss.NOT_FOUND


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"marker_mm: 18, ": ""}, "target.marker_mm: missing key: a charuco board's markers have it"),
        ({"marker_mm: 18": "marker_mm: 25"}, "target.marker_mm: must be less than square_mm, 25"),
        ({", dictionary: DICT_4X4_50": ""}, "target.dictionary: missing key: a charuco board's markers have it"),
        ({"[4, 4]": "[9, 10]"}, "target.dictionary: has 50 markers, the board needs 55"),
        ({"charuco": "checkerboard"}, "target.marker_mm: must be left out: a checkerboard has no markers"),
    ],
)
def test_a_cell_file_that_describes_no_board_is_refused(change: dict[str, str], told: str) -> None:
    setting = TARGET
    for old, new in change.items():
        setting = setting.replace(old, new)
    with pytest.raises(CellFileError) as refused:
        load_cell(PAPER, [setting])
    assert any(told in str(problem) for problem in refused.value.problems)


@pytest.mark.usefixtures("undrawn")
def test_a_cell_with_a_charuco_board_is_calibrated(tmp_path: Path) -> None:
    settings = [part for setting in (TARGET, *SMALL) for part in ("--set", setting)]
    done = CliRunner().invoke(app, ["run", str(PAPER), "--out", str(tmp_path / "session"), *settings])
    assert done.exit_code == 0, done.output
    captures = read_captures(tmp_path / "session" / "captures.json").captures
    assert all(capture.order_known and capture.aligned for capture in captures)


def test_white_comes_first_on_an_old_board_with_an_even_number_of_rows_alone() -> None:
    boards = [
        load_cell(PAPER, [TARGET, f"target.corners=[{rows}, 4]", "target.legacy=true"]).cell.target.board
        for rows in (3, 4)
    ]
    assert [isinstance(board, Charuco) and board.white_first for board in boards] == [True, False]
