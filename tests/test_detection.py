"""The checkerboard's corners in images, and the board's pose from them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualcal_hal.camera import Image, Intrinsics
from dualcal_hal.errors import DegenerateCaptures, UsageError
from dualcal_hal.target import Checkerboard
from dualcal_hal.transforms import Array, rotation_angle, rotation_from_vector, transform
from procedures.detection import Detection, Detector, Miss, Missed, board_poses, checkerboard
from procedures.detection.lattice import SaddlePoints
from tests.board_images import FACING, Scene, clutter, intrinsics, project, random_view

CAMERA = intrinsics()
BOARD = Checkerboard(3, 3, 0.025, 4)
BOARDS = [
    BOARD,
    Checkerboard(4, 4, 0.02, 5),
    Checkerboard(4, 3, 0.02, 4),
    Checkerboard(3, 6, 0.02, 8),
    Checkerboard(6, 9, 0.015, 22),
    Checkerboard(9, 6, 0.015, 22),
]


def facing(roll: float = 0.0, position: tuple[float, float, float] = (0.0, 0.0, 0.4)) -> Array:
    return transform(rotation_from_vector([0.0, 0.0, roll]) @ FACING, position)


def detected(outcome: Detection | Missed) -> Detection:
    assert isinstance(outcome, Detection), outcome
    return outcome


def missed(outcome: Detection | Missed) -> Missed:
    assert isinstance(outcome, Missed)
    return outcome


def rolled(pixels: Array, roll: float, scale: float = 1.0, shift: tuple[float, float] = (0.0, 0.0)) -> Array:
    centre = pixels.mean(axis=0)
    turn = scale * rotation_from_vector([0.0, 0.0, roll])[:2, :2]
    return np.asarray(centre + shift + (pixels - centre) @ turn.T)


def errors_over_views(count: int, seed: int, blur: float = 0.6, noise: float = 2.0) -> Array:
    """(9 count, 2) px: detected minus true corners over random distorted views."""
    rng = np.random.default_rng(seed)
    scene, detector = Scene(BOARD, CAMERA, rng, blur, noise), Detector(BOARD, CAMERA.size)
    errors = []
    for _ in range(count):
        T_E_T = random_view(rng, BOARD, CAMERA)
        truth = project(BOARD, CAMERA, T_E_T)
        errors.append(detected(detector.detect(scene.image(T_E_T), truth)).corners - truth)
    return np.concatenate(errors)


@pytest.fixture
def scene() -> Scene:
    """Of its own for each test, so that its noise does not depend on which tests came before."""
    return Scene(BOARD, CAMERA, np.random.default_rng(1))


@pytest.fixture(scope="module")
def detector() -> Detector:
    return Detector(BOARD, CAMERA.size)


def test_corners_are_within_a_hundredth_of_a_pixel_of_the_truth() -> None:
    errors = errors_over_views(25, seed=11)
    assert np.all(np.sqrt(np.mean(errors**2, axis=0)) < 0.010)
    assert np.all(np.abs(np.mean(errors, axis=0)) < 0.003)


@pytest.mark.slow
@pytest.mark.parametrize(("blur", "noise", "limit"), [(0.6, 2.0, 0.010), (1.5, 10.0, 0.05)])
def test_corners_are_where_they_should_be_over_five_hundred_views(blur: float, noise: float, limit: float) -> None:
    errors = errors_over_views(500, 12, blur, noise)
    assert np.all(np.sqrt(np.mean(errors**2, axis=0)) < limit)
    assert np.all(np.abs(np.mean(errors, axis=0)) < 0.1 * limit)


def test_corners_in_blur_and_noise_are_within_a_twentieth_of_a_pixel() -> None:
    errors = errors_over_views(15, seed=13, blur=1.5, noise=10.0)
    assert np.all(np.sqrt(np.mean(errors**2, axis=0)) < 0.05)


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: f"{board.rows}x{board.columns}")
def test_boards_of_any_size_are_found_in_their_order(board: Checkerboard) -> None:
    rng = np.random.default_rng(2)
    scene, detector = Scene(board, CAMERA, rng), Detector(board, CAMERA.size)
    for _ in range(6):
        T_E_T = random_view(rng, board, CAMERA)
        truth = project(board, CAMERA, T_E_T)
        detection = detected(detector.detect(scene.image(T_E_T), rolled(truth, 0.3, shift=(30.0, -20.0))))
        assert detection.order_known
        np.testing.assert_allclose(detection.corners, truth, atol=0.2)
        np.testing.assert_allclose(detection.feature, truth[board.feature], atol=0.2)


@pytest.mark.parametrize("size", [(640, 480), (1280, 960)])
def test_images_of_other_sizes_do_as_well(size: tuple[int, int]) -> None:
    camera, rng = intrinsics(size), np.random.default_rng(3)
    T_E_T = random_view(rng, BOARD, camera)
    truth = project(BOARD, camera, T_E_T)
    detection = detected(Detector(BOARD, size).detect(Scene(BOARD, camera, rng).image(T_E_T), truth))
    np.testing.assert_allclose(detection.corners, truth, atol=0.1)


@pytest.mark.parametrize("square_m", [0.004, 0.008])
def test_small_squares_are_measured_with_a_smaller_window(square_m: float) -> None:
    board, rng = Checkerboard(5, 7, square_m, 17), np.random.default_rng(4)
    truth = project(board, CAMERA, facing(0.2))
    detection = detected(Detector(board, CAMERA.size).detect(Scene(board, CAMERA, rng).image(facing(0.2)), truth))
    assert np.sqrt(np.mean((detection.corners - truth) ** 2)) < 0.04


@pytest.mark.parametrize("shift", [(0.0, 0.0), (300.0, -200.0)])
@pytest.mark.parametrize("roll_deg", [-25, 0, 25])
@pytest.mark.parametrize("quarter", range(4))
def test_the_prediction_decides_the_order_whatever_its_position(
    scene: Scene, detector: Detector, quarter: int, roll_deg: int, shift: tuple[float, float]
) -> None:
    T_E_T = facing(quarter * np.pi / 2 + 0.4)
    truth = project(BOARD, CAMERA, T_E_T)
    predicted = rolled(truth, np.deg2rad(roll_deg), scale=1.3, shift=shift)
    detection = detected(detector.detect(scene.image(T_E_T), predicted))
    assert detection.order_known
    np.testing.assert_allclose(detection.corners, truth, atol=0.1)


def test_an_order_is_not_known_when_two_fit_alike(scene: Scene, detector: Detector) -> None:
    truth = project(BOARD, CAMERA, facing())
    assert not detected(detector.detect(scene.image(facing()), rolled(truth, np.deg2rad(44)))).order_known


def test_an_oblong_board_has_two_orders_only() -> None:
    board = Checkerboard(3, 4, 0.02, 5)
    scene, detector = Scene(board, CAMERA, np.random.default_rng(5)), Detector(board, CAMERA.size)
    truth = project(board, CAMERA, facing())
    image = scene.image(facing())
    assert detected(detector.detect(image, rolled(truth, np.deg2rad(60)))).order_known
    assert not detected(detector.detect(image, rolled(truth, np.deg2rad(88)))).order_known


@pytest.mark.parametrize("board", BOARDS[:4], ids=lambda board: f"{board.rows}x{board.columns}")
def test_without_a_prediction_the_order_is_not_known_but_one_of_those_from_the_front(
    board: Checkerboard,
) -> None:
    rng = np.random.default_rng(6)
    T_E_T = random_view(rng, board, CAMERA)
    truth = project(board, CAMERA, T_E_T).reshape(board.rows, board.columns, 2)
    outcome = Detector(board, CAMERA.size).detect(Scene(board, CAMERA, rng).image(T_E_T))
    detection = detected(outcome)
    assert not detection.order_known
    turns = (np.rot90(truth, k) for k in range(4))
    alike = [turn.reshape(-1, 2) for turn in turns if turn.shape == truth.shape]
    assert min(np.abs(detection.corners - order).max() for order in alike) < 0.1


def test_the_middle_corner_does_not_depend_on_the_order(scene: Scene, detector: Detector) -> None:
    T_E_T = facing(2.0)
    detection = detected(detector.detect(scene.image(T_E_T)))
    np.testing.assert_allclose(detection.feature, project(BOARD, CAMERA, T_E_T)[4], atol=0.05)


@pytest.mark.parametrize("flip", [np.s_[::-1, ::-1], np.s_[:, ::-1], np.s_[::-1]])
def test_whatever_end_the_search_starts_from_the_result_is_the_same(
    scene: Scene, detector: Detector, monkeypatch: pytest.MonkeyPatch, flip: tuple[slice, ...]
) -> None:
    image, truth = scene.image(facing(0.3)), project(BOARD, CAMERA, facing(0.3))
    expected = detected(detector.detect(image, truth)).corners
    find = checkerboard.find_lattices

    def from_another_end(saddles: SaddlePoints, *limits: float) -> list[Array]:
        return [lattice[flip] for lattice in find(saddles, *limits)]

    monkeypatch.setattr(checkerboard, "find_lattices", from_another_end)
    np.testing.assert_allclose(detected(detector.detect(image, truth)).corners, expected, atol=0.005)


def test_clutter_around_the_board_does_not_matter(scene: Scene, detector: Detector) -> None:
    rng = np.random.default_rng(7)
    for _ in range(8):
        T_E_T = random_view(rng, BOARD, CAMERA)
        truth = project(BOARD, CAMERA, T_E_T)
        image = scene.image(T_E_T, clutter(rng))
        for prediction in (truth, truth + np.array([200.0, -150.0])):
            np.testing.assert_allclose(detected(detector.detect(image, prediction)).corners, truth, atol=0.2)


def test_nothing_is_found_in_images_of_clutter(detector: Detector) -> None:
    assert_all_missed(detector, seed=8, count=25)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_nothing_is_found_in_two_thousand_images_of_clutter(detector: Detector) -> None:
    assert_all_missed(detector, seed=9, count=2000)


def assert_all_missed(detector: Detector, seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(count):
        assert isinstance(detector.detect(clutter(rng)), Missed)


def test_corners_that_are_not_a_boards_are_refused_even_if_the_search_returns_them(
    detector: Detector, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(10)
    grid = np.stack(np.meshgrid(np.arange(3), np.arange(3)), axis=-1)

    def anything(saddles: SaddlePoints, *limits: float) -> list[Array]:
        return [rng.uniform(100, 500, 2) + rng.uniform(15, 60) * grid + rng.normal(0, 1, (3, 3, 2))]

    monkeypatch.setattr(checkerboard, "find_lattices", anything)
    for _ in range(10):
        assert missed(detector.detect(clutter(rng))).reason is Miss.NOT_FOUND


def test_a_grid_of_dark_spots_is_no_checkerboard(detector: Detector, monkeypatch: pytest.MonkeyPatch) -> None:
    image = np.full((768, 1024), 200, np.uint8)
    for i, j in np.ndindex(5, 5):
        image[300 + 60 * i : 335 + 60 * i, 400 + 60 * j : 435 + 60 * j] = 30
    image = cv2.GaussianBlur(image, (0, 0), 0.6)
    assert missed(detector.detect(image)).reason is Miss.NOT_FOUND
    between = np.array([[(477 + 30 * (j + i), 407 + 30 * (i - j)) for i in range(3)] for j in range(3)], dtype=float)
    monkeypatch.setattr(checkerboard, "find_lattices", lambda saddles, *limits: [between])
    outcome = missed(detector.detect(image))
    assert outcome.reason is Miss.NOT_FOUND
    assert "meet like squares" in outcome.detail


@pytest.mark.parametrize(("rows", "columns"), [(3, 4), (4, 3), (4, 4), (5, 5), (3, 7)])
def test_a_larger_checkerboard_is_not_taken_for_a_part_of_it(detector: Detector, rows: int, columns: int) -> None:
    larger = Checkerboard(rows, columns, 0.025, columns + 1)
    outcome = missed(detector.detect(Scene(larger, CAMERA, np.random.default_rng(11)).image(facing(0.3))))
    assert outcome.reason is Miss.NOT_FOUND
    assert "more corners" in outcome.detail


def test_a_larger_checkerboard_is_known_by_its_squares_where_its_corners_were_not_seen(
    detector: Detector, monkeypatch: pytest.MonkeyPatch
) -> None:
    larger = Checkerboard(5, 5, 0.025, 12)
    image = Scene(larger, CAMERA, np.random.default_rng(11)).image(facing())
    inner = project(larger, CAMERA, facing()).reshape(5, 5, 2)[1:4, 1:4]
    monkeypatch.setattr(checkerboard, "find_lattices", lambda saddles, *limits: [inner])
    outcome = missed(detector.detect(image))
    assert outcome.reason is Miss.NOT_FOUND
    assert "more corners" in outcome.detail


def test_a_larger_checkerboard_is_known_by_a_few_squares_beside_the_part_that_is_seen(detector: Detector) -> None:
    larger, rng = Checkerboard(5, 5, 0.025, 12), np.random.default_rng(11)
    corners = project(larger, CAMERA, facing(0.3)).reshape(5, 5, 2)
    for _ in range(8):
        image = Scene(larger, CAMERA, rng).image(facing(0.3))
        for side in (corners[0, 1:4], corners[4, 1:4], corners[1:4, 0], corners[1:4, 4]):
            for corner in rng.permutation(side)[:2]:
                covered(image, corner, 110, 23)
        assert "more corners" in missed(detector.detect(image)).detail


def test_a_larger_checkerboard_that_the_edge_cuts_is_known_by_the_squares_in_the_image(detector: Detector) -> None:
    larger, camera = Checkerboard(4, 5, 0.025, 7), intrinsics(distorted=False)
    T_E_T = facing(position=((30.0 - 512) * 0.4 / 812, 0.0, 0.4))
    corners = project(larger, camera, T_E_T).reshape(4, 5, 2)
    assert np.all(corners[:, 1, 0] < 0)
    assert np.all(corners[:, 2, 0] > 15)
    image = Scene(larger, camera, np.random.default_rng(11)).image(T_E_T)
    for corner in corners[3, 2:4]:
        covered(image, corner, 110, 23)
    assert "more corners" in missed(detector.detect(image)).detail


def test_something_that_touches_the_board_at_one_place_does_not_matter(scene: Scene, detector: Detector) -> None:
    truth = project(BOARD, CAMERA, facing()).reshape(3, 3, 2)
    for i, j in np.ndindex(3, 3):
        if (i, j) == (1, 1):
            continue
        rim = truth[i, j] + (truth[i, j] - truth[1, 1]) * (1 if 1 in (i, j) else (1, 0))
        image = covered(scene.image(facing()), rim, 20)
        np.testing.assert_allclose(detected(detector.detect(image)).feature, truth[1, 1], atol=0.05)


def test_a_candidate_whose_squares_are_not_convex_is_refused(
    detector: Detector, monkeypatch: pytest.MonkeyPatch
) -> None:
    dented = np.array([[(400 + 50 * j, 300 + 50 * i) for j in range(3)] for i in range(3)], dtype=float)
    dented[2, 2] = dented[1, 1] + 5.0
    monkeypatch.setattr(checkerboard, "find_lattices", lambda saddles, *limits: [dented])
    outcome = missed(detector.detect(np.full((768, 1024), 128, np.uint8), dented.reshape(-1, 2)))
    assert "lie like a board's" in outcome.detail


def test_a_corner_by_the_edge_of_the_image_is_a_miss_at_the_border(detector: Detector) -> None:
    camera = intrinsics(distorted=False)
    scene = Scene(BOARD, camera, np.random.default_rng(12))
    fx, cx = camera.matrix[0, 0], camera.matrix[0, 2]
    for pixels_from_edge, reason in ((15.0, Miss.AT_BORDER), (30.0, None)):
        T_E_T = facing(position=((pixels_from_edge - cx) * 0.4 / fx + BOARD.square, 0.0, 0.4))
        outcome = detector.detect(scene.image(T_E_T), project(BOARD, camera, T_E_T))
        assert (outcome.reason if isinstance(outcome, Missed) else None) is reason


def test_a_board_cut_by_the_edge_as_predicted_is_a_miss_at_the_border(detector: Detector) -> None:
    camera = intrinsics(distorted=False)
    T_E_T = facing(position=(0.4 * 512 / 812, 0.0, 0.4))
    image = Scene(BOARD, camera, np.random.default_rng(13)).image(T_E_T)
    assert missed(detector.detect(image, project(BOARD, camera, T_E_T))).reason is Miss.AT_BORDER
    assert missed(detector.detect(image)).reason is Miss.NOT_FOUND


@pytest.mark.parametrize(("sigma", "usable"), [(1.0, True), (2.5, True), (3.5, False), (5.0, False)])
def test_a_blurred_image_is_refused(detector: Detector, sigma: float, usable: bool) -> None:
    image = Scene(BOARD, CAMERA, np.random.default_rng(14), blur=sigma).image(facing(0.5))
    outcome = detector.detect(image, project(BOARD, CAMERA, facing(0.5)))
    if usable:
        assert detected(outcome).blur == pytest.approx(np.hypot(sigma, 0.5), rel=0.15)
    else:
        assert missed(outcome).reason is Miss.BLURRED


@pytest.mark.parametrize("length", [9, pytest.param(13, marks=pytest.mark.slow)])
def test_motion_along_one_direction_blurs_too(detector: Detector, length: int) -> None:
    for seed in range(10):
        image = cv2.blur(Scene(BOARD, CAMERA, np.random.default_rng(seed)).image(facing()), (length, 1))
        assert missed(detector.detect(image, project(BOARD, CAMERA, facing()))).reason is Miss.BLURRED


def test_a_faint_pattern_is_not_found(scene: Scene, detector: Detector) -> None:
    faint = np.rint(100 + 0.08 * scene.image(facing())).astype(np.uint8)
    assert missed(detector.detect(faint, project(BOARD, CAMERA, facing()))).reason is Miss.NOT_FOUND


def test_a_faint_pattern_is_not_taken_for_one_that_is_hidden(detector: Detector) -> None:
    rng = np.random.default_rng(0)
    for _ in range(12):
        T_E_T = random_view(rng, BOARD, CAMERA)
        sharp = Scene(BOARD, CAMERA, rng, noise=0.0).image(T_E_T)
        faint = 120 + 0.05 * (sharp - 120.0) + rng.normal(0.0, 2.0, sharp.shape)
        predicted = project(BOARD, CAMERA, T_E_T) + rng.normal(0.0, 60.0, 2)
        outcome = missed(detector.detect(np.rint(faint).astype(np.uint8), predicted))
        assert outcome.reason is not Miss.OCCLUDED


def test_a_faint_pattern_by_the_edge_is_told_by_its_contrast(detector: Detector) -> None:
    camera = intrinsics(distorted=False)
    T_E_T = facing(position=((30.0 - 512) * 0.4 / 812 + BOARD.square, 0.0, 0.4))
    image = Scene(BOARD, camera, np.random.default_rng(12)).image(T_E_T)
    outcome = missed(detector.detect(np.rint(100 + 0.08 * image).astype(np.uint8), project(BOARD, camera, T_E_T)))
    assert outcome.reason is Miss.NOT_FOUND
    assert "grey levels" in outcome.detail


def test_an_empty_image_is_a_miss(detector: Detector) -> None:
    assert missed(detector.detect(np.full((768, 1024), 128, np.uint8))).reason is Miss.NOT_FOUND


@pytest.mark.parametrize("corner", range(9))
def test_a_hidden_corner_means_occluded(scene: Scene, detector: Detector, corner: int) -> None:
    truth = project(BOARD, CAMERA, facing())
    image = covered(scene.image(facing()), truth[corner], 120)
    outcome = missed(detector.detect(image, truth + np.array([15.0, -10.0])))
    assert outcome.reason is Miss.OCCLUDED
    assert "8 of 9 corners" in outcome.detail
    assert "in front" in outcome.detail


def test_something_in_front_of_a_third_of_the_board_means_occluded(scene: Scene, detector: Detector) -> None:
    image, truth = scene.image(facing()), project(BOARD, CAMERA, facing())
    image[:, int(truth[2, 0]) - 15 :] = 90
    assert missed(detector.detect(image, truth)).reason is Miss.OCCLUDED


def test_a_corner_in_a_glare_means_saturated(scene: Scene, detector: Detector) -> None:
    truth = project(BOARD, CAMERA, facing())
    outcome = missed(detector.detect(covered(scene.image(facing()), truth[4], 255), truth))
    assert outcome.reason is Miss.SATURATED
    assert "exposure" in outcome.detail


def test_a_corner_in_a_deep_shadow_means_too_dark(scene: Scene, detector: Detector) -> None:
    truth = project(BOARD, CAMERA, facing())
    assert missed(detector.detect(covered(scene.image(facing()), truth[4], 5), truth)).reason is Miss.TOO_DARK


@pytest.mark.parametrize("predicted", [True, False])
@pytest.mark.parametrize(
    ("gain", "offset", "reason"),
    [(8.0, 30.0, Miss.SATURATED), (0.1, 0.0, Miss.TOO_DARK), (0.08, 100.0, Miss.NOT_FOUND), (0.5, 20.0, None)],
)
def test_an_exposure_that_hides_the_board_is_the_reason(
    scene: Scene, detector: Detector, gain: float, offset: float, reason: Miss | None, predicted: bool
) -> None:
    image = np.clip(gain * scene.image(facing()) + offset, 0, 255).astype(np.uint8)
    outcome = detector.detect(image, project(BOARD, CAMERA, facing()) if predicted else None)
    assert (outcome.reason if isinstance(outcome, Missed) else None) is reason


def test_the_board_is_found_in_light_from_one_side(scene: Scene, detector: Detector) -> None:
    truth = project(BOARD, CAMERA, facing(0.4))
    light = np.linspace(0.1, 1.0, 1024)  # so steep that it shifts the saddles by a tenth of a pixel
    image = np.rint(scene.image(facing(0.4)) * light).astype(np.uint8)
    for prediction in (truth, None):
        np.testing.assert_allclose(detected(detector.detect(image, prediction)).feature, truth[4], atol=0.2)


def test_an_image_without_any_sharp_edge_is_blurred(detector: Detector) -> None:
    image = Scene(BOARD, CAMERA, np.random.default_rng(14), blur=25.0).image(facing(0.5))
    assert missed(detector.detect(image, project(BOARD, CAMERA, facing(0.5)))).reason is Miss.BLURRED


def covered(image: Image, middle: Array, grey: int, half: int = 15) -> Image:
    """The image with a square of one grey value over a corner."""
    x, y = np.rint(middle).astype(int)
    image[y - half : y + half + 1, x - half : x + half + 1] = grey
    return image


@pytest.mark.parametrize(
    "image", [np.zeros((1024, 768), np.uint8), np.zeros((768, 1024)), np.zeros((768, 1024, 3), np.uint8)]
)
def test_an_image_of_another_size_or_type_is_a_usage_error(detector: Detector, image: Image) -> None:
    with pytest.raises(UsageError, match="1024 x 768"):
        detector.detect(image)


@pytest.mark.parametrize("predicted", [np.zeros((8, 2)), np.full((9, 2), np.nan)])
def test_a_prediction_that_is_none_is_a_usage_error(detector: Detector, predicted: Array) -> None:
    with pytest.raises(UsageError, match="9 corners"):
        detector.detect(np.zeros((768, 1024), np.uint8), predicted)


def test_a_board_of_fewer_than_three_corners_a_side_is_a_usage_error() -> None:
    with pytest.raises(UsageError, match="3 x 3"):
        Detector(Checkerboard(2, 5, 0.02, 0), CAMERA.size)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), distorted=st.booleans())
def test_one_of_the_poses_from_exact_corners_is_the_true_one(seed: int, distorted: bool) -> None:
    rng, camera = np.random.default_rng(seed), intrinsics(distorted=distorted)
    T_E_T = random_view(rng, BOARD, camera)
    poses = board_poses(project(BOARD, camera, T_E_T), BOARD, camera)
    T, rms = poses[0]
    assert rms < 1e-4
    assert rotation_angle(T[:3, :3], T_E_T[:3, :3]) < 1e-4
    np.testing.assert_allclose(T[:3, 3], T_E_T[:3, 3], atol=1e-6)
    assert [rms for _, rms in poses] == sorted(rms for _, rms in poses)


def test_the_rms_of_a_pose_is_that_of_the_noise_less_what_the_pose_takes_up() -> None:
    rng, camera = np.random.default_rng(15), intrinsics()
    squares = []
    for _ in range(60):
        corners = project(BOARD, camera, random_view(rng, BOARD, camera))
        _, rms = board_poses(corners + rng.normal(0.0, 0.1, corners.shape), BOARD, camera)[0]
        squares.append(rms**2)
    assert np.sqrt(np.mean(squares)) == pytest.approx(0.1 * np.sqrt((18 - 6) / 18), rel=0.1)


def test_a_pose_from_some_of_the_corners_is_the_true_one() -> None:
    rng = np.random.default_rng(16)
    T_E_T = random_view(rng, BOARD, CAMERA)
    corners = project(BOARD, CAMERA, T_E_T)
    corners[[0, 1, 2, 5]] = np.nan
    T, rms = board_poses(corners, BOARD, CAMERA)[0]
    assert rms < 1e-4
    np.testing.assert_allclose(T, T_E_T, atol=1e-5)


@pytest.mark.parametrize("corners", [np.zeros((8, 2)), np.full((9, 2), np.inf), np.full((9, 2), np.nan)])
def test_a_pose_from_other_than_the_boards_corners_is_a_usage_error(corners: Array) -> None:
    with pytest.raises(UsageError, match="at least 4 are finite"):
        board_poses(corners, BOARD, CAMERA)


def test_coincident_corners_determine_no_pose() -> None:
    straight = Intrinsics(CAMERA.matrix, np.zeros(5), CAMERA.size)
    with pytest.raises(DegenerateCaptures):
        board_poses(np.full((9, 2), 300.0), BOARD, straight)
