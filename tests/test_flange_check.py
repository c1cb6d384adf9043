"""The flange check: each thing that may be wrong is named, what is right is not, and what is not proven is said."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualcal_hal.errors import UsageError
from dualcal_hal.kinematics import Chain, Row
from dualcal_hal.transforms import rotation_angle, rotation_from_vector
from procedures.commissioning import Tolerance, check_flange
from procedures.commissioning.causes import Kind
from procedures.commissioning.readout import FORMS, numbers_of, pose_of
from tests.cells import paper_cell
from tools.benchmarks.flange import cases, controllers_model, named_rightly, posed, readout

CELL = paper_cell().cell
ARM = CELL.active
DEG = np.deg2rad(1.0)
POSES = np.deg2rad([[10, -40, 50, 30, 40, 60], [-35, 20, 80, -40, -60, -100], [60, 35, -25, 75, 70, 20]])


@pytest.fixture
def shown():
    """What a pendant shows of a controller whose model differs a little."""
    return readout(controllers_model(ARM.chain, np.random.default_rng(5)).forward(POSES), 1)


def check(q, flange, **tolerance):
    return check_flange(ARM.chain, np.asarray(q), flange, Tolerance(**tolerance) if tolerance else None)


def with_joint(joint, angles):
    q = POSES.copy()
    q[:, joint - 1] = angles
    return q


@pytest.mark.parametrize("name", [case.name for case in cases(np.random.default_rng(0))])
def test_on_both_arms_each_fault_is_named_through_a_rounded_readout_of_another_model(name):
    for seed, robot in enumerate(CELL.robots.values()):
        rng = np.random.default_rng(seed)
        case = next(case for case in cases(rng) if case.name == name)
        assert named_rightly(case, robot, 3, 1, rng) == "right"


def test_of_what_is_right_the_deviation_is_told_and_no_cause(shown):
    found = check(POSES, shown)
    assert found.good
    assert found.agrees
    assert found.cause is None
    assert 0 < found.deviation.translation.max() < 3e-3


def test_the_tolerance_is_what_is_asked_for(shown):
    assert check(POSES, shown).usual
    assert not check(POSES, shown, translation=1e-5).agrees
    assert not check(POSES, shown, rotation=1e-5).agrees


def test_up_to_twice_the_tolerance_models_differ_and_no_joint_is_mistaken(shown):
    largest = check(POSES, shown).deviation.translation.max()
    found = check(POSES, shown, translation=0.7 * largest)
    assert found.good
    assert not found.usual
    assert not check(POSES, shown, translation=0.4 * largest).agrees


def test_a_zero_is_told_with_its_joint_and_amount_and_the_change_of_its_offset(shown):
    cause = check(with_joint(3, POSES[:, 2] - 5 * DEG), shown).cause
    assert (cause.kind, cause.joints) == (Kind.ZERO, (3,))
    assert "the joint stands +5.0" in cause.what or "the joint stands +4.9" in cause.what
    assert "offset_deg by -" in cause.advice


@pytest.mark.parametrize("factor", [1, -1])
def test_a_coupling_is_told_as_the_cell_file_takes_it(shown, factor):
    """The controller's J3 is ours plus the factor times J2, and nobody told the joint map."""
    cause = check(with_joint(3, POSES[:, 2] + factor * POSES[:, 1]), shown).cause
    assert (cause.kind, cause.joints) == (Kind.COUPLING, (3, 2))
    given_factor = float(cause.advice.partition("factor: ")[2].partition("}")[0])
    assert given_factor == pytest.approx(factor, abs=0.02)
    assert "{joint: 3, from_joint: 2," in cause.advice


def test_a_coupling_of_joints_whose_zeros_are_elsewhere_is_still_a_coupling(shown):
    cause = check(with_joint(3, POSES[:, 2] + POSES[:, 1] + np.pi / 2), shown).cause
    assert (cause.kind, cause.joints) == (Kind.COUPLING, (3, 2))


def test_an_order_is_told_as_the_cell_file_takes_it(shown):
    order = [2, 0, 1, 3, 4, 5]  # of the controller's joints the first is our third
    cause = check(POSES[:, order], shown).cause
    assert (cause.kind, cause.joints) == (Kind.ORDER, (1, 2, 3))
    assert "[3, 1, 2, 4, 5, 6]" in cause.advice


def test_zeros_of_several_joints_are_told_together(shown):
    cause = check(POSES - DEG * np.array([0, 12, -7, 0, 20, 0]), shown).cause
    assert (cause.kind, cause.joints) == (Kind.ZERO, (2, 3, 5))
    assert "joint 2 +1" in cause.what


def test_a_zero_of_the_last_joint_may_as_well_be_a_turned_flange(shown):
    found = check(with_joint(6, POSES[:, 5] - 90 * DEG), shown)
    assert (found.cause.kind, found.cause.joints) == (Kind.ZERO, (6,))


@pytest.mark.parametrize(("typed_as", "shown_as"), [("kuka", "fanuc"), ("fanuc", "kuka")])
def test_an_orientation_in_another_form_than_was_said_is_named(typed_as, shown_as):
    T = ARM.chain.forward(POSES)
    typed = np.stack([pose_of(typed_as, numbers_as(shown_as, pose)) for pose in T])
    assert check(POSES, typed).cause.kind is Kind.CONVENTION


def test_of_two_things_wrong_at_once_none_is_named_that_does_not_explain_them(shown):
    q = with_joint(3, -POSES[:, 2])
    q[:, 4] += 0.4
    wrong = shown.copy()
    wrong[1, :3, 3] += 0.25
    found = check(q, wrong)
    assert not found.agrees
    assert found.cause is None


# What is not proven


def test_a_joint_that_never_left_zero_has_no_sign_that_was_seen():
    q = with_joint(4, 0.0)
    found = check(q, ARM.chain.forward(q))
    assert found.agrees
    assert not found.good
    assert any("the sign of joint 4" in what for what in found.unproven)


def test_a_joint_that_stood_still_may_turn_either_way_about_where_it_stood():
    q = with_joint(5, 0.7)
    found = check(q, ARM.chain.forward(q))
    assert [what.partition(":")[0] for what in found.unproven] == ["the sign of joint 5"]


def test_joints_that_always_stood_alike_may_be_exchanged():
    q = with_joint(2, POSES[:, 2])
    found = check(q, ARM.chain.forward(q))
    assert any("which of joints 2 and 3" in what for what in found.unproven)


def test_a_coupling_is_not_seen_where_joint_2_stands_at_zero():
    q = with_joint(2, [0.0, 0.001, 0.0])
    assert any("coupled" in what for what in check(q, ARM.chain.forward(q)).unproven)


def test_good_poses_of_any_posture_prove_all():
    rng = np.random.default_rng(3)
    for _ in range(20):
        q = posed(ARM, 3, rng)
        assert check(q, ARM.chain.forward(q)).good


def test_two_poses_are_too_few():
    with pytest.raises(UsageError, match="2 poses of the flange; at least 3"):
        check(POSES[:2], ARM.chain.forward(POSES[:2]))


def test_it_works_for_an_arm_of_seven_joints_and_one_of_two():
    rows = tuple(Row(0.0, 0.2 if i % 2 else 0.0, 0.05, np.pi / 2 * (-1) ** i) for i in range(7))
    q = np.random.default_rng(1).uniform(-1, 1, (3, 7))
    for n in (7, 2):
        chain = Chain(rows[:n])
        wrong = q[:, :n].copy()
        wrong[:, 1] *= -1
        cause = check_flange(chain, wrong, chain.forward(q[:, :n])).cause
        assert (cause.kind, cause.joints) == (Kind.SIGN, (2,))


# Readouts


def numbers_as(form, T):
    """As a pendant of that kind shows a pose: x y z and three angles, mm and deg."""
    R = T[:3, :3]
    wpr = np.degrees([np.arctan2(R[2, 1], R[2, 2]), -np.arcsin(R[2, 0]), np.arctan2(R[1, 0], R[0, 0])])
    return [*(1e3 * T[:3, 3]), *(wpr[::-1] if form == "kuka" else wpr)]


angles = st.floats(-89, 89)


@settings(max_examples=50, deadline=None)
@given(angles, angles, angles)
def test_w_p_r_turn_about_fixed_axes_and_a_b_c_about_moving_ones_in_the_opposite_order(w, p, r):
    about_x, about_y, about_z = (rotation_from_vector(np.radians(v)) for v in ([w, 0, 0], [0, p, 0], [0, 0, r]))
    expected = about_z @ about_y @ about_x
    for form, numbers in (("fanuc", [w, p, r]), ("motoman", [w, p, r]), ("kuka", [r, p, w])):
        T = pose_of(form, [0, 0, 0, *numbers])
        assert rotation_angle(T[:3, :3], expected) < 1e-9


def test_abb_s_quaternion_begins_with_its_scalar_and_is_normalised():
    T = pose_of("abb", [100, 200, 300, 0.7071, 0.0, 0.7071, 0.0])
    np.testing.assert_allclose(T[:3, :3], rotation_from_vector([0, np.pi / 2, 0]), atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], [0.1, 0.2, 0.3])


def test_a_rotation_vector_is_axis_times_degrees():
    T = pose_of("rotation-vector", [0, 0, 0, 0, 0, 90])
    np.testing.assert_allclose(T[:3, 0], [0, 1, 0], atol=1e-12)


def test_each_form_says_what_is_to_be_typed():
    assert numbers_of("abb") == ("x", "y", "z", "q1", "q2", "q3", "q4")
    assert {form: len(numbers_of(form)) for form in FORMS} == {
        "rotation-vector": 6,
        "abb": 7,
        "fanuc": 6,
        "kuka": 6,
        "motoman": 6,
    }


@pytest.mark.parametrize(
    ("form", "numbers", "words"),
    [
        ("fanuc", [1, 2, 3, 4, 5], "5 numbers where x y z W P R are needed"),
        ("abb", [1, 2, 3, 4, 5, 6, 7], "a quaternion has length 1, and this one 11.225"),
        ("abb", [1, 2, 3, 0, 0, 0, 0], "a quaternion has length 1"),
        ("kuka", [1, 2, float("nan"), 0, 0, 0], "not finite"),
    ],
)
def test_numbers_that_are_no_pose_are_refused(form, numbers, words):
    with pytest.raises(ValueError, match=words):
        pose_of(form, numbers)
