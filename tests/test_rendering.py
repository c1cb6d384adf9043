"""The rendered board is where the camera's model says, to a few thousandths of a pixel."""

from __future__ import annotations

import numpy as np
import pytest

from backends.simulator.noise import generator, normal_image
from backends.simulator.optics import undistorted_rays
from backends.simulator.rendering import BLACK, WHITE, Renderer
from dualcal_hal.camera import Intrinsics
from dualcal_hal.errors import UsageError
from dualcal_hal.target import Checkerboard
from dualcal_hal.transforms import Array, rotation_from_vector, transform
from tests.rendered_corners import (
    BOARD,
    CAMERA,
    DISTORTION,
    FACING,
    MARGIN,
    MATRIX,
    corners_found,
    project,
    random_view,
)

SMALL = Intrinsics(np.array([[160.0, 0, 79.5], [0, 160.0, 59.5], [0, 0, 1]]), DISTORTION, (160, 120))


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(BOARD, MARGIN, CAMERA, blur=0.6)


def corner_errors(renderer: Renderer, distances: Array, seed: int) -> Array:
    """(n, 2) px: where the corners of noise-free 8-bit images are found, less where they should be."""
    rng = np.random.default_rng(seed)
    errors = []
    for distance in distances:
        T_E_T = random_view(rng, distance)
        expected = project(BOARD.corners, T_E_T)
        errors.append(corners_found(renderer.render(T_E_T), expected + rng.uniform(-0.3, 0.3, (9, 2))) - expected)
    return np.concatenate(errors)


@pytest.mark.parametrize("views", [80, pytest.param(200, marks=pytest.mark.slow)])
def test_corners_are_where_the_distorted_camera_sees_them(renderer: Renderer, views: int) -> None:
    errors = corner_errors(renderer, np.linspace(0.3, 0.5, views), seed=1)
    assert np.sqrt(np.mean(errors**2)) <= 0.005
    assert np.all(np.abs(errors.mean(axis=0)) <= 0.002)
    assert np.abs(errors).max() < 0.03


@pytest.mark.parametrize("distance", [0.3, 0.6])
def test_grey_values_are_means_over_each_pixels_area(distance: float) -> None:
    # The same scene by a camera with 9 x 9 pixels in place of each, averaged.
    fine = 9
    matrix = SMALL.matrix.copy()
    matrix[:2, :2] *= fine
    matrix[:2, 2] = fine * (SMALL.matrix[:2, 2] + 0.5) - 0.5
    size = (SMALL.size[0] * fine, SMALL.size[1] * fine)
    T_E_T = transform(rotation_from_vector([0.5, 0.3, 0.7]) @ FACING, [0.02, 0.01, distance])
    coarse = Renderer(BOARD, MARGIN, SMALL, blur=0.0).render(T_E_T)
    exact = Renderer(BOARD, MARGIN, Intrinsics(matrix, DISTORTION, size), blur=0.0).render(T_E_T)
    mean = exact.reshape(SMALL.size[1], fine, SMALL.size[0], fine).mean(axis=(1, 3))
    difference = coarse - mean
    contrast = WHITE - BLACK
    assert np.abs(difference).max() < 0.03 * contrast
    assert np.sqrt(np.mean(difference**2)) < 1e-3 * contrast


def test_the_top_left_square_is_black_and_colours_alternate(renderer: Renderer) -> None:
    T_E_T = transform(FACING, [0.0, 0.0, 0.4])
    image = renderer.render(T_E_T)
    i, j = np.mgrid[0:4, 0:4]
    centres = np.stack([(j - 1.5) * 0.025, (1.5 - i) * 0.025, np.zeros((4, 4))], axis=-1).reshape(-1, 3)
    u, v = np.rint(project(centres, T_E_T)).astype(int).T
    expected = np.where((i + j).ravel() % 2 == 0, BLACK, WHITE)
    np.testing.assert_allclose(image[v, u], expected, atol=1e-3)
    in_margin = BOARD.outline[:1] + np.array([-0.005, 0.005, 0.0])
    margin = np.rint(project(in_margin, T_E_T)).astype(int)[0]
    assert image[margin[1], margin[0]] == pytest.approx(WHITE)


def test_the_board_may_have_any_size_and_feature_point() -> None:
    board = Checkerboard(4, 6, 0.01, 0)
    T_E_T = transform(rotation_from_vector([0.2, 0.3, 0.1]) @ FACING, [-0.02, -0.02, 0.3])
    expected = project(board.corners, T_E_T)
    found = corners_found(Renderer(board, 0.005, CAMERA, blur=0.6).render(T_E_T), expected)
    np.testing.assert_allclose(found, expected, atol=0.03)


@pytest.mark.parametrize(
    ("what", "T_E_T"),
    [
        ("its back", transform(rotation_from_vector([0.1, 0.0, 0.0]), [0.0, 0.0, 0.4])),
        ("behind the camera", transform(FACING, [0.0, 0.0, -0.4])),
        ("out of view", transform(FACING, [0.6, 0.0, 0.4])),
        ("far out of view", transform(FACING, [9.0, 3.0, 0.1])),
    ],
)
def test_a_board_that_cannot_be_seen_is_not_drawn(renderer: Renderer, what: str, T_E_T: Array) -> None:
    empty = renderer.render(transform(FACING, [0.0, 0.0, -1.0]))
    np.testing.assert_array_equal(renderer.render(T_E_T), empty, err_msg=what)


@pytest.mark.parametrize(
    ("tilt", "position"),
    [
        ([0.0, 0.0, 0.3], [0.24, 0.1, 0.4]),  # over the right edge
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.03]),  # fills the image
        ([-1.2, 0.0, 0.0], [0.0, 0.02, 0.03]),  # seen flat, and partly behind the camera
        ([0.0, 1.3, 0.0], [0.1, 0.0, 0.3]),  # seen flat
    ],
)
def test_what_is_in_view_is_drawn_as_by_ray_casting(tilt: list[float], position: list[float]) -> None:
    T_E_T = transform(rotation_from_vector(tilt) @ FACING, position)
    image = Renderer(BOARD, MARGIN, SMALL, blur=0.0).render(T_E_T)
    white = np.abs(image - WHITE) < 1.0
    black = np.abs(image - BLACK) < 1.0
    squares = cast_squares(T_E_T)
    on_plate = np.all(np.abs(squares - 2.0) < 2.0 + MARGIN / BOARD.square, axis=-1)
    on_pattern = np.all(np.abs(squares - 2.0) < 2.0, axis=-1)
    even = np.floor(squares).sum(axis=-1) % 2 == 0
    # Pixels on an edge are mixed; all others must be one colour, the right one.
    assert not np.any(white & ~on_plate)
    assert not np.any(black & ~(on_pattern & even))
    assert not np.any(white & on_pattern & even)
    mixed = on_plate & ~white & ~black
    assert mixed.mean() < 0.15
    assert (white | black).sum() > 0.5 * on_plate.sum() > 0


def cast_squares(T_E_T: Array) -> Array:
    """(h, w, 2): column and row of the square that each pixel of the small camera sees; NaN for none."""
    rays = np.concatenate([undistorted_rays(SMALL), np.ones((120, 160, 1))], axis=-1)
    normal = T_E_T[:3, 2]
    depth = (normal @ T_E_T[:3, 3]) / (rays @ normal)
    points = (rays * depth[..., None] - T_E_T[:3, 3]) @ T_E_T[:3, :3]
    squares = np.stack([points[..., 0] / BOARD.square + 2.0, 2.0 - points[..., 1] / BOARD.square], axis=-1)
    squares[depth <= 0] = np.nan
    return squares


@pytest.mark.parametrize("k1", [-0.3, -0.12, 0.2])
def test_rays_of_pixels_are_undistorted_to_a_billionth_of_a_pixel(k1: float) -> None:
    camera = Intrinsics(MATRIX, np.array([k1, 0.1, 0.001, -0.0005, -0.02]), (1024, 768))
    rays = undistorted_rays(camera)[::64, ::64].reshape(-1, 2)
    pixels = project(np.c_[rays, np.ones(len(rays))], np.eye(4), camera)
    v, u = np.mgrid[0:768:64, 0:1024:64]
    np.testing.assert_allclose(pixels, np.stack([u.ravel(), v.ravel()], axis=1), rtol=0, atol=1e-9)


def test_a_distortion_that_folds_the_image_is_refused() -> None:
    with pytest.raises(UsageError, match="distortion"):
        undistorted_rays(Intrinsics(SMALL.matrix, np.array([-2.0, 0.0, 0.0, 0.0, 0.0]), SMALL.size))


def test_blur_spreads_edges_and_moves_nothing() -> None:
    T_E_T = transform(FACING, [0.0, 0.0, 0.4])
    sharp = Renderer(BOARD, MARGIN, CAMERA, blur=0.0).render(T_E_T)
    blurred = Renderer(BOARD, MARGIN, CAMERA, blur=2.0).render(T_E_T)
    assert np.abs(np.diff(blurred, axis=1)).max() < 0.4 * np.abs(np.diff(sharp, axis=1)).max()
    assert blurred.mean() == pytest.approx(sharp.mean(), abs=1e-3)


def test_image_noise_is_standard_normal_and_a_function_of_its_key() -> None:
    shape = (768, 1024)
    noise = normal_image(generator(1, "camera", 0.5), shape)
    np.testing.assert_array_equal(noise, normal_image(generator(1, "camera", 0.5), shape))
    other = normal_image(generator(1, "camera", 0.25), shape)
    assert abs(float(np.mean(noise, dtype=float))) < 5e-3
    assert float(np.std(noise, dtype=float)) == pytest.approx(1.0, abs=5e-3)
    assert float(np.mean(noise**4, dtype=float)) == pytest.approx(3.0, abs=0.05)
    assert abs(float(np.mean(noise * other, dtype=float))) < 5e-3
    assert abs(float(np.mean(noise[:, 1:] * noise[:, :-1], dtype=float))) < 5e-3
