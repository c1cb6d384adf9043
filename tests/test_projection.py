"""The estimators' camera against OpenCV's."""

import cv2
import numpy as np
import pytest

from procedures.estimation.projection import distort, project, project_with_jacobian, undistort

MATRIX = np.array([[812.0, 0, 511.5], [0, 805.0, 383.5], [0, 0, 1]])
DISTORTIONS = [
    pytest.param([0, 0, 0, 0, 0], id="none"),
    pytest.param([-0.28, 0.09, 1e-3, -8e-4, -0.01], id="barrel"),
    pytest.param([0.45, 0.3, -4e-3, 5e-3, 0.2], id="strong pincushion"),
    pytest.param([-0.45, 0.28, 5e-3, -4e-3, -0.06], id="strong barrel"),
]


def points() -> np.ndarray:
    """(4, 50, 3) in front of the camera, over the whole image."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.3, 0.7, (4, 50, 1))
    return np.concatenate([rng.uniform([-0.6, -0.45], [0.6, 0.45], (4, 50, 2)) * depth, depth], axis=-1)


@pytest.mark.parametrize("distortion", DISTORTIONS)
def test_projection_and_its_derivative_equal_opencv(distortion: list[float]) -> None:
    X = points()
    expected, J = cv2.projectPoints(X.reshape(-1, 3), np.zeros(3), np.zeros(3), MATRIX, np.array(distortion, float))
    pixels, jacobian = project_with_jacobian(X, MATRIX, distortion)
    np.testing.assert_allclose(pixels.reshape(-1, 2), expected.reshape(-1, 2), atol=1e-9)
    np.testing.assert_array_equal(project(X, MATRIX, distortion), pixels)
    # With no rotation, d pixel / d translation is d pixel / d point.
    np.testing.assert_allclose(jacobian.reshape(-1, 3), J[:, 3:6], atol=1e-6)


@pytest.mark.parametrize("distortion", DISTORTIONS)
def test_undistorting_inverts_projection_to_1e_12(distortion: list[float]) -> None:
    X = points()
    normalised = X[..., :2] / X[..., 2:]
    np.testing.assert_allclose(undistort(project(X, MATRIX, distortion), MATRIX, distortion), normalised, atol=2e-12)


def test_the_principal_point_is_free_of_distortion() -> None:
    ray = undistort(MATRIX[:2, 2], MATRIX, [-0.45, 0.28, 5e-3, -4e-3, -0.06])
    np.testing.assert_array_equal(ray, [0, 0])


def test_points_not_in_front_of_the_camera_have_no_pixel() -> None:
    pixels = project([[0.1, 0.1, 0.5], [0, 0, 0], [0.1, 0.1, -0.5]], MATRIX, np.zeros(5))
    assert np.isfinite(pixels[0]).all()
    assert np.isnan(pixels[1:]).all()


def test_a_pixel_that_no_point_is_seen_at_is_refused() -> None:
    barrel = [-0.4, 0, 0, 0, 0]
    farthest = max(distort([r, 0], barrel)[0] for r in np.linspace(0, 2, 200))
    inside, outside = ([[511.5 + share * farthest * 812, 383.5]] for share in (0.99, 1.05))
    undistort(inside, MATRIX, barrel)
    with pytest.raises(ValueError, match="no point is seen there"):
        undistort(outside, MATRIX, barrel)
