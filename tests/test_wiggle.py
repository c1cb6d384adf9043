"""One joint at a time turned by a degree: what should be seen is told, and what was seen is judged."""

from __future__ import annotations

import numpy as np
import pytest

from dualcal_hal.transforms import inverse, rotation_from_vector, transform
from procedures.commissioning.wiggle import STEP, Outcome, expected_motions, judge, turned, words
from procedures.planning.model import CellModel
from tests.cells import paper_cell

FILE = paper_cell()
MODEL = CellModel(FILE.cell)
TRUTH = FILE.simulation.truth
STAND_OFF = np.deg2rad([[24, 38, -14, -44, 57, 40], [-27, 44, -16, 51, 53, -132]])
HOME = MODEL.active.home
ARMS = (MODEL.active.name, MODEL.passive.name)


def target_in_camera(q_a, q_p):
    """As it truly is."""
    camera = TRUTH.T_P_A @ MODEL.active.chain.forward(q_a) @ TRUTH.T_H_E
    return inverse(camera) @ MODEL.passive.chain.forward(q_p) @ MODEL.T_F_T


def true_motion(arm, joint, by, q=STAND_OFF):
    before, after = target_in_camera(*q), None
    moved = q.copy()
    moved[ARMS.index(arm), joint] += by
    after = target_in_camera(*moved)
    return MODEL.project_board(after) - MODEL.project_board(before)


def postures(count):
    """Near the stand-off, with the target in view."""
    rng = np.random.default_rng(4)
    found = []
    while len(found) < count:
        q = STAND_OFF + rng.uniform(-0.15, 0.15, STAND_OFF.shape)
        if MODEL.in_view(target_in_camera(*q)):
            found.append(q)
    return found


def judged(arm, joint, motion, q=STAND_OFF):
    expected = expected_motions(MODEL, arm, q[ARMS.index(arm)], target_in_camera(*q))
    return judge(motion, expected, joint)


@pytest.mark.parametrize("arm", ARMS)
def test_what_turns_as_it_should_is_proven_or_left_to_the_operator_never_called_wrong(arm):
    """With the true transforms as far from the nominal ones as the paper found them."""
    outcomes = [
        judged(arm, joint, true_motion(arm, joint, STEP, q), q).outcome for q in postures(8) for joint in range(6)
    ]
    assert Outcome.WRONG not in outcomes
    assert outcomes.count(Outcome.PROVEN) > len(outcomes) / 2


@pytest.mark.parametrize("arm", ARMS)
def test_what_turns_the_other_way_is_never_proven_and_its_sign_is_named(arm):
    seen = [judged(arm, joint, true_motion(arm, joint, -STEP, q), q) for q in postures(8) for joint in range(6)]
    assert Outcome.PROVEN not in [each.outcome for each in seen]
    wrong = [each for each in seen if each.outcome is Outcome.WRONG]
    assert len(wrong) > len(seen) / 2
    assert any("its sign is wrong" in each.said for each in wrong)


@pytest.mark.parametrize("arm", ARMS)
def test_another_joint_that_turns_in_its_place_is_never_proven_and_the_order_is_named(arm):
    seen = {
        (asked, other): judged(arm, asked, true_motion(arm, other, STEP, q), q)
        for q in postures(4)
        for asked in range(6)
        for other in range(6)
        if asked != other
    }
    assert Outcome.PROVEN not in [each.outcome for each in seen.values()]
    assert "joint 5 turn in its place: the order of the joints is wrong" in seen[0, 4].said


def test_a_target_that_stands_still_says_that_the_joint_did_not_turn():
    seen = judged("left", 0, np.zeros((9, 2)))
    assert seen.outcome is Outcome.WRONG
    assert "did not turn" in seen.said


def test_corners_that_were_not_seen_do_not_count():
    motion = true_motion("left", 0, STEP)
    motion[4:] = np.nan
    assert judged("left", 0, motion).outcome is not Outcome.WRONG
    assert judged("left", 0, np.full((9, 2), np.nan)).outcome is Outcome.OPEN


def test_a_motion_that_no_joint_makes_is_left_to_the_operator():
    assert judged("left", 0, 3 * true_motion("left", 0, STEP)).outcome is Outcome.OPEN


def test_a_joint_at_its_upper_limit_is_turned_down():
    lower, upper = np.full(6, -1.0), np.full(6, 1.0)
    q = np.array([0.0, 0.995, -0.995, 0, 0, 0])
    assert turned(q, 0, lower, upper)[0] == pytest.approx(STEP)
    assert turned(q, 1, lower, upper)[1] == pytest.approx(0.995 - STEP)
    assert turned(q, 2, lower, upper)[2] == pytest.approx(-0.995 + STEP)


def told(joint, by=STEP, q=HOME, carried=None):
    goal = q.copy()
    goal[joint] += by
    return words(MODEL.active.chain, q, goal, np.eye(4) if carried is None else carried, "its camera")


def test_the_direction_is_told_as_a_person_sees_it():
    """Joint 1 turns counter-clockwise from above: to the left for one who stands behind the base."""
    assert "its flange moves to the left by 4.9 mm" in told(0)
    assert "its flange moves to the right by 4.9 mm" in told(0, -STEP)
    assert "its flange moves inward by 11.8 mm" in told(1)
    assert "its flange moves up by 2.2 mm and inward by 1.0 mm" in told(4)


def test_left_stays_left_wherever_the_arm_points_to():
    for turn in (-2.0, -1.0, 1.0, 2.5):
        q = HOME.copy()
        q[0] = turn
        assert "to the left by 4.9 mm" in told(0, q=q)


def test_what_the_pendant_shows_is_told_in_the_base():
    T, T_after = (MODEL.active.chain.forward(q) for q in (HOME, HOME + STEP * np.eye(6)[1]))
    x, y, z = 1e3 * (T_after - T)[:3, 3]
    assert f"X Y Z change by {x:+.1f} {y:+.1f} {z:+.1f} mm" in told(1)


def test_a_flange_that_turns_on_the_spot_is_told_by_its_spin_and_what_it_carries():
    camera = transform(rotation_from_vector([0, 0, 0]), [0.2, 0.1, 0.0])
    assert "its camera moves" in told(5, carried=camera)
    assert "the flange turns counter-clockwise for one who looks at its face" in told(5)
    assert "the flange turns clockwise" in told(5, -STEP)
