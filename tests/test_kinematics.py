"""Forward kinematics, Jacobian and inverse, against pinocchio and against themselves."""

from __future__ import annotations

import numpy as np
import pinocchio
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dualcal_hal.kinematics import Chain, Row, pose_error, random_joints
from tests.reference_cell import ACTIVE, DOCUMENT, EXPECTED, PASSIVE

LOWER, UPPER = -np.full(6, 2.9), np.full(6, 2.9)
joints = arrays(float, 6, elements=st.floats(-2.8, 2.8))
angles = st.floats(-3.0, 3.0)
lengths = st.floats(-0.4, 0.4)
rows = st.builds(Row, angles, lengths, lengths, angles, st.none() | st.floats(-0.2, 0.2))


def pinocchio_model(chain: Chain) -> pinocchio.Model:
    """The chain as pinocchio sees it: a joint's placement is the constant part of the row before it."""
    model = pinocchio.Model()
    parent, placement = 0, pinocchio.SE3.Identity()
    for i, row in enumerate(chain.rows):
        turn = pinocchio.SE3(pinocchio.utils.rotate("z", row.theta), np.zeros(3))
        parent = model.addJoint(parent, pinocchio.JointModelRZ(), placement * turn, f"joint{i}")
        placement = (
            pinocchio.SE3(np.eye(3), np.array([0.0, 0.0, row.d]))
            * pinocchio.SE3(np.eye(3), np.array([row.a, 0.0, 0.0]))
            * pinocchio.SE3(pinocchio.utils.rotate("x", row.alpha), np.zeros(3))
            * pinocchio.SE3(pinocchio.utils.rotate("y", row.beta or 0.0), np.zeros(3))
        )
    model.addFrame(pinocchio.Frame("flange", parent, 0, placement, pinocchio.FrameType.OP_FRAME))
    return model


@settings(max_examples=50)
@given(st.lists(rows, min_size=1, max_size=8), st.data())
def test_forward_kinematics_and_jacobian_of_any_rows_are_those_of_pinocchio(some_rows, data):
    chain = Chain(tuple(some_rows))
    q = data.draw(arrays(float, chain.joints, elements=angles))
    model = pinocchio_model(chain)
    state = model.createData()
    pinocchio.framesForwardKinematics(model, state, q)
    flange = model.getFrameId("flange")
    np.testing.assert_allclose(chain.forward(q), state.oMf[flange].homogeneous, atol=1e-12)
    J = pinocchio.computeFrameJacobian(model, state, q, flange, pinocchio.LOCAL_WORLD_ALIGNED)
    np.testing.assert_allclose(chain.jacobian(q), J.reshape(6, chain.joints), atol=1e-12)


@pytest.mark.parametrize(
    ("chain", "key", "arm"),
    [
        (ACTIVE, "active_flange_in_active_base", "active_joints_rad"),
        (PASSIVE, "passive_flange_in_passive_base", "passive_joints_rad"),
    ],
)
def test_the_papers_arms_stand_where_the_reference_says(chain, key, arm):
    q = DOCUMENT["captures"][0][arm]
    np.testing.assert_allclose(chain.forward(q), EXPECTED["first_capture"][key], atol=1e-12)


def test_a_batch_is_the_same_as_its_poses_one_by_one():
    q = random_joints(np.random.default_rng(1), 6, LOWER, UPPER).reshape(2, 3, 6)
    batch = ACTIVE.forward(q)
    assert batch.shape == (2, 3, 4, 4)
    np.testing.assert_allclose(batch[1, 2], ACTIVE.forward(q[1, 2]), atol=1e-15)
    assert ACTIVE.frames(q).shape == (2, 3, 7, 4, 4)


def test_the_wrong_number_of_joints_is_refused():
    with pytest.raises(ValueError, match="expected 6 joint angles, got 5"):
        ACTIVE.forward(np.zeros(5))


@settings(max_examples=50)
@given(joints, arrays(float, 6, elements=st.floats(-0.1, 0.1)))
def test_the_inverse_finds_a_pose_from_a_start_nearby(q, away):
    start = np.clip(q + away, LOWER, UPPER)
    goal = ACTIVE.forward(q)
    found, reached = ACTIVE.inverse(goal, start, LOWER, UPPER)
    if not reached[0]:
        # Only near a singularity or a limit may a near start lead away.
        smallest = np.linalg.svd(ACTIVE.jacobian(q), compute_uv=False)[-1]
        assert smallest < 0.05 or np.any(np.abs(found) > 2.9) or np.max(np.abs(q)) > 2.7
        return
    np.testing.assert_allclose(ACTIVE.forward(found[0]), goal, atol=1e-9)


def test_restarts_find_nearly_every_reachable_pose():
    rng = np.random.default_rng(3)
    goals = PASSIVE.forward(random_joints(rng, 200, LOWER, UPPER))
    restarts = 12
    starts = random_joints(rng, 200 * restarts, LOWER, UPPER)
    found, reached = PASSIVE.inverse(np.repeat(goals, restarts, axis=0), starts, LOWER, UPPER)
    assert np.mean(np.any(reached.reshape(200, restarts), axis=1)) > 0.98
    error = pose_error(PASSIVE.forward(found[reached]), np.repeat(goals, restarts, axis=0)[reached])
    assert np.max(np.abs(error)) < 1e-9


def test_solutions_keep_the_limits_or_are_not_called_reached():
    rng = np.random.default_rng(4)
    goals = ACTIVE.forward(random_joints(rng, 300, LOWER, UPPER))
    tight = np.full(6, 1.5)
    found, reached = ACTIVE.inverse(goals, random_joints(rng, 300, -tight, tight), -tight, tight)
    assert 0 < np.sum(reached) < 300
    assert np.all(np.abs(found[reached]) <= 1.5)


def test_a_pose_out_of_reach_is_not_reached():
    goal = ACTIVE.forward(np.zeros(6))
    goal[:3, 3] *= 5.0
    assert not ACTIVE.inverse(goal, np.zeros(6), LOWER, UPPER)[1][0]
