"""Stand-off, looks, poses and ways keep every condition that a plan promises."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualcal_hal.errors import NoPlan
from dualcal_hal.geometry import interpolate
from dualcal_hal.transforms import inverse, rotation_from_vector, transform
from procedures.calibrate import requests_of
from procedures.planning.belief import Belief
from procedures.planning.first_look import find_stand_off, look_postures
from procedures.planning.model import CellModel, Posture
from procedures.planning.plan import Plan, turned_about_two_axes
from procedures.planning.poses import LEAST_TURN, ROOM, PosePlanner
from procedures.planning.ways import Leg, WayFinder
from tests.cells import paper_cell


@pytest.fixture(scope="module")
def cell():
    return paper_cell().cell


@pytest.fixture(scope="module")
def model(cell):
    return CellModel(cell)


@pytest.fixture(scope="module")
def ways(model):
    return WayFinder(model, model.nominal, [model.home])


@pytest.fixture(scope="module")
def stand_off(model, ways):
    return find_stand_off(model, model.nominal, ways, model.home, 1)


def made(cell, model, ways, start, seed=1):
    planner = PosePlanner(model, model.nominal, ways, [seed])
    return planner.plan(requests_of(cell.procedure), start, provisional=False)


@pytest.fixture(scope="module")
def plan(cell, model, ways, stand_off):
    return made(cell, model, ways, stand_off.posture)


def clear_of_everything(model, path_a, path_p, belief):
    """An independent walk: finer steps than the planner's, one configuration after the other."""
    geometry = model.geometry
    return min(
        float(geometry.clearance(a[None], p[None], belief.placement)[0]) for a, p in zip(path_a, path_p, strict=True)
    )


def walk(model, posture, legs):
    """Joint angles of both arms along legs in steps of 0.02 rad, and where they end."""
    path_a, path_p = [], []
    for leg in legs:
        if leg.arm == model.active.name:
            path = interpolate([posture.active, leg.goal], 0.02)
            path_a += list(path)
            path_p += [np.array(posture.passive)] * len(path)
            posture = Posture(leg.goal, posture.passive)
        else:
            path = interpolate([posture.passive, leg.goal], 0.02)
            path_p += list(path)
            path_a += [np.array(posture.active)] * len(path)
            posture = Posture(posture.active, leg.goal)
    return path_a, path_p, posture


def seen_from_camera(model, q_a, q_p, belief):
    return inverse(model.camera_in_passive(q_a, belief)) @ model.target_in_passive(q_p)


# -- stand-off and looks ---------------------------------------------------------------------------


def test_at_the_stand_off_the_board_faces_the_camera_in_view_and_far_from_it(model, stand_off):
    T_E_T = seen_from_camera(model, stand_off.posture.active, stand_off.posture.passive, model.nominal)
    assert model.in_view(T_E_T[None])[0]
    assert T_E_T[2, 2] == pytest.approx(-1.0, abs=1e-6)
    assert 0.4 < T_E_T[2, 3] < 0.9
    assert stand_off.clearance > 0.25


def test_the_way_to_the_stand_off_is_clear_and_ends_there(model, stand_off):
    path_a, path_p, end = walk(model, model.home, stand_off.way)
    assert end == stand_off.posture
    assert clear_of_everything(model, path_a, path_p, model.nominal) > model.margin - 0.002


def test_the_board_is_tilted_by_twenty_degrees_between_any_two_looks(model, ways, stand_off):
    normals = []
    for number in range(5):
        posture = next(look_postures(model, model.nominal, ways, stand_off.posture, number))
        normals.append(seen_from_camera(model, posture.active, posture.passive, model.nominal)[:3, 2])
    angles = [np.arccos(np.clip(a @ b, -1, 1)) for i, a in enumerate(normals) for b in normals[:i]]
    assert np.rad2deg(min(angles)) >= 20.0


def test_where_the_board_is_not_seen_the_camera_is_tilted_in_rings_and_the_passive_arm_stays(model, ways, stand_off):
    tried = list(look_postures(model, model.nominal, ways, stand_off.posture, 0))
    assert tried[0] == stand_off.posture
    assert len(tried) > 10
    at = model.camera_in_passive(stand_off.posture.active, model.nominal)
    for posture in tried[1:]:
        assert np.allclose(posture.passive, stand_off.posture.passive, atol=1e-9)
        camera = model.camera_in_passive(posture.active, model.nominal)
        np.testing.assert_allclose(camera[:3, 3], at[:3, 3], atol=1e-8)
        tilt = np.rad2deg(np.arccos(camera[:3, 2] @ at[:3, 2]))
        assert tilt == pytest.approx(12.0, abs=1e-3) or tilt == pytest.approx(20.0, abs=1e-3)


def test_bases_that_stand_above_each_other_have_no_stand_off(model, ways):
    above = model.nominal.T_P_A.copy()
    above[:3, 3] = [0.0, 0.0, 1.2]
    belief = Belief(above, model.nominal.T_H_E, model.nominal.covariance, "a test")
    with pytest.raises(NoPlan, match="above each other"):
        find_stand_off(model, belief, ways, model.home, 1)


# -- poses -----------------------------------------------------------------------------------------


def test_a_plan_has_the_constraints_and_positions_asked_for(plan):
    assert [len(c.positions) for c in plan.of("calibration")] == [4] * 7
    assert [len(c.positions) for c in plan.of("verification")] == [7] * 2
    assert len({c.name for c in plan.constraints}) == 9


def test_positions_lie_on_the_axis_from_the_farthest_to_the_nearest(model, plan):
    for constraint in plan.constraints:
        distances = [position.distance for position in constraint.positions]
        np.testing.assert_allclose(distances, np.linspace(0.5, 0.3, len(distances)), atol=1e-12)
        for position in constraint.positions:
            T_E_T = seen_from_camera(model, constraint.active, position.passive, model.nominal)
            np.testing.assert_allclose(T_E_T[:3, 3], [0, 0, position.distance], atol=1e-8)


def test_the_plate_is_tilted_within_the_angle_constraint_and_wholly_in_view(model, plan):
    for constraint in plan.constraints:
        for position in constraint.positions:
            T_E_T = seen_from_camera(model, constraint.active, position.passive, model.nominal)
            assert np.arccos(-T_E_T[2, 2]) == pytest.approx(position.tilt, abs=1e-9)
            assert position.tilt <= np.deg2rad(45) + 1e-9
            assert model.in_view(T_E_T[None])[0]


def test_every_posture_and_way_of_a_plan_keeps_limits_and_clearance(cell, model, ways, plan, stand_off):
    here = stand_off.posture
    for constraint in plan.constraints:
        for position in constraint.positions:
            goal = Posture(constraint.active, position.passive)
            way = ways.find(here, goal)
            assert way is not None
            path_a, path_p, here = walk(model, here, way)
            assert here == goal
            # The planner's coarser steps may overlook 1.3 mm between two of them.
            assert clear_of_everything(model, path_a, path_p, model.nominal) > model.margin - 0.0013
            assert np.all(np.array(goal.active) >= cell.active.lower)
            assert np.all(np.array(goal.active) <= cell.active.upper)
            assert np.all(np.array(goal.passive) >= cell.passive.lower)
            assert np.all(np.array(goal.passive) <= cell.passive.upper)


def test_the_passive_arm_has_room_to_move_each_way_in_the_camera_plane(model, plan):
    arm = model.passive
    for constraint in plan.constraints:
        camera = model.camera_in_passive(constraint.active, model.nominal)
        for position in constraint.positions:
            for direction in (camera[:3, 0], -camera[:3, 0], camera[:3, 1], -camera[:3, 1]):
                goal = model.target_in_passive(position.passive)
                goal[:3, 3] += ROOM * direction
                flange = goal @ inverse(model.T_F_T)
                q, reached = arm.chain.inverse(flange, [position.passive], arm.lower, arm.upper)
                assert reached[0]
                assert model.geometry.clearance([constraint.active], q, model.nominal.placement)[0] > 0.02


def test_flanges_are_turned_about_two_axes(model, plan):
    R = model.active.chain.forward([c.active for c in plan.of("calibration")])[:, :3, :3]
    assert turned_about_two_axes(R) >= LEAST_TURN


def test_orientations_not_turned_about_two_axes_are_no_plan(cell, model, ways, stand_off, monkeypatch):
    monkeypatch.setattr("procedures.planning.poses.turned_about_two_axes", lambda R: np.deg2rad(29.0))
    with pytest.raises(NoPlan, match="not turned by 30 degrees about two axes"):
        made(cell, model, ways, stand_off.posture)


def test_positions_without_a_clear_way_between_them_are_no_plan(cell, model, stand_off, monkeypatch):
    monkeypatch.setattr(WayFinder, "clear", lambda self, arm, start, waypoints: False)
    ways = WayFinder(model, model.nominal, [model.home])
    with pytest.raises(NoPlan, match=r"of 7.*the way between two positions is not clear: \d"):
        made(cell, model, ways, stand_off.posture)


def test_between_the_positions_of_a_constraint_the_passive_arm_goes_straight(model, plan):
    for constraint in plan.constraints:
        for one, other in itertools.pairwise(constraint.positions):
            posture = Posture(constraint.active, one.passive)
            path_a, path_p, _ = walk(model, posture, [Leg(model.passive.name, (other.passive,))])
            assert clear_of_everything(model, path_a, path_p, model.nominal) > model.margin - 0.0013


@pytest.mark.parametrize(
    ("turn", "place", "seen"),
    [
        ([0, 0, 0], [0.0, 0.0, 0.4], True),
        ([np.pi, 0, 0], [0.0, 0.0, 0.4], False),  # its back
        ([0, 0, 0], [0.22, 0.0, 0.4], False),  # cut by the image's edge
        ([0, 0, 0], [0.0, -0.17, 0.4], False),
        ([0, 0, 0], [0.0, 0.0, -0.4], False),  # behind the camera
        ([0, 0, 0], [0.0, 0.0, 0.1], False),  # too near to be whole
    ],
)
def test_a_target_is_in_view_if_its_whole_front_is(model, turn, place, seen):
    facing = rotation_from_vector([np.pi, 0, 0]) @ rotation_from_vector(turn)
    assert model.in_view(transform(facing, place)[None])[0] == seen


def test_axes_spread_over_the_shared_space(model, plan):
    axes = model.camera_in_passive([c.active for c in plan.of("calibration")], model.nominal)[:, :3, 2]
    smallest = np.linalg.eigvalsh(axes.T @ axes / len(axes))[0]
    assert smallest > 0.05


def test_the_same_seed_gives_the_same_plan_and_another_seed_another(cell, model, ways, stand_off, plan):
    assert made(cell, model, ways, stand_off.posture) == plan
    assert made(cell, model, ways, stand_off.posture, seed=2) != plan


def test_a_plan_survives_its_file_to_the_last_bit(plan):
    import json

    assert Plan.from_record(json.loads(json.dumps(plan.to_record()))) == plan


def test_the_simulators_truth_changes_no_plan(plan, stand_off):
    other = paper_cell(
        "simulation.truth.active_base_in_passive_base.translation_mm=[1100, -90, 40]",
        "simulation.noise.joint_mrad=1",
        "simulation.seed=77",
    ).cell
    model = CellModel(other)
    ways = WayFinder(model, model.nominal, [model.home])
    assert find_stand_off(model, model.nominal, ways, model.home, 1).posture == stand_off.posture
    assert made(other, model, ways, stand_off.posture) == plan


def test_bases_too_far_apart_are_refused_with_counts_per_condition(cell):
    far = paper_cell("nominal.active_base_in_passive_base.translation_mm=[3000, 0, 0]").cell
    model = CellModel(far)
    ways = WayFinder(model, model.nominal, [model.home])
    with pytest.raises(NoPlan, match=r"0 of 7 calibration.*misses what the passive arm reaches: \d\d\d\d"):
        made(far, model, ways, model.home)


@given(st.floats(0.1, 1.5))
def test_orientations_turned_about_one_axis_only_are_not_turned_about_two(angle):
    fan = np.stack([rotation_from_vector([0, 0, k * angle]) for k in range(4)])
    assert turned_about_two_axes(fan) < 1e-6
    both = np.concatenate([fan, rotation_from_vector([angle, 0, 0])[None]])
    assert turned_about_two_axes(both) > 0.3 * angle


# -- ways ------------------------------------------------------------------------------------------


def test_no_way_leads_through_the_other_arm(model):
    reaching = (0.0, -1.2, 0.8, 0.0, 0.0, 0.0)
    touching = Posture.of(reaching, reaching)
    geometry = model.geometry
    assert geometry.between([reaching], [reaching], model.nominal.placement)[0] < 0
    assert WayFinder(model, model.nominal, []).find(model.home, touching) is None
    apart = model.nominal.T_P_A.copy()
    apart[0, 3] += 1.0
    far = Belief(apart, model.nominal.T_H_E, model.nominal.covariance, "a test")
    assert WayFinder(model, far, []).find(model.home, touching) is not None


def test_an_arm_at_its_goal_is_not_moved(model, plan):
    ways = WayFinder(model, model.nominal, [model.home])
    constraint = plan.constraints[0]
    start = Posture(constraint.active, constraint.positions[0].passive)
    goal = Posture(constraint.active, constraint.positions[1].passive)
    assert ways.find(start, goal) == (Leg(model.passive.name, (goal.passive,)),)
    assert ways.find(start, start) == ()


def test_an_arm_that_stands_too_close_may_leave(model):
    q_a = np.array([0.0, -0.75, 0.2, 0.0, 0.6, 0.0])
    geometry = model.geometry
    for bend in np.linspace(0.0, -1.2, 200):
        q_p = np.array([0.0, bend, 0.2, 0.0, 0.6, 0.0])
        clearance = geometry.clearance([q_a], [q_p], model.nominal.placement)[0]
        if 0 < clearance < model.margin:
            break
    else:
        pytest.fail("no posture found that is closer than the margin")
    ways = WayFinder(model, model.nominal, [])
    start = Posture.of(q_a, q_p)
    assert ways.clear("right", start, [(0.0, bend + 0.3, 0.2, 0.0, 0.6, 0.0)])
    assert not ways.clear("right", start, [(0.0, bend - 0.3, 0.2, 0.0, 0.6, 0.0)])
