"""What each error of camera, print and light does to the image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backends.simulator import SimulatorBackend
from backends.simulator.optics import true_intrinsics
from backends.simulator.pattern import Values
from backends.simulator.rendering import BLACK, WHITE, Renderer
from backends.simulator.surface import Surface
from dualcal_hal.config.image_errors import ImageErrorsConfig
from dualcal_hal.errors import CellFileError, UsageError
from dualcal_hal.robot import JointPath
from dualcal_hal.transforms import Array, inverse, rotation_from_vector, transform
from tests.cells import NOISELESS, paper_cell
from tests.rendered_corners import BOARD, CAMERA, FACING, MARGIN, corners_found, project, random_view
from tests.seen_captures import Seen, seen

AHEAD = transform(FACING, [0.0, 0.0, 0.4])
TILTED = transform(rotation_from_vector([0.4, -0.3, 0.5]) @ FACING, [0.06, -0.03, 0.4])


def with_errors(**errors: dict[str, object]) -> ImageErrorsConfig:
    """As a cell file has them."""
    return ImageErrorsConfig.model_validate(errors)


def renderer(blur: float = 0.6, **errors: dict[str, object]) -> Renderer:
    return Renderer(BOARD, MARGIN, CAMERA, blur, with_errors(**errors))


def displacement(T_E_T: Array = TILTED, **errors: dict[str, object]) -> Array:
    """(9, 2) px: how far the corners of a rendered image are from where the cell file lets one expect them."""
    expected = project(BOARD.corners, T_E_T)
    return corners_found(renderer(**errors).render(T_E_T), expected) - expected


def contrast(image: Values) -> float:
    """Between a white and a black square next to the middle of the board ahead."""
    black, white = np.rint(project(np.array([[-0.0125, 0.0125, 0.0], [0.0125, 0.0125, 0.0]]), AHEAD)).astype(int)
    return abs(float(image[white[1], white[0]]) - float(image[black[1], black[0]]))


def test_without_errors_the_image_is_the_one_the_cell_file_describes() -> None:
    np.testing.assert_array_equal(renderer().render(TILTED), Renderer(BOARD, MARGIN, CAMERA, 0.6).render(TILTED))
    assert np.abs(displacement()).max() < 0.02


def test_a_principal_point_that_is_off_moves_the_image() -> None:
    moved = displacement(principal_point={"right_px": 1.5, "down_px": -0.7})
    np.testing.assert_allclose(moved, np.tile([1.5, -0.7], (9, 1)), atol=0.02)


def test_focal_lengths_that_are_off_scale_the_image_about_the_principal_point() -> None:
    from_axis = project(BOARD.corners, TILTED) - CAMERA.principal_point
    moved = displacement(focal={"x_ppm": 10000.0, "y_ppm": -5000.0})
    np.testing.assert_allclose(moved, from_axis * [0.01, -0.005], atol=0.02)


@pytest.mark.parametrize("corner_px", [2.0, -1.0])
def test_a_distortion_left_out_moves_the_farthest_corner_of_the_image_by_what_it_says(corner_px: float) -> None:
    true = true_intrinsics(CAMERA, with_errors(distortion_residual={"corner_px": corner_px}))
    corners = np.array([[0.0, 0.0], [1023.0, 0.0], [0.0, 767.0], [1023.0, 767.0]])
    ideal = cv2.undistortImagePoints(corners, CAMERA.matrix, CAMERA.distortion, None, (3, 100, 1e-12)).reshape(-1, 2)
    rays = np.c_[(ideal - CAMERA.principal_point) / np.diag(CAMERA.matrix)[:2], np.ones(4)]
    moved = project(rays, np.eye(4), true) - project(rays, np.eye(4), CAMERA)
    assert np.linalg.norm(moved, axis=1).max() == pytest.approx(abs(corner_px), rel=1e-6)
    assert np.all(corner_px * np.sum(moved * (corners - CAMERA.principal_point), axis=1) > 0)


def test_a_distortion_left_out_grows_with_the_cube_of_the_distance_from_the_axis() -> None:
    far = transform(FACING, [0.16, 0.11, 0.4])
    ideal = far[:3, 3] / far[2, 3] + BOARD.corners * [1.0, -1.0, 0.0] / far[2, 3]
    radius = np.linalg.norm(ideal[:, :2], axis=1)
    moved = np.linalg.norm(displacement(far, distortion_residual={"corner_px": 4.0}), axis=1)
    reach = np.linalg.norm(project(np.array([[-0.7, -0.52, 1.0]]), np.eye(4)) - [0.0, 0.0])
    assert reach < 40  # this ray meets the image near its corner
    np.testing.assert_allclose(moved, 4.0 * (radius / np.hypot(0.7, 0.52)) ** 3, rtol=0.15)


def test_squares_that_are_too_large_are_so_about_the_feature_point() -> None:
    larger = BOARD.corners * [1.008, 0.996, 1.0]
    moved = displacement(square_scale={"x_ppm": 8000.0, "y_ppm": -4000.0})
    np.testing.assert_allclose(moved, project(larger, TILTED) - project(BOARD.corners, TILTED), atol=0.02)
    assert np.abs(moved).max() > 0.3


@pytest.mark.parametrize("bow_mm", [-3.0, 1.0, 3.0])
def test_corners_of_a_bent_plate_are_where_its_surface_is_seen(bow_mm: float) -> None:
    bent = BOARD.corners.copy()
    # The outer corners of the pattern, two squares off in both directions, are the ones that stand out by the bow.
    bent[:, 2] = bow_mm / 1000 * np.sum(bent[:, :2] ** 2, axis=1) / (2 * 0.05**2)
    camera = renderer(flatness={"bow_mm": bow_mm})
    rng = np.random.default_rng(1)
    most = 0.0
    for _ in range(10):
        T_E_T = random_view(rng, 0.4)
        expected = project(bent, T_E_T)
        most = max(most, float(np.abs(expected - project(BOARD.corners, T_E_T)).max()))
        np.testing.assert_allclose(corners_found(camera.render(T_E_T), expected), expected, atol=0.03)
    assert most > 0.3 * abs(bow_mm)  # px: ten times the tolerance


@given(st.floats(-2.0, 2.0), st.floats(-5000.0, 5000.0), st.floats(-5000.0, 5000.0), st.integers(0, 1000))
def test_points_and_lines_of_sight_agree_on_a_bent_and_misprinted_surface(
    bow_mm: float, x_ppm: float, y_ppm: float, seed: int
) -> None:
    errors = with_errors(flatness={"bow_mm": bow_mm}, square_scale={"x_ppm": x_ppm, "y_ppm": y_ppm})
    surface = Surface.of(BOARD, errors)
    viewpoint = inverse(random_view(np.random.default_rng(seed), 0.3))[:3, 3]
    true = surface.points(BOARD.corners)
    along = viewpoint[2] / (viewpoint[2] - true[:, 2])
    foot = viewpoint + along[:, None] * (true - viewpoint)
    x, y = surface.printed(foot[:, 0], foot[:, 1], viewpoint, reach=0.1)
    np.testing.assert_allclose(np.stack([x, y], axis=1), BOARD.corners[:, :2], atol=3e-6)


def test_a_bias_moves_all_corners_alike_wherever_they_are() -> None:
    moved = displacement(corner_bias={"right_px": 0.2, "down_px": 0.1})
    unbiased = displacement()
    np.testing.assert_allclose(moved - unbiased, np.tile([0.2, 0.1], (9, 1)), atol=0.01)


def test_light_falls_off_evenly_across_the_image_in_the_direction_told() -> None:
    even = renderer().render(AHEAD)
    rightwards = renderer(lighting={"gradient_percent": 40.0}).render(AHEAD) / even
    np.testing.assert_allclose(rightwards, np.tile(np.linspace(1.0, 0.6, 1024), (768, 1)), atol=1e-3)
    downwards = renderer(lighting={"gradient_percent": 40.0, "gradient_direction_deg": 90.0}).render(AHEAD) / even
    np.testing.assert_allclose(downwards, np.tile(np.linspace(1.0, 0.6, 768)[:, None], (1, 1024)), atol=1e-3)


def test_glare_adds_its_grey_levels_in_its_middle_and_a_tenth_of_them_two_sigma_off() -> None:
    glare = {"glare_grey": 100.0, "glare_position_percent": (25.0, 50.0), "glare_radius_percent": 10.0}
    added = renderer(lighting=glare).render(AHEAD) - renderer().render(AHEAD)
    assert added[384, 256] == pytest.approx(100.0, abs=0.1)
    assert added[384, 256 + 205] == pytest.approx(100.0 * np.exp(-2.0), abs=0.5)
    assert added[0, 1023] == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("loss", [30.0, 90.0])
def test_contrast_is_lost_by_the_share_told(loss: float) -> None:
    image = renderer(lighting={"contrast_loss_percent": loss}).render(AHEAD)
    assert contrast(image) == pytest.approx((1.0 - loss / 100.0) * (WHITE - BLACK), abs=0.1)
    assert contrast(renderer().render(AHEAD)) == pytest.approx(WHITE - BLACK, abs=0.1)


def edge_sigma(image: Values) -> float:
    """Sigma in px of the edge between the two middle squares below the feature point of a board ahead at 0.4 m."""
    u, v = np.rint(project(np.array([[0.0, -0.0125, 0.0]]), AHEAD)[0]).astype(int)
    slope = np.abs(np.diff(image[v, u - 22 : u + 22].astype(float)))
    at = np.arange(len(slope)) - np.average(np.arange(len(slope)), weights=slope)
    return float(np.sqrt(np.average(at**2, weights=slope)))


def test_blur_grows_with_the_distance_from_the_focus() -> None:
    defocus: dict[str, object] = {"px_per_dioptre": 4.0, "focus_mm": 500.0}
    sharp, blurred = (edge_sigma(renderer(**errors).render(AHEAD)) for errors in ({}, {"defocus": defocus}))
    # 1 / 0.4 m - 1 / 0.5 m is half a dioptre: 2 px, on top of what there is anyway.
    assert np.sqrt(blurred**2 - sharp**2) == pytest.approx(2.0, rel=0.03)
    in_focus = renderer(defocus={"px_per_dioptre": 4.0, "focus_mm": 400.0}).render(AHEAD)
    assert edge_sigma(in_focus) == pytest.approx(sharp)


def test_motion_during_the_exposure_smears_edges_along_it_and_moves_them_halfway() -> None:
    # 6 px to the right, which is 2.95 mm at 0.4 m; a box that wide has a sigma of 6 / sqrt(12) px.
    way = 6.0 * 0.4 / 812.0
    poses = [transform(FACING, [share * way, 0.0, 0.4]) for share in np.linspace(0.0, 1.0, 9)]
    still, moving = renderer().render(AHEAD), renderer().expose(poses)
    assert np.sqrt(edge_sigma(moving) ** 2 - edge_sigma(still) ** 2) == pytest.approx(6.0 / np.sqrt(12.0), rel=0.15)
    corners = project(BOARD.corners, poses[4])
    np.testing.assert_allclose(corners_found(moving, corners), corners, atol=0.03)


def test_an_exposure_of_what_stands_still_is_one_image() -> None:
    np.testing.assert_array_equal(renderer().expose([TILTED] * 9), renderer().render(TILTED))


def test_a_frame_exposed_while_an_arm_moves_is_smeared_along_its_motion() -> None:
    sharpness = {}
    for exposure_ms in (0.0, 20.0):
        exposure = f"simulation.errors.motion_blur.exposure_ms={exposure_ms}"
        backend = SimulatorBackend("sim", paper_cell(*NOISELESS, exposure))
        backend.open(30.0)
        arm = backend.cell.cell.passive
        target = tuple((arm.home + [0.3, 0.0, 0.0, 0.0, 0.0, 0.0]).tolist())
        backend.robot("right").start(JointPath((target,), tuple(arm.speed), tuple(arm.acceleration)))
        frame = backend.camera("camera").grab(backend.clock.now() + 0.1, 30.0)
        sharpness[exposure_ms] = [np.abs(np.diff(frame.image.astype(float), axis=axis)).max() for axis in (0, 1)]
        backend.close()
    # Turned about its upright axis, the arm carries the target up in the camera's image, which lies on its side.
    along, across = np.divide(sharpness[20.0], sharpness[0.0])
    assert along < 0.3
    assert across > 0.9


# The mismatch, of corners detected in images with the same noise


@pytest.fixture(scope="module")
def undisturbed() -> Seen:
    return seen({})


@pytest.mark.parametrize(
    "lighting",
    [
        {"contrast_loss_percent": 80.0},
        {"gradient_percent": 50.0},
        {"glare_grey": 60.0, "glare_radius_percent": 3.0, "glare_position_percent": (52.0, 52.0)},
    ],
    ids=lambda lighting: next(iter(lighting)),
)
def test_poor_light_moves_corners_and_the_mismatch_grows(lighting: dict[str, object], undisturbed: Seen) -> None:
    """By some micrometres: what the detector finds at all, it finds well."""
    found = seen({"lighting": lighting})
    assert found.corners > 3 * undisturbed.corners
    assert 3 * undisturbed.mismatch < found.mismatch < 0.02


def test_defocus_makes_corners_and_the_mismatch_a_little_worse_as_long_as_they_are_found(undisturbed: Seen) -> None:
    found = seen({"defocus": {"px_per_dioptre": 2.0, "focus_mm": 300.0}})
    assert undisturbed.corners < found.corners < 3 * undisturbed.corners
    assert undisturbed.mismatch < found.mismatch < 0.01


def test_the_mismatch_grows_with_the_exposure_while_links_still_swing(undisturbed: Seen) -> None:
    """The links are at rest's place as the shutter opens, and leave it meanwhile; of arms that stand nothing grows."""
    swing = {"amplitude_mrad": 2.0, "frequency_hz": 5.0, "decay_s": 1.0}
    short, long = (seen({"settle_time": swing, "motion_blur": {"exposure_ms": ms}}) for ms in (10.0, 20.0))
    assert short.mismatch > 0.03
    assert long.mismatch == pytest.approx(2 * short.mismatch, rel=0.1)
    assert seen({"motion_blur": {"exposure_ms": 20.0}}) == undisturbed


# What cannot be


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ("arm_scale.ppm=-1e6", "must be at least -100000"),
        ("thermal.growth_ppm=2e5", "must be at most 100000"),
        ("focal.x_ppm=-1e6", "must be at least -100000"),
        ("square_scale.x_ppm=-2e6", "must be at least -100000"),
        ("motion_blur.exposure_ms=100000", "must be at most 1000"),
        ("time_skew.delay_s=2", "must be at most 1"),
    ],
)
def test_errors_beyond_all_reason_are_refused_by_their_key(setting: str, told: str) -> None:
    with pytest.raises(CellFileError) as refused:
        paper_cell(f"simulation.errors.{setting}")
    key = setting.partition("=")[0]
    assert str(refused.value).startswith(f"--set simulation.errors.{key}: {told}, not ")


def test_a_distortion_that_the_errors_make_impossible_is_not_blamed_on_the_cameras_own() -> None:
    with pytest.raises(UsageError, match=r"^simulation\.errors\.distortion_residual: "):
        renderer(distortion_residual={"corner_px": -500.0})


@pytest.mark.parametrize("depth", [0.0, 1e-9, -0.3])
def test_a_target_in_the_lens_or_behind_it_is_blurred_like_one_near_by(depth: float) -> None:
    defocus = with_errors(defocus={"px_per_dioptre": 4.0, "focus_mm": 400.0}).defocus
    assert defocus.sigma(depth) == defocus.sigma(0.1) == pytest.approx(4.0 * 7.5)
