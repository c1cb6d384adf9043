"""A plan keeps every condition that it promises: poses, their choice, their order and the ways between them."""

from __future__ import annotations

import itertools
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualcal_hal.errors import NoPlan
from dualcal_hal.geometry import CellGeometry, Placement
from dualcal_hal.geometry.exact import ExactCell
from dualcal_hal.kinematics import Chain
from dualcal_hal.transforms import inverse, rotation_from_vector, transform
from procedures.calibrate import requests_of
from procedures.planning.advice import advice
from procedures.planning.candidates import _AXES_AT_ONCE, ROOM, CandidateSource
from procedures.planning.choice import LEAST_SPREAD, LEAST_TURN, Knowledge, most_informative, turned_about_two_axes
from procedures.planning.model import CellModel, Posture
from procedures.planning.order import shortest_order
from procedures.planning.plan import Plan
from procedures.planning.poses import POINT_SECONDS, PosePlanner, Request, judged_anew
from procedures.planning.ways import Leg, WayFinder
from tests.cells import paper_cell
from tests.walking import least_clearance, seen_from_camera, walk

POSITIONS = 4


@pytest.fixture(scope="module")
def cell():
    return paper_cell().cell


@pytest.fixture(scope="module")
def model(cell):
    return CellModel(cell)


@pytest.fixture(scope="module")
def belief(model):
    """The nominal as the looks might have confirmed it."""
    return model.nominal.as_if_looked()


@pytest.fixture(scope="module")
def ways(model, belief):
    return WayFinder(model, belief, [model.home])


def made(cell, ways, seed=1):
    model = CellModel(cell)
    planner = PosePlanner(model, model.nominal.as_if_looked(), ways, [seed])
    return planner.plan(requests_of(cell.procedure), model.home, provisional=False)


@pytest.fixture(scope="module")
def plan(cell, ways):
    return made(cell, ways)


def stops(plan):
    """The posture at each position, constraint by constraint."""
    return [[Posture.of(c.active, position.passive) for position in c.positions] for c in plan.constraints]


def axes_of(model, belief, constraints):
    return model.camera_in_passive([c.active for c in constraints], belief)[:, :3, 2]


def refused(*overrides):
    """Why there is no plan for the paper's cell so changed, from the nominal as a run would know it after its looks."""
    cell = paper_cell(*overrides).cell
    model = CellModel(cell)
    belief = model.nominal.as_if_looked()
    with pytest.raises(NoPlan) as refusal:
        PosePlanner(model, belief, WayFinder(model, belief, [model.home]), [1]).plan(
            requests_of(cell.procedure), model.home, provisional=True
        )
    return str(refusal.value)


# -- poses -----------------------------------------------------------------------------------------


def test_a_plan_has_the_constraints_and_positions_asked_for(plan):
    assert [len(c.positions) for c in plan.of("calibration")] == [POSITIONS] * 7
    assert [len(c.positions) for c in plan.of("verification")] == [7] * 2
    assert len({c.name for c in plan.constraints}) == 9


def test_positions_lie_on_the_axis_from_the_farthest_to_the_nearest(model, belief, plan):
    for constraint, postures in zip(plan.constraints, stops(plan), strict=True):
        distances = [position.distance for position in constraint.positions]
        np.testing.assert_allclose(distances, np.linspace(0.5, 0.3, len(distances)), atol=1e-12)
        for posture, distance in zip(postures, distances, strict=True):
            np.testing.assert_allclose(seen_from_camera(model, posture, belief)[:3, 3], [0, 0, distance], atol=1e-8)


def test_the_plate_is_tilted_within_the_angle_constraint_and_wholly_in_view(model, belief, plan):
    for constraint, postures in zip(plan.constraints, stops(plan), strict=True):
        for posture, position in zip(postures, constraint.positions, strict=True):
            T_E_T = seen_from_camera(model, posture, belief)
            assert np.arccos(-T_E_T[2, 2]) == pytest.approx(position.tilt, abs=1e-9)
            assert position.tilt <= np.deg2rad(45) + 1e-9
            assert model.in_view(T_E_T[None])[0]


def test_every_posture_and_way_of_a_plan_is_clear_for_all_that_the_looks_leave_open(model, belief, ways, plan):
    here = model.home
    for constraint, postures in zip(plan.constraints, stops(plan), strict=True):
        for goal in postures:
            way = ways.find(here, goal)
            assert way is not None
            assert least_clearance(model, walk(model, here, way), belief.placement) > model.margin
            here = goal
        least = min(position.clearance for position in constraint.positions)
        assert least == pytest.approx(least_clearance(model, postures, belief.placement))


def test_every_posture_keeps_the_procedures_margin_to_the_joint_limits_and_the_plan_says_how_far(cell, model, plan):
    for constraint, postures in zip(plan.constraints, stops(plan), strict=True):
        margins = []
        for posture in postures:
            for robot, q in ((cell.active, posture.active), (cell.passive, posture.passive)):
                inside = np.minimum(q - robot.lower, robot.upper - q) - np.deg2rad(3.0)
                assert np.all(inside >= 0)
                margins.append(np.min(inside))
        assert constraint.joint_margin == pytest.approx(min(margins))


def test_the_plan_says_the_least_manipulability_of_either_arm(model, plan):
    for constraint, postures in zip(plan.constraints, stops(plan), strict=True):
        volumes = [abs(np.linalg.det(model.active.chain.jacobian(constraint.active)))]
        volumes += [abs(np.linalg.det(model.passive.chain.jacobian(posture.passive))) for posture in postures]
        assert constraint.manipulability == pytest.approx(min(volumes))


def test_the_seconds_of_a_constraint_are_those_of_its_ways_and_pictures(model, ways, plan):
    here = model.home
    for constraint, postures in zip(plan.constraints, stops(plan), strict=True):
        seconds = len(postures) * POINT_SECONDS
        for goal in postures:
            seconds += ways.travel(here, ways.find(here, goal))
            here = goal
        assert constraint.seconds == pytest.approx(seconds, abs=1e-6)


def test_the_passive_arm_has_room_to_move_each_way_in_the_camera_plane(model, belief, plan):
    arm = model.passive
    for constraint, postures in zip(plan.constraints, stops(plan), strict=True):
        camera = model.camera_in_passive(constraint.active, belief)
        for posture in postures:
            for direction in (camera[:3, 0], -camera[:3, 0], camera[:3, 1], -camera[:3, 1]):
                goal = model.target_in_passive(posture.passive)
                goal[:3, 3] += ROOM * direction
                flange = goal @ inverse(model.T_F_T)
                q, reached = arm.chain.inverse(flange, [posture.passive], arm.lower, arm.upper)
                assert reached[0]
                assert model.geometry.clearance([constraint.active], q, belief.placement)[0] > 0.02


def test_a_candidate_is_clear_where_alignment_may_take_it_or_it_is_none(model, belief, monkeypatch):
    """As if its positions were clear, and nothing within the room about them."""
    monkeypatch.setattr(CellGeometry, "clearance", lambda self, q_a, q_p, placement: np.zeros(len(q_p)))
    source = CandidateSource(model, belief, np.random.default_rng(1))
    assert source.draw(POSITIONS, 1, 200) == []
    assert source.refused["no room for alignment"] > 0


def test_between_the_positions_of_a_constraint_the_passive_arm_goes_straight(model, belief, plan):
    for postures in stops(plan):
        for one, other in itertools.pairwise(postures):
            passed = walk(model, one, [Leg(model.passive.name, (other.passive,))])
            assert least_clearance(model, passed, belief.placement) > model.margin


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


# -- choice ----------------------------------------------------------------------------------------


def test_axes_spread_over_the_shared_space_and_the_plan_says_how_well(model, belief, plan):
    axes = axes_of(model, belief, plan.of("calibration"))
    smallest = np.linalg.eigvalsh(axes.T @ axes / len(axes))[0]
    assert smallest >= 0.1
    assert plan.axis_spread == pytest.approx(smallest)


def test_flanges_are_turned_about_two_axes(model, plan):
    R = model.active.chain.forward([c.active for c in plan.of("calibration")])[:, :3, :3]
    assert turned_about_two_axes(R) >= LEAST_TURN


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_replacement_keeps_the_spread_and_the_turns_together_with_what_is_captured(model, belief, ways, plan, seed):
    captured = plan.of("calibration")[:6]
    missing = Request("calibration", 1, POSITIONS, 7, captured)
    again = PosePlanner(model, belief, ways, [seed]).plan([missing], model.home, provisional=False)
    (new,) = again.constraints
    assert new.name == "calibration/07"
    axes = axes_of(model, belief, [*captured, new])
    assert np.linalg.eigvalsh(axes.T @ axes / 7)[0] >= 0.1
    assert again.axis_spread == pytest.approx(np.linalg.eigvalsh(axes.T @ axes / 7)[0])
    R = model.active.chain.forward([c.active for c in (*captured, new)])[:, :3, :3]
    assert turned_about_two_axes(R) >= LEAST_TURN


def ask_for_more_spread_than_there_is(monkeypatch):
    for module in ("choice", "poses"):
        monkeypatch.setattr(f"procedures.planning.{module}.LEAST_SPREAD", 0.34)


def test_where_no_replacement_spreads_the_axes_the_run_goes_on_with_the_best_there_is(
    model, belief, ways, plan, monkeypatch
):
    ask_for_more_spread_than_there_is(monkeypatch)
    missing = Request("calibration", 1, POSITIONS, 7, plan.of("calibration")[:6])
    again = PosePlanner(model, belief, ways, [1]).plan([missing], model.home, provisional=False)
    assert len(again.constraints) == 1
    assert again.axis_spread > 0.09
    assert again.refused["the axes of the best choice do not spread"] >= 3


def told_by(axis, rng, flange=None):
    J = rng.standard_normal((8, 12))
    R = rotation_from_vector(rng.uniform(-1, 1, 3)) if flange is None else flange
    return Knowledge(np.array([axis / np.linalg.norm(axis)]), R[None], J.T @ J)


def test_of_candidates_in_a_narrow_cone_and_some_outside_a_well_spread_choice_is_made():
    rng = np.random.default_rng(1)
    pool = [told_by(np.array([1.0, *rng.uniform(-0.1, 0.1, 2)]), rng) for _ in range(15)]
    pool = [replace(told, information=100 * told.information) for told in pool]  # they would tell more
    pool += [told_by(np.array([0.5, *direction]), rng) for direction in ([1, 0.2], [-1, 0.2], [0, 1], [0.3, -1])]
    nothing = Knowledge.together([])
    free = Knowledge.together([pool[i] for i in most_informative(pool, 6, nothing, well_spread=False)])
    spread = Knowledge.together([pool[i] for i in most_informative(pool, 6, nothing, well_spread=True)])
    assert free.spread < LEAST_SPREAD <= spread.spread
    assert spread.well_spread


def test_where_flanges_turned_about_one_axis_would_tell_most_one_that_is_turned_about_another_is_taken():
    rng = np.random.default_rng(1)
    turns = [rotation_from_vector([0, 0, angle]) for angle in rng.uniform(-1, 1, 15)]
    pool = [told_by(rng.standard_normal(3), rng, turn) for turn in turns]
    pool = [replace(told, information=1e4 * told.information) for told in pool]
    pool += [told_by(np.array([1.0, 0.1, 0.1]), rng, rotation_from_vector([1.0, 0, 0]))]
    chosen = most_informative(pool, 6, Knowledge.together([]), well_spread=True)
    assert Knowledge.together([pool[i] for i in chosen]).well_spread


def test_a_choice_is_better_than_any_that_differs_in_one():
    rng = np.random.default_rng(2)
    pool = [told_by(rng.standard_normal(3), rng) for _ in range(12)]
    chosen = most_informative(pool, 4, Knowledge.together([]), well_spread=False)

    def worth(numbers):
        return np.linalg.slogdet(Knowledge.together([pool[i] for i in numbers]).information)[1]

    for leaves, comes in itertools.product(chosen, range(12)):
        if comes not in chosen:
            assert worth([comes if i == leaves else i for i in chosen]) <= worth(chosen) + 1e-3


@given(st.floats(0.1, 1.5))
def test_orientations_turned_about_one_axis_only_are_not_turned_about_two(angle):
    fan = np.stack([rotation_from_vector([0, 0, k * angle]) for k in range(4)])
    assert turned_about_two_axes(fan) < 1e-6
    both = np.concatenate([fan, rotation_from_vector([angle, 0, 0])[None]])
    assert turned_about_two_axes(both) > 0.3 * angle


def test_what_a_constraint_tells_is_the_change_of_the_features_offsets_by_small_errors(model, belief):
    q_a = np.array([0.2, -0.3, 0.5, 0.1, 0.6, 0.2])
    T_A_H, distances = model.active.chain.forward(q_a), np.array([0.3, 0.5])
    camera = belief.T_P_A @ T_A_H @ belief.T_H_E
    points = camera[:3, 3] + distances[:, None] * camera[:3, 2]

    def offsets(xi):
        T_P_A, T_H_E = (
            T @ transform(rotation_from_vector(part[3:]), part[:3])
            for T, part in ((belief.T_P_A, xi[:6]), (belief.T_H_E, xi[6:]))
        )
        T_P_E = T_P_A @ T_A_H @ T_H_E
        return ((points - T_P_E[:3, 3]) @ T_P_E[:3, :3])[:, :2].ravel()

    J = np.array([(offsets(e) - offsets(-e)) / 2e-6 for e in 1e-6 * np.eye(12)]).T
    np.testing.assert_allclose(Knowledge.of(T_A_H, belief, distances).information, J.T @ J, atol=1e-7)


# -- order -----------------------------------------------------------------------------------------


@given(st.integers(2, 6), st.integers(0, 2**16))
def test_an_order_of_few_stops_is_no_longer_than_by_nearest_neighbours_and_cannot_be_shortened_by_a_turn(count, seed):
    rng = np.random.default_rng(seed)
    first, between = rng.uniform(0, 1, count), rng.uniform(0, 1, (count, count))

    def cost(order):
        return first[order[0]] + sum(between[i, j] for i, j in itertools.pairwise(order))

    order = shortest_order(first, between)
    assert sorted(order) == list(range(count))
    for i, j in itertools.combinations(range(count + 1), 2):
        assert cost(order) <= cost([*order[:i], *order[i:j][::-1], *order[j:]]) + 1e-12


def test_stops_on_a_line_are_visited_along_it():
    places = np.array([3.0, 1.0, 4.0, 2.0, 5.0])
    assert shortest_order(places, np.abs(places[:, None] - places)) == [1, 3, 0, 2, 4]


def test_no_joint_goes_the_longer_way_round_where_its_limits_allow_the_shorter(model, plan):
    here = np.array(model.home.active)
    for constraint in plan.constraints:
        there = np.array(constraint.active)
        np.testing.assert_array_equal(model.active.nearest_turn(there, here), there)
        here = there
        for one, other in itertools.pairwise(np.array([position.passive for position in constraint.positions])):
            np.testing.assert_array_equal(model.passive.nearest_turn(other, one), other)


# -- plans -----------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_plan_and_another_seed_another(cell, ways, plan):
    assert made(cell, ways) == plan
    assert made(cell, ways, seed=2) != plan


@pytest.mark.parametrize("use", ["calibration", "verification"])
@pytest.mark.parametrize("given_up", [0, -1])
def test_what_replaces_constraints_stands_where_it_is_visited_after_those_kept_of_its_use(plan, use, given_up):
    gone = plan.of(use)[given_up]
    later = replace(plan, constraints=(replace(gone, name=f"{use}/07"),), planned_from="12 views")
    both = plan.replaced([gone], later)
    assert gone not in both.constraints
    assert both.of(use) == (*(one for one in plan.of(use) if one != gone), *later.constraints)
    assert [one.use for one in both.constraints] == [one.use for one in plan.constraints]
    assert both.planned_from == "12 views"


def test_a_plan_that_is_judged_anew_has_the_clearances_and_the_spread_of_another_belief(model, belief, plan):
    moved = belief.T_P_A @ transform(rotation_from_vector([0.0, 0.0, 0.02]), [0.01, 0.0, 0.005])
    now = replace(belief, T_P_A=moved, placement=Placement(moved, 0.02, 0.01), source="12 views")
    again = judged_anew(plan, model, now)
    assert again.planned_from == "12 views"
    axes = axes_of(model, now, plan.of("calibration"))
    assert again.axis_spread == pytest.approx(np.linalg.eigvalsh(axes.T @ axes / len(axes))[0])
    for before, after, postures in zip(plan.constraints, again.constraints, stops(plan), strict=True):
        assert stops(again) == stops(plan)
        assert (after.name, after.seconds) == (before.name, before.seconds)
        for position, posture in zip(after.positions, postures, strict=True):
            expected = model.geometry.clearance([posture.active], [posture.passive], now.placement)[0]
            assert position.clearance == pytest.approx(expected)
    verification = replace(plan, constraints=plan.of("verification"))
    assert judged_anew(verification, model, now).axis_spread is None


def test_a_plan_survives_its_file_to_the_last_bit(plan):
    assert Plan.from_record(json.loads(json.dumps(plan.to_record()))) == plan


def test_the_simulators_truth_changes_no_plan(plan):
    other = paper_cell(
        "simulation.truth.active_base_in_passive_base.translation_mm=[1100, -90, 40]",
        "simulation.noise.joint_mrad=1",
        "simulation.seed=77",
    ).cell
    model = CellModel(other)
    assert made(other, WayFinder(model, model.nominal.as_if_looked(), [model.home])) == plan


def test_what_the_true_shapes_forbid_is_replaced_and_counted(cell, ways, plan, monkeypatch):
    """As if the shape of something were not inside its capsules, where the first constraint of the plan is."""
    clearances = ExactCell.clearances
    forbidden = plan.constraints[0].active

    def narrower(self, q_a, q_p, T_P_A):
        return np.array([0.019]) if tuple(q_a) == forbidden else clearances(self, q_a, q_p, T_P_A)

    monkeypatch.setattr(ExactCell, "clearances", narrower)
    other = made(cell, ways)
    assert forbidden not in [c.active for c in other.constraints]
    assert other.refused["too close in the true shapes"] == 1
    assert len(other.constraints) == len(plan.constraints)


# -- refusals --------------------------------------------------------------------------------------


@pytest.fixture
def few_axes_for_advice(monkeypatch):
    """What would help is searched for with two batches of axes for each change tried, not nine: it stands out."""
    monkeypatch.setattr("procedures.planning.poses._AXES_FOR_ADVICE", 2 * _AXES_AT_ONCE)


@pytest.mark.usefixtures("few_axes_for_advice")
def test_positions_without_a_clear_way_between_them_are_counted(cell, ways, monkeypatch):
    monkeypatch.setattr(WayFinder, "clear", lambda self, arm, start, waypoints: False)
    with pytest.raises(NoPlan, match=r"the way between two positions is not clear: \d\d"):
        made(cell, ways)


@pytest.mark.usefixtures("few_axes_for_advice")
def test_constraints_that_no_way_leads_to_are_given_up_with_what_is_in_the_way(cell, ways, monkeypatch):
    monkeypatch.setattr(WayFinder, "find", lambda self, start, goal: None)
    monkeypatch.setattr(WayFinder, "blocked_by", lambda self, start, goal: "a pillar stands there")
    with pytest.raises(NoPlan) as refusal:
        made(cell, ways)
    why = str(refusal.value)
    assert "17 calibration constraints that no clear way leads to, the last one because a pillar stands there" in why
    assert "no clear way to the constraint: 17" in why
    assert "the passive arm does not reach the position: " in why
    assert why.endswith("No single change of those tried would help")


@pytest.mark.usefixtures("few_axes_for_advice")
def test_where_no_way_leads_to_constraints_the_change_that_opens_one_is_named(cell, ways, monkeypatch):
    """As if no way were free unless the bases stand farther apart."""
    apart = np.linalg.norm(ways._T_P_A[:3, 3])
    monkeypatch.setattr(WayFinder, "find", lambda self, start, goal: None)
    monkeypatch.setattr(
        WayFinder,
        "blocked_by",
        lambda self, start, goal: "" if np.linalg.norm(self._T_P_A[:3, 3]) > 1.01 * apart else "a pillar",
    )
    with pytest.raises(NoPlan, match=r"What would help most: move the bases 1\d\d mm farther apart"):
        made(cell, ways)


def test_ways_missed_for_one_request_are_not_held_against_the_next(cell, ways, monkeypatch):
    """Ten candidates of each use have no way, then all do: twenty misses are not the seventeen of one."""
    find, missed = WayFinder.find, {"calibration": 0, "verification": 0}
    visit = PosePlanner._visitable

    def told(self, pool, request, known, start, *, insist):
        self._ways.use = request.use
        return visit(self, pool, request, known, start, insist=insist)

    def sometimes(self, start, goal):
        if missed[self.use] < 10:
            missed[self.use] += 1
            return None
        return find(self, start, goal)

    monkeypatch.setattr(PosePlanner, "_visitable", told)
    monkeypatch.setattr(WayFinder, "find", sometimes)
    plan = made(cell, WayFinder(CellModel(cell), CellModel(cell).nominal.as_if_looked(), []))
    assert missed == {"calibration": 10, "verification": 10}
    assert plan.refused["no clear way to the constraint"] == 20


@pytest.mark.usefixtures("few_axes_for_advice")
def test_axes_that_cannot_spread_are_counted(cell, ways, monkeypatch):
    ask_for_more_spread_than_there_is(monkeypatch)
    with pytest.raises(NoPlan, match=r"no choice of them will do.*the axes of the best choice do not spread: 3"):
        made(cell, ways)


def test_bases_too_far_apart_are_refused_with_counts_and_shall_come_closer():
    why = refused("nominal.active_base_in_passive_base.translation_mm=[2200, 0, 0]")
    assert "0 candidates for 7 calibration constraints with 4 positions" in why
    assert "the axis misses what the passive arm reaches: " in why
    assert "What would help most: move the bases 440 mm closer together" in why


def test_bases_so_far_apart_that_a_fifth_less_is_too_far_as_well_shall_come_closer_by_more():
    why = refused("nominal.active_base_in_passive_base.translation_mm=[3000, 0, 0]")
    assert "What would help most: move the bases 1500 mm closer together" in why


def test_a_request_of_which_nothing_is_possible_is_refused_before_it_is_planned_as_it_would_be_then(
    model, belief, ways
):
    request = Request("calibration", 7, POSITIONS)
    PosePlanner(model, belief, ways, [1]).require_candidates(request)
    far = CellModel(paper_cell("nominal.active_base_in_passive_base.translation_mm=[3000, 0, 0]").cell)
    with pytest.raises(NoPlan, match=r"0 candidates for 7 calibration.*reaches: \d+.*1500 mm closer together"):
        PosePlanner(far, far.nominal.as_if_looked(), ways, [1]).require_candidates(request)


def test_an_arm_of_five_joints_is_named_as_what_to_change(model):
    chain = Chain(model.passive.chain.rows[:5])
    short = model.but(passive=replace(model.passive, chain=chain))
    said = advice(short, model.nominal, lambda model, belief: 0.0)
    assert said.startswith("What would help most: an arm of 6 joints in place of 'right', whose 5 cannot")


def test_of_the_changes_that_help_the_best_is_named_and_far_moves_of_the_bases_only_where_nothing_else_helps(model):
    def apart(belief):
        return float(np.linalg.norm(belief.T_P_A[:3, 3]))

    now = apart(model.nominal)
    assert "1200 mm farther" in advice(model, model.nominal, lambda _, belief: float(apart(belief) > 1.9 * now))
    both = advice(
        model, model.nominal, lambda other, belief: 9 * (apart(belief) < 0.6 * now) + (other.margin < model.margin)
    )
    assert both == "What would help most: lower procedure.clearance_mm to 10"
    more = advice(
        model, model.nominal, lambda other, belief: 2 * (other.distance[0] < model.distance[0]) + (apart(belief) < now)
    )
    assert "widen procedure.distance_mm" in more


@pytest.mark.usefixtures("few_axes_for_advice")
def test_a_fixture_around_an_arm_is_named_and_shall_be_moved():
    box = "at: {translation_mm: [0, 0, 0], rotation_vector_deg: [0, 0, 0]}, box_mm: [600, 600, 1500]"
    why = refused(f"fixtures={{cabinet: {{in: passive_base, {box}}}}}")
    assert re.search(r"the passive arm is too close to 'cabinet': \d+", why)
    assert "What would help most: move fixtures.cabinet out of the way" in why


@pytest.mark.slow
@pytest.mark.parametrize(
    ("override", "help_"),
    [
        ("procedure.clearance_mm=150", "lower procedure.clearance_mm to 10"),
        (
            "nominal.camera_in_active_flange.rotation_vector_deg=[180, 0, 0]",
            "mount the camera on 'left'",
        ),
        ("robots.left.limit_margin_deg=[165, 105, 55, 180, 85, 345]", "lower limit_margin_deg of 'left' to 0"),
    ],
)
def test_what_makes_a_cell_useless_is_named(override, help_):
    assert f"What would help most: {help_}" in refused(override)
