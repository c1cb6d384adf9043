"""Rigid transforms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dualcal_hal.transforms import (
    apply,
    inverse,
    is_rotation,
    nearest_rotation,
    quaternion_from_rotation,
    rotation_angle,
    rotation_from_quaternion,
    rotation_from_vector,
    skew,
    smallest_rotation,
    transform,
    vector_from_rotation,
)

vectors = arrays(float, 3, elements=st.floats(-2, 2))
rotation_vectors = arrays(float, 3, elements=st.floats(-1.7, 1.7))


@given(rotation_vectors, vectors)
def test_a_transform_times_its_inverse_is_the_identity(rotation, translation):
    T = transform(rotation_from_vector(rotation), translation)
    np.testing.assert_allclose(T @ inverse(T), np.eye(4), atol=1e-12)


@given(rotation_vectors)
def test_a_rotation_vector_survives_the_matrix(rotation):
    if np.linalg.norm(rotation) < 3.1:
        np.testing.assert_allclose(vector_from_rotation(rotation_from_vector(rotation)), rotation, atol=1e-10)


@given(rotation_vectors)
def test_a_quaternion_is_x_y_z_w_with_w_not_negative(rotation):
    quaternion = quaternion_from_rotation(rotation_from_vector(rotation))
    angle = np.linalg.norm(rotation)
    assert quaternion[3] == pytest.approx(abs(np.cos(angle / 2)), abs=1e-9)
    np.testing.assert_allclose(rotation_from_quaternion(quaternion), rotation_from_vector(rotation), atol=1e-12)


@given(vectors, vectors)
def test_skew_is_the_cross_product(v, u):
    np.testing.assert_allclose(skew(v) @ u, np.cross(v, u), atol=1e-12)


@given(vectors, vectors)
def test_the_smallest_rotation_turns_one_direction_into_the_other_by_the_angle_between_them(start, end):
    if min(np.linalg.norm(start), np.linalg.norm(end)) < 1e-3:
        return
    a, b = start / np.linalg.norm(start), end / np.linalg.norm(end)
    R = smallest_rotation(start, end)
    np.testing.assert_allclose(R @ a, b, atol=1e-9)
    assert rotation_angle(R, np.eye(3)) == pytest.approx(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b), abs=1e-7)


@pytest.mark.parametrize("axis", np.eye(3))
def test_opposite_directions_are_turned_by_half_a_turn(axis):
    np.testing.assert_allclose(smallest_rotation(axis, -axis) @ axis, -axis, atol=1e-12)


def test_points_are_taken_from_the_inner_frame_to_the_outer():
    T_X_Y = transform(rotation_from_vector([0, 0, np.pi / 2]), [1.0, 2.0, 3.0])
    np.testing.assert_allclose(apply(T_X_Y, [[1.0, 0.0, 0.0]]), [[1.0, 3.0, 3.0]], atol=1e-15)


@given(rotation_vectors, arrays(float, (3, 3), elements=st.floats(-0.01, 0.01)))
def test_the_nearest_rotation_is_a_rotation_nearby(rotation, disturbance):
    R = rotation_from_vector(rotation)
    nearest = nearest_rotation(R + disturbance)
    assert is_rotation(nearest)
    assert rotation_angle(nearest, R) < 0.05


def test_scaled_mirrored_and_broken_matrices_are_no_rotations():
    assert is_rotation(np.eye(3))
    assert not is_rotation(1.01 * np.eye(3))
    assert not is_rotation(np.diag([1.0, 1.0, -1.0]))
    assert not is_rotation(np.full((3, 3), np.nan))
    assert not is_rotation(np.eye(4))
