"""Alignment: where the axis is expected, how the servo steps, and which tolerance makes sense."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dualcal_hal.errors import UsageError
from dualcal_hal.transforms import rotation_from_vector, transform
from procedures.alignment import (
    LONGEST_STEP,
    AxisTrack,
    Servo,
    largest_alignment_error,
    point_on_axis,
    tolerance_px,
)
from procedures.planning.model import CellModel
from procedures.planning.refine import arrival_scatter
from tests.cells import paper_cell

T_P_E = transform(rotation_from_vector([0.3, -0.5, 0.8]), [0.4, -0.1, 0.6])
vectors = arrays(float, 2, elements=st.floats(-0.05, 0.05))


def on_line(T, lateral, slope, z):
    """A point at depth z on a line that is off by ``lateral`` and leans by ``slope`` against the camera's axis."""
    return T[:3, 3] + T[:3, :3] @ [*(np.asarray(lateral) + np.asarray(slope) * z), z]


# -- the axis --------------------------------------------------------------------------------------


def test_without_aligned_points_the_axis_is_the_believed_one():
    track = AxisTrack(T_P_E, 0.01, 1e-5)
    np.testing.assert_allclose(track.at(0.4), T_P_E[:3, 3] + 0.4 * T_P_E[:3, 2])


@given(vectors)
def test_one_point_shifts_the_axis_parallel(lateral):
    track = AxisTrack(T_P_E, 0.01, 1e-5)
    track.add(on_line(T_P_E, lateral, [0, 0], 0.5))
    np.testing.assert_allclose(track.at(0.3), on_line(T_P_E, lateral, [0, 0], 0.3), atol=1e-12)


@given(vectors, vectors)
def test_two_points_give_the_line_where_its_direction_was_hardly_known(lateral, slope):
    track = AxisTrack(T_P_E, 0.2, 1e-5)
    track.add(on_line(T_P_E, lateral, slope, 0.5))
    track.add(on_line(T_P_E, lateral, slope, 0.43))
    np.testing.assert_allclose(track.at(0.3), on_line(T_P_E, lateral, slope, 0.3), atol=1e-5)


def test_a_direction_known_better_than_the_points_can_tell_is_kept():
    track = AxisTrack(T_P_E, 1e-5, 1e-4)
    track.add(on_line(T_P_E, [0, 0], [0, 0], 0.5))
    track.add(on_line(T_P_E, [2e-4, 0], [0, 0], 0.45))
    np.testing.assert_allclose(track.at(0.3), on_line(T_P_E, [1e-4, 0], [0, 0], 0.3), atol=1e-6)


def test_a_features_offset_in_the_image_is_taken_off_to_find_the_axis():
    model = CellModel(paper_cell().cell)
    passive = tuple(model.home.passive)
    feature_point = model.target_in_passive(passive)[:3, 3]
    beside = feature_point - T_P_E[:3, :3] @ [0.002, -0.001, 0.4]
    camera = transform(T_P_E[:3, :3], beside)
    seen = model.intrinsics.principal_point + 812 * np.array([0.002, -0.001]) / 0.4
    np.testing.assert_allclose(
        point_on_axis(model, passive, seen, camera), camera[:3, 3] + 0.4 * camera[:3, 2], atol=1e-9
    )


# -- the servo -------------------------------------------------------------------------------------


@given(vectors)
def test_with_the_right_jacobian_one_step_takes_the_offset_away(lateral):
    turn = rotation_from_vector([0, 0, 0.3])[:2, :2]
    np.testing.assert_allclose(turn @ Servo(turn).step(lateral), -lateral, atol=1e-12)


@given(st.floats(-0.6, 0.6), vectors)
def test_steps_with_a_wrong_jacobian_converge_by_what_they_teach(roll, lateral):
    truth = 1.1 * rotation_from_vector([0, 0, roll])[:2, :2]
    servo = Servo(np.eye(2))
    for _ in range(8):
        shift = servo.step(lateral)
        change = truth @ shift
        servo.learn(shift, change)
        lateral = lateral + change
    assert np.linalg.norm(lateral) < 1e-6


def test_a_step_of_zero_teaches_nothing():
    servo = Servo(np.eye(2))
    servo.learn(np.zeros(2), np.array([0.001, 0.0]))
    np.testing.assert_array_equal(servo.jacobian, np.eye(2))


def test_a_step_is_never_longer_than_the_longest():
    assert np.linalg.norm(Servo(np.eye(2)).step(np.array([5.0, 5.0]))) == pytest.approx(LONGEST_STEP)


def test_a_jacobian_that_has_become_singular_is_given_up_for_the_first_one():
    servo = Servo(np.eye(2))
    servo.learn(np.array([0.01, 0.0]), np.array([0.0, 0.0]))
    np.testing.assert_allclose(servo.step(np.array([0.01, 0.02])), [-0.01, -0.02])


# -- the tolerance ---------------------------------------------------------------------------------


def test_the_scatter_of_arrivals_is_that_of_the_joints_noise_seen_by_the_camera():
    model = CellModel(paper_cell().cell)
    arm, rng = model.passive, np.random.default_rng(1)
    q = np.array(model.home.passive)
    noise = rng.normal(0, arm.joint_sigma, (4000, 6))
    moved = model.target_in_passive(q + noise)[:, :3, 3] - model.target_in_passive(q)[:3, 3]
    at_home = 812 / 0.4 * np.sqrt(np.mean(np.sum(moved**2, axis=1)) / 3)
    assert arrival_scatter(model) == pytest.approx(at_home, rel=0.35)


def test_scatter_follows_the_joints_noise():
    assert arrival_scatter(CellModel(paper_cell("robots.right.joint_sigma_mrad=0").cell)) == 0.0
    once = arrival_scatter(CellModel(paper_cell().cell))
    assert arrival_scatter(CellModel(paper_cell("robots.right.joint_sigma_mrad=0.06").cell)) == pytest.approx(2 * once)


def test_a_tolerance_below_twice_the_scatter_is_refused_with_the_number():
    model = CellModel(paper_cell("robots.right.joint_sigma_mrad=0.1").cell)
    with pytest.raises(UsageError, match=rf"below twice the scatter of arrivals, {2 * arrival_scatter(model):.3f} px"):
        tolerance_px(model, 0.1)


def test_the_papers_tolerance_is_accepted_and_auto_follows_the_scatter():
    model = CellModel(paper_cell().cell)
    assert tolerance_px(model, 0.1) == 0.1
    shakier = CellModel(paper_cell("robots.right.joint_sigma_mrad=0.1").cell)
    assert tolerance_px(shakier, "auto") == pytest.approx(tolerance_px(model, "auto") / 0.03 * 0.1)
    assert tolerance_px(shakier, "auto") > 2 * arrival_scatter(shakier)
    assert tolerance_px(CellModel(paper_cell("robots.right.joint_sigma_mrad=0").cell), "auto") > 0


def test_the_papers_alignment_error_is_its_own():
    assert largest_alignment_error(CellModel(paper_cell().cell), 0.1) == pytest.approx(0.087e-3, abs=0.0005e-3)
