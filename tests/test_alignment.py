"""Alignment: where the axis is expected, how the servo steps, and which tolerance makes sense."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from backends.simulator.rendering import Renderer
from dualcal_hal.camera import Frame
from dualcal_hal.errors import ArmMoved, UsageError
from dualcal_hal.robot import Mode, RobotState
from dualcal_hal.transforms import inverse, rotation_from_vector, transform
from procedures.alignment import (
    LONGEST_STEP,
    Aligner,
    AxisTrack,
    Outcome,
    Servo,
    largest_alignment_error,
    point_on_axis,
    target_on_axis,
    tolerance_px,
)
from procedures.analysis.paper import FARTHEST_ALIGNED
from procedures.calibrate import requests_of
from procedures.detection import Detector
from procedures.planning.belief import Belief
from procedures.planning.model import CellModel
from procedures.planning.poses import PosePlanner
from procedures.planning.refine import arrival_scatter
from procedures.planning.ways import WayFinder
from procedures.steps import ArmReading, Look, Mark, Move, Read, Readings, Sighting, Work
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


# -- a point ---------------------------------------------------------------------------------------


class Cell:
    """Answers an aligner's steps: arms arrive where they are sent, the camera sees what the truth says."""

    def __init__(self, model, plan, truth):
        self.model, self.truth = model, truth
        self.constraint = plan.constraints[0]
        self.at = {model.active.name: self.constraint.active, model.passive.name: self.constraint.positions[0].passive}
        self.renderer = Renderer(model.board, 0.01, model.intrinsics, 0.6)
        self.moves, self.shaken, self.hidden = [], 0, False

    def align(self, tolerance=0.1, belief=None, servo=None):
        belief = belief or self.model.nominal.as_if_looked()
        ways = WayFinder(self.model, belief, [self.model.home])
        detector = Detector(self.model.board, self.model.intrinsics.size)
        self.aligner = aligner = Aligner(self.model, belief, ways, detector, tolerance)
        aligner.go_on_with(servo)
        camera = self.model.camera_in_passive(self.constraint.active, belief)
        planned = self.constraint.positions[0]
        goal = target_on_axis(self.model, AxisTrack(camera, 0.01, 1e-5), planned.passive, planned.distance)
        procedure = aligner.align(self.constraint.active, planned.passive, goal, camera)
        try:
            step = next(procedure)
            while True:
                try:
                    reply = self.answer(step)
                except ArmMoved as moved:
                    step = procedure.throw(moved)
                else:
                    step = procedure.send(reply)
        except StopIteration as end:
            return end.value

    def answer(self, step):
        match step:
            case Read():
                return Readings(*(ArmReading(self.state(q), q) for q in self.at.values()))
            case Move(arm, (goal,)):
                self.moves.append(arm)
                self.at[arm] = goal
                return self.state(goal)
            case Look():
                if self.shaken:
                    self.shaken -= 1
                    raise ArmMoved("right", "take a picture", "a joint moved")
                return Sighting(Frame(self.image(), 0.0, 1), *self.at.values(), 1)
            case Work():
                return step.body()
            case Mark():
                return None
        pytest.fail(f"an unexpected step {step}")

    def state(self, q):
        return RobotState(q, (0.0,) * 6, Mode.READY, (), 0.0, 1)

    def image(self):
        q_a, q_p = self.at.values()
        T_E_T = inverse(self.model.camera_in_passive(q_a, self.truth)) @ self.model.target_in_passive(q_p)
        grey = np.full((768, 1024), 128.0) if self.hidden else self.renderer.render(T_E_T)
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def turned(belief, base=(0, 0, 0), camera=(0, 0, 0), shift=(0, 0, 0)):
    """A belief with its base turned and shifted and its camera turned, by rotation vectors in rad and m."""
    base_error, camera_error = transform(rotation_from_vector(base), shift), rotation_from_vector(camera)
    T_H_E = belief.T_H_E @ transform(camera_error, [0, 0, 0])
    return Belief(belief.T_P_A @ base_error, T_H_E, belief.covariance, "a test", belief.placement)


@pytest.fixture(scope="module")
def plan():
    cell = paper_cell("procedure.constraints=3", "procedure.verification.constraints=0").cell
    model = CellModel(cell)
    belief = model.nominal.as_if_looked()
    ways = WayFinder(model, belief, [model.home])
    return PosePlanner(model, belief, ways, [1]).plan(requests_of(cell.procedure), model.home, provisional=False)


@pytest.fixture
def model():
    return CellModel(paper_cell().cell)


def test_a_point_that_is_where_it_should_be_needs_one_picture_and_no_move(model, plan):
    cell = Cell(model, plan, model.nominal)
    found = cell.align()
    assert (found.outcome, found.frames, cell.moves) == (Outcome.ALIGNED, 1, [])


def test_a_point_off_the_axis_is_brought_onto_it_by_the_passive_arm_alone(model, plan):
    cell = Cell(model, plan, turned(model.nominal, base=(0.01, -0.02, 0.01), shift=(0.01, 0.0, -0.01)))
    orientation = model.target_in_passive(cell.at["right"])[:3, :3]
    found = cell.align()
    assert found.outcome is Outcome.ALIGNED
    assert 1 < found.frames <= 4
    assert set(cell.moves) == {"right"}
    assert np.max(np.abs(found.offset)) <= 0.1
    np.testing.assert_allclose(model.target_in_passive(cell.at["right"])[:3, :3], orientation, atol=1e-9)


def sure(belief):
    """The same belief, held with more confidence than a picture can shake."""
    return Belief(belief.T_P_A, belief.T_H_E, belief.covariance * 1e-8, "a test", belief.placement)


ROLL = 0.55  # rad; without corrections to the Jacobian an offset would shrink by half with each picture


def rolled_and_shifted(model):
    """A camera that is rolled, and a base that is off by as much as there is room for."""
    return turned(model.nominal, camera=(0, 0, ROLL), shift=(0.0, 0.012, 0.008))


def test_a_wrong_jacobian_is_corrected_while_moving(model, plan):
    found = Cell(model, plan, rolled_and_shifted(model)).align(belief=sure(model.nominal))
    assert found.outcome is Outcome.ALIGNED
    assert found.frames <= 7


def test_from_an_unsure_belief_the_jacobian_comes_from_the_boards_pose(model, plan):
    found = Cell(model, plan, rolled_and_shifted(model)).align()
    assert found.outcome is Outcome.ALIGNED
    assert found.frames <= 4


def test_the_jacobian_is_kept_along_the_constraint(model, plan):
    learned = Cell(model, plan, rolled_and_shifted(model))
    learned.align(belief=sure(model.nominal))
    again = Cell(model, plan, rolled_and_shifted(model))
    found = again.align(belief=sure(model.nominal), servo=learned.aligner.servo)
    assert found.frames <= 3


def test_a_constraint_goes_on_with_what_its_last_position_has_learned(model, plan):
    aligner = Aligner(model, model.nominal, None, None, 0.1)
    for learned in ([[1.0, 0.1], [0.0, 1.0]], [[0.9, 0.1], [0.0, 1.0]]):
        aligner.go_on_with(Servo(np.eye(2), np.array(learned)))
    aligner.go_on_with(None)  # a position that needed no correction
    np.testing.assert_array_equal(aligner.servo.first, np.eye(2))
    np.testing.assert_array_equal(aligner.servo.jacobian, [[0.9, 0.1], [0.0, 1.0]])


def test_a_target_that_is_not_seen_is_lost(model, plan):
    cell = Cell(model, plan, model.nominal)
    cell.hidden = True
    found = cell.align()
    assert (found.outcome, found.captured) == (Outcome.LOST, False)
    assert "not found" in found.reason


def test_a_shaken_picture_is_taken_again(model, plan):
    cell = Cell(model, plan, model.nominal)
    cell.shaken = 2
    found = cell.align()
    assert (found.outcome, found.frames) == (Outcome.ALIGNED, 3)


def test_an_arm_that_never_rests_gives_no_capture(model, plan):
    cell = Cell(model, plan, model.nominal)
    cell.shaken = 10**6
    found = cell.align()
    assert (found.outcome, found.frames, found.captured) == (Outcome.NOT_CONVERGED, 12, False)
    assert "moved" in found.reason


def test_the_middle_corner_is_aligned_in_whatever_order_the_corners_are_read(model, plan):
    found = Cell(model, plan, turned(model.nominal, camera=(0, 0, np.pi / 4))).align()
    assert found.outcome is Outcome.ALIGNED
    assert not found.detection.order_known


def test_another_feature_point_is_lost_if_the_order_of_the_corners_is_not_known(plan):
    even = CellModel(paper_cell("target.corners=[4, 4]", "target.feature_corner=[1, 1]").cell)
    assert not even.board.feature_is_central
    found = Cell(even, plan, turned(even.nominal, camera=(0, 0, np.pi / 4))).align()
    assert found.outcome is Outcome.LOST
    assert "order" in found.reason


def test_a_point_that_stays_within_a_pixel_is_captured_and_marked(model, plan):
    cell = Cell(model, plan, turned(model.nominal, shift=(0.0, 0.0004, 0.0)))
    found = cell.align(tolerance=1e-7)
    assert (found.outcome, found.frames, found.captured) == (Outcome.NOT_CONVERGED, 12, True)


def test_a_point_out_of_the_arms_reach_says_so(model, plan):
    cell = Cell(model, plan, model.nominal)
    model.passive.upper[:] = np.array(cell.at["right"]) - 0.1
    found = cell.align()
    assert found.outcome is Outcome.OUT_OF_REACH
    assert not found.captured


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


def test_auto_follows_the_scatter_that_is_seen_where_it_is_larger_than_the_one_stated():
    model = CellModel(paper_cell().cell)
    stated = tolerance_px(model, "auto")
    shaky = [np.array([0.2, -0.2]), np.array([-0.2, 0.2])] * 10
    assert tolerance_px(model, "auto", shaky) == pytest.approx(2.8 * 1.4826 * 0.2)
    astray = [*shaky, np.array([50.0, 50.0])]
    assert tolerance_px(model, "auto", astray) == pytest.approx(2.8 * 1.4826 * 0.2)
    assert tolerance_px(model, "auto", [5 * offset for offset in shaky]) == FARTHEST_ALIGNED
    assert tolerance_px(model, "auto", shaky[:5]) == stated
    assert tolerance_px(model, "auto", [np.array([0.001, 0.001])] * 20) == stated
    assert tolerance_px(model, 0.1, shaky) == 0.1


def test_what_is_left_after_small_corrections_counts_as_an_arrivals_scatter(model, plan):
    near = Cell(model, plan, turned(model.nominal, shift=(0.0, 0.0008, 0.0))).align()
    assert [tuple(np.round(offset, 1) + 0.0) for offset in near.arrivals] == [(0.0, 0.0)]
    far = Cell(model, plan, turned(model.nominal, shift=(0.0, 0.02, 0.0))).align()
    assert len(far.arrivals) == far.frames - 2


def test_the_papers_alignment_error_is_its_own():
    assert largest_alignment_error(CellModel(paper_cell().cell), 0.1) == pytest.approx(0.087e-3, abs=0.0005e-3)


def test_a_hidden_feature_point_is_lost_though_the_rest_of_the_target_is_seen(plan):
    charuco = CellModel(
        paper_cell(
            "target={kind: charuco, corners: [4, 4], feature_corner: [1, 1], square_mm: 25, marker_mm: 18,"
            " dictionary: DICT_4X4_50}"
        ).cell
    )
    cell = Cell(charuco, plan, charuco.nominal)
    assert cell.align().outcome is Outcome.ALIGNED
    draw = cell.image

    def with_something_in_the_middle():
        image = draw()
        image[374:394, 502:522] = 120
        return image

    cell.image = with_something_in_the_middle
    found = cell.align()
    assert found.outcome is Outcome.LOST
    assert "occluded: the feature point" in found.reason
