"""The controller's joints and those of the kinematics: there and back, whatever the map."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pydantic import ValidationError

from backends.controller.joint_map import Coupling, JointMap, JointMapConfig

JOINTS = 6
ANGLES = arrays(float, (3, JOINTS), elements=st.floats(-6.5, 6.5))


@st.composite
def configs(draw):
    pairs = draw(st.lists(st.permutations(range(1, JOINTS + 1)).map(lambda p: p[:2]), max_size=3))
    coupling = [Coupling(joint=a, from_joint=b, factor=draw(st.floats(-2, 2))) for a, b in pairs]
    return JointMapConfig(
        order=tuple(draw(st.permutations(range(1, JOINTS + 1)))),
        sign=tuple(draw(st.lists(st.sampled_from([-1.0, 1.0]), min_size=JOINTS, max_size=JOINTS))),
        offset_deg=tuple(draw(st.lists(st.floats(-180, 180), min_size=JOINTS, max_size=JOINTS))),
        coupling=tuple(coupling),
    )


@given(configs(), ANGLES)
def test_angles_go_to_the_controller_and_back(config, q):
    joint_map = JointMap(config, JOINTS)
    np.testing.assert_allclose(joint_map.from_controller(joint_map.to_controller(q)), q, atol=1e-9)
    np.testing.assert_allclose(joint_map.velocity_from_controller(joint_map.velocity_to_controller(q)), q, atol=1e-9)


@given(configs(), ANGLES, ANGLES)
def test_velocities_are_the_change_of_angles(config, q, v):
    joint_map = JointMap(config, JOINTS)
    change = joint_map.to_controller(q + v) - joint_map.to_controller(q)
    np.testing.assert_allclose(joint_map.velocity_to_controller(v), change, atol=1e-9)


def test_order_says_for_each_joint_of_the_controller_which_it_is():
    q = np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(JointMap(JointMapConfig(order=(3, 1, 2)), 3).to_controller(q), [0.3, 0.1, 0.2])


def test_sign_and_offset_are_the_controllers():
    config = JointMapConfig(sign=(1, -1, 1), offset_deg=(0, 90, 0))
    q = np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(JointMap(config, 3).to_controller(q), [0.1, np.pi / 2 - 0.2, 0.3])


def test_joint_3_takes_joint_2_along_as_fanucs_and_abbs_controllers_have_it():
    config = JointMapConfig(coupling=(Coupling(joint=3, from_joint=2, factor=-1),))
    q = np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(JointMap(config, 3).to_controller(q), [0.1, 0.2, 0.1])


def test_without_a_map_the_joints_are_the_same():
    q = np.array([0.1, 0.2, 0.3])
    np.testing.assert_array_equal(JointMap(None, 3).to_controller(q), q)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"order": (1, 1, 2)}, "each joint once"),
        ({"sign": (1, 0.5, 1)}, "1 or -1"),
        ({"coupling": [{"joint": 2, "from_joint": 2, "factor": 1}]}, "cannot take itself along"),
        ({"ordr": (1, 2, 3)}, "ordr"),
    ],
)
def test_what_is_no_map_is_refused(wrong, words):
    with pytest.raises(ValidationError, match=words):
        JointMapConfig.model_validate(wrong)


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (JointMapConfig(order=(2, 1)), "order must have 3 entries"),
        (JointMapConfig(sign=(1, 1)), "sign must have 3 entries"),
        (JointMapConfig(coupling=(Coupling(joint=3, from_joint=4, factor=1),)), "there is no joint 4"),
    ],
)
def test_a_map_of_another_arm_is_refused(config, words):
    with pytest.raises(ValueError, match=words):
        JointMap(config, 3)
