"""Ways keep clear whatever the bases' error, move one arm at a time, and are the same whenever they are asked for."""

from __future__ import annotations

import itertools
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dualcal_hal.geometry import Placement
from dualcal_hal.geometry.exact import ExactCell
from dualcal_hal.kinematics import random_joints
from dualcal_hal.transforms import rotation_from_vector, transform
from procedures.planning.model import CellModel, Posture
from procedures.planning.ways import Leg, WayFinder
from tests.cells import paper_cell

FITTED = (0.015, float(np.deg2rad(0.6)))
LARGEST = (0.120, float(np.deg2rad(12.0)))
CLEARANCE = 0.020


@pytest.fixture(scope="module")
def cell():
    return paper_cell().cell


@pytest.fixture(scope="module")
def model(cell):
    return CellModel(cell)


@pytest.fixture(scope="module")
def ways(model):
    return finder(model, FITTED)


def finder(model, uncertainty=(0.0, 0.0), apart=0.0):
    T_P_A = model.nominal.T_P_A.copy()
    T_P_A[0, 3] += apart
    return WayFinder(model, replace(model.nominal, placement=Placement(T_P_A, *uncertainty)), [model.home])


def shared_postures(model, uncertainty, seed):
    """Random postures without end that keep clear, with camera and target less than 0.6 m apart."""
    placement, margin = Placement(model.nominal.T_P_A, *uncertainty), finder(model).margin
    rng = np.random.default_rng(seed)
    while True:
        q_a = random_joints(rng, 400, model.active.lower, model.active.upper)
        q_p = random_joints(rng, 400, model.passive.lower, model.passive.upper)
        camera, target = model.camera_in_passive(q_a, model.nominal), model.target_in_passive(q_p)
        good = np.linalg.norm(camera[:, :3, 3] - target[:, :3, 3], axis=1) < 0.6
        good[good] = model.geometry.clearance(q_a[good], q_p[good], placement) >= margin
        yield from (Posture.of(a, p) for a, p in zip(q_a[good], q_p[good], strict=True))


def is_straight(way):
    return way is not None and all(len(leg.waypoints) == 1 for leg in way) and len(way) <= 2


def blocked_queries(model, uncertainty, count, seed):
    """The finder, and starts and goals between which the arms cannot go straight, whichever goes first."""
    ways = finder(model, uncertainty)
    pairs = itertools.pairwise(shared_postures(model, uncertainty, seed))
    blocked = (pair for pair in pairs if ways.blocked_by(*pair).count(";") == 1)
    return ways, list(itertools.islice(blocked, count))


@pytest.fixture(scope="module")
def blocked(model):
    return blocked_queries(model, FITTED, 3, 1)[1]


def walked(model, start, way):
    """Joint angles (k, n) of both arms along each leg, one array a leg, in steps of about 4 mm."""
    here = {model.active.name: np.array(start.active), model.passive.name: np.array(start.passive)}
    for leg in way:
        path = []
        for waypoint in leg.waypoints:
            steps = 1 + int(np.sum(np.abs(waypoint - here[leg.arm])) * 0.8 / 0.004)
            shares = np.linspace(0.0, 1.0, steps + 1)[:, None]
            path.append(here[leg.arm] + shares * (waypoint - here[leg.arm]))
            here[leg.arm] = np.array(waypoint)
        moving = np.concatenate(path)
        both = {name: np.broadcast_to(q, moving.shape) for name, q in here.items()} | {leg.arm: moving}
        yield both[model.active.name], both[model.passive.name]


def misplaced(T_P_A, uncertainty, rng):
    """The bases with the largest error allowed, in a random direction."""
    direction, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    return T_P_A @ transform(rotation_from_vector(uncertainty[1] * axis), uncertainty[0] * direction)


# -- ways that go straight ------------------------------------------------------------------------


def test_arms_go_straight_one_after_the_other_where_nothing_is_in_the_way(model):
    ways = finder(model, apart=2.0)
    goal = Posture.of(np.array(model.home.active) + 0.3, np.array(model.home.passive) - 0.3)
    assert ways.find(model.home, goal) == (Leg("left", (goal.active,)), Leg("right", (goal.passive,)))


def test_an_arm_at_its_goal_is_not_moved(model, ways):
    goal = replace(model.home, passive=tuple(np.array(model.home.passive) + 0.3))
    assert ways.find(model.home, goal) == (Leg("right", (goal.passive,)),)
    assert ways.find(goal, goal) == ()


def test_no_way_leads_through_the_other_arm(model):
    reaching = (0.0, -1.2, 0.8, 0.0, 0.0, 0.0)
    touching = Posture.of(reaching, reaching)
    near, far = finder(model), finder(model, apart=1.0)
    assert model.geometry.between([reaching], [reaching], Placement(model.nominal.T_P_A))[0] < 0
    assert near.find(model.home, touching) is None
    assert far.find(model.home, touching) is not None


# -- ways that are searched for -------------------------------------------------------------------


def test_where_straight_moves_are_blocked_a_way_is_found_that_ends_at_the_goal(model, ways, blocked):
    for start, goal in blocked:
        way = ways.find(start, goal)
        assert not is_straight(way)
        ends = {model.active.name: start.active, model.passive.name: start.passive}
        ends |= {leg.arm: leg.goal for leg in way}
        assert Posture(ends[model.active.name], ends[model.passive.name]) == goal


def check_clear(cell, model, uncertainty, start, way, seed):
    """Every posture of a way, the bases with the largest error in some random directions, the closest ones exactly."""
    exact, rng = ExactCell.of(cell), np.random.default_rng(seed)
    for T_P_A in [misplaced(model.nominal.T_P_A, uncertainty, rng) for _ in range(4)]:
        for q_a, q_p in walked(model, start, way):
            clearance = model.geometry.clearance(q_a, q_p, Placement(T_P_A))
            closest = int(np.argmin(clearance))
            assert clearance[closest] >= CLEARANCE
            assert exact.clearance(q_a[closest], q_p[closest], T_P_A) >= CLEARANCE


@pytest.mark.parametrize("uncertainty", [FITTED, LARGEST], ids=["fitted", "largest"])
def test_a_way_is_clear_wherever_the_bases_truly_stand(cell, model, uncertainty):
    ways, queries = blocked_queries(model, uncertainty, 1, 2)
    for seed, (start, goal) in enumerate(queries):
        check_clear(cell, model, uncertainty, start, ways.find(start, goal), seed)


@pytest.mark.slow
@pytest.mark.parametrize("uncertainty", [FITTED, LARGEST], ids=["fitted", "largest"])
@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_every_way_is_clear_wherever_the_bases_truly_stand(cell, model, uncertainty, seed):
    ways, ((start, goal),) = blocked_queries(model, uncertainty, 1, seed)
    way = ways.find(start, goal)
    assume(way is not None)  # the search is bounded: it gives one such query of 600 up
    check_clear(cell, model, uncertainty, start, way, seed)


def test_the_way_stays_within_the_procedures_limits(model, ways, blocked):
    for start, goal in blocked:
        for leg in ways.find(start, goal):
            arm = model.active if leg.arm == model.active.name else model.passive
            assert np.all(arm.lower <= np.array(leg.waypoints))
            assert np.all(np.array(leg.waypoints) <= arm.upper)


def test_consecutive_legs_are_of_different_arms(ways, blocked):
    for start, goal in blocked:
        way = ways.find(start, goal)
        assert all(one.arm != other.arm for one, other in itertools.pairwise(way))


def fixture(name, translation_mm, shape):
    at = f"at: {{translation_mm: {translation_mm}, rotation_vector_deg: [0, 0, 0]}}"
    return f"{name}: {{in: passive_base, {at}, {shape}}}"


def test_with_the_active_arm_at_its_goal_the_passive_one_alone_goes_around_a_post(model):
    post = fixture("post", [0, 250, 800], "cylinder_mm: {radius: 30, length: 400}")
    model = CellModel(paper_cell(f"fixtures={{{post}}}").cell)
    ways = finder(model, apart=2.0)
    one, other = (replace(model.home, passive=(turn, *model.home.passive[1:])) for turn in (0.8, 2.3))
    assert not ways.clear("right", one, [other.passive])
    assert ways.blocked_by(one, other) == "'right' may touch 'post'"
    way = ways.find(one, other)
    assert [leg.arm for leg in way] == ["right"]
    assert len(way[0].waypoints) > 1


def test_a_goal_behind_walls_without_a_gap_is_given_up(model):
    front = fixture("front", [1100, 0, 0], "box_mm: [2000, 20, 6000]")
    back = fixture("back", [-1100, 0, 0], "box_mm: [2000, 20, 6000]")
    model = CellModel(paper_cell(f"fixtures={{{front}, {back}}}").cell)
    ways = finder(model, apart=2.5)
    one, other = (replace(model.home, passive=(turn, *model.home.passive[1:])) for turn in (-1.5, 1.5))
    assert ways.clear("right", one, [one.passive])
    assert ways.clear("right", other, [other.passive])
    assert ways.find(one, other) is None


def test_a_way_that_was_searched_for_is_shortened(model, blocked, monkeypatch):
    ways = finder(model, FITTED)
    shortened = [ways.travel(start, ways.find(start, goal)) for start, goal in blocked]
    monkeypatch.setattr("procedures.planning.search.SHORTCUTS", 0)
    found = [ways.travel(start, ways.find(start, goal)) for start, goal in blocked]
    assert all(short <= long for short, long in zip(shortened, found, strict=True))
    assert sum(shortened) < 0.95 * sum(found)


def test_retreats_are_tried_before_anything_random(model, monkeypatch):
    """No random point, and no shortcut past a retreat, is tried here at all."""
    monkeypatch.setattr("procedures.planning.search.ITERATIONS", 0)
    monkeypatch.setattr("procedures.planning.search.ALONE_ITERATIONS", 0)
    monkeypatch.setattr("procedures.planning.search.SHORTCUTS", 0)
    placed = replace(model.nominal, placement=Placement(model.nominal.T_P_A, *FITTED))
    _, queries = blocked_queries(model, FITTED, 4, 1)
    assert all(WayFinder(model, placed, []).find(*query) is None for query in queries)
    found = [way for way in (WayFinder(model, placed, [model.home]).find(*query) for query in queries) if way]
    assert found
    for way in found:
        passed = {leg.arm: leg.waypoints for leg in way}
        assert model.home.active in passed["left"] or model.home.passive in passed["right"]


# -- the final check in the true shapes ---------------------------------------------------------------


def as_if_truly_close(monkeypatch, where, clearance=CLEARANCE - 0.001):
    """As if the shape of something were not inside its capsules, at postures for which ``where`` holds."""
    exact = ExactCell.clearances

    def narrower(self, q_a, q_p, T_P_A):
        clearances = exact(self, q_a, q_p, T_P_A)
        return np.full_like(clearances, clearance) if where(Posture.of(q_a, q_p)) else clearances

    monkeypatch.setattr(ExactCell, "clearances", narrower)


def standing(model, start, way):
    """The postures between the legs of a way, and at its ends."""
    postures = [start]
    for leg in way:
        moved = {"active" if leg.arm == model.active.name else "passive": leg.goal}
        postures.append(replace(postures[-1], **moved))
    return postures


def test_a_way_that_is_too_close_in_the_true_shapes_where_an_arm_passes_is_not_gone(model, blocked, monkeypatch):
    for start, goal in blocked:
        stops = standing(model, start, finder(model, FITTED).find(start, goal))
        with monkeypatch.context() as context:
            as_if_truly_close(context, lambda posture, stops=stops: posture not in stops)
            assert finder(model, FITTED).find(start, goal) is None


def test_no_way_leads_to_where_the_true_shapes_are_too_close_and_that_is_said(model, monkeypatch):
    goal = Posture.of(np.array(model.home.active) + 0.3, np.array(model.home.passive) - 0.3)
    ways = finder(model, apart=2.0)
    assert ways.find(model.home, goal) is not None
    as_if_truly_close(monkeypatch, lambda posture: posture == goal)
    assert ways.find(model.home, goal) is None
    assert "true shapes" in ways.blocked_by(model.home, goal)


def test_who_stands_too_close_in_the_true_shapes_may_leave_and_only_from_there(model, monkeypatch):
    goal = Posture.of(np.array(model.home.active) + 0.3, np.array(model.home.passive) - 0.3)
    ways = finder(model, apart=2.0)
    as_if_truly_close(monkeypatch, lambda posture: posture != goal)
    assert ways.find(model.home, goal) is not None
    assert ways.find(goal, model.home) is None


@pytest.mark.parametrize(("at_first", "there", "may"), [(0, 0, True), (0, 1, False), (1, 0, False), (1, 1, True)])
def test_two_parts_that_stand_too_close_in_the_true_shapes_excuse_no_other_two(
    model, monkeypatch, at_first, there, may
):
    goal = Posture.of(np.array(model.home.active) + 0.3, np.array(model.home.passive) - 0.3)

    def two(self, q_a, q_p, T_P_A):
        clearances = np.full(2, 0.1)
        clearances[at_first if Posture.of(q_a, q_p) == model.home else there] = 0.005
        return clearances

    monkeypatch.setattr(ExactCell, "clearances", two)
    ways = finder(model, apart=2.0)
    assert (ways.find(model.home, goal) is not None) == may
    assert ("to themselves" in ways.blocked_by(model.home, goal)) != may


# -- determinism ----------------------------------------------------------------------------------


def test_the_same_query_has_the_same_answer_whatever_was_asked_before(model, blocked):
    (start, goal), *others = blocked
    ways = finder(model, FITTED)
    first = ways.find(start, goal)
    for query in others:
        ways.find(*query)
    assert ways.find(start, goal) == first


def test_another_process_finds_the_same_way(model, ways, blocked):
    start, goal = blocked[0]
    script = (
        "from tests.test_ways import FITTED, CellModel, Posture, finder, paper_cell\n"
        f"print(finder(CellModel(paper_cell().cell), FITTED).find({start!r}, {goal!r}))"
    )
    root = Path(__file__).parent.parent
    done = subprocess.run([sys.executable, "-c", script], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == repr(ways.find(start, goal))


# -- where an arm stands badly ------------------------------------------------------------------------


def too_close(model, ways, bent=-0.75):
    """A posture with the arms closer than the margin, and the passive arm's bend in it."""
    q_a = np.array([0.0, bent, 0.2, 0.0, 0.6, 0.0])
    for bend in np.linspace(0.0, -1.2, 400):
        q_p = np.array([0.0, bend, 0.2, 0.0, 0.6, 0.0])
        clearance = model.geometry.clearance([q_a], [q_p], Placement(model.nominal.T_P_A))[0]
        if 0 < clearance < ways.margin / 2:
            return Posture.of(q_a, q_p)
    raise AssertionError("no posture found that is closer than the margin")


def test_an_arm_that_stands_too_close_may_leave_but_come_no_closer(model):
    ways = finder(model)
    start = too_close(model, ways)
    bend = start.passive[1]
    assert ways.clear("right", start, [(0.0, bend + 0.3, 0.2, 0.0, 0.6, 0.0)])
    assert not ways.clear("right", start, [(0.0, bend - 0.3, 0.2, 0.0, 0.6, 0.0)])


def test_an_arm_that_leaves_may_not_come_back_as_close_as_it_stood_before_it_has_the_margin(model):
    ways = finder(model)
    start = too_close(model, ways)
    bend = start.passive[1]
    there_and_back = [(0.0, bend + step, 0.2, 0.0, 0.6, 0.0) for step in (0.3, 0.01)]
    assert not ways.clear("right", start, there_and_back)


def test_no_way_leads_from_where_the_arms_may_be_touching_for_an_allowed_error(model):
    ways = finder(model, (0.12, float(np.deg2rad(12))))
    start = too_close(model, finder(model))
    assert model.geometry.between([start.active], [start.passive], Placement(model.nominal.T_P_A))[0] > 0.005
    assert ways.find(start, model.home) is None


def test_arms_that_stand_too_close_find_home(model):
    ways = finder(model)
    start = too_close(model, ways)
    assert ways.clearance_along(start, [Leg("right", (start.passive,))]) < ways.margin
    assert ways.find(start, model.home) is not None


def test_no_way_ends_closer_than_the_margin(model):
    ways = finder(model)
    assert ways.find(model.home, too_close(model, ways)) is None


def test_no_way_leads_to_a_goal_a_little_closer_than_the_margin_even_if_it_can_be_left(model):
    """A way from there, gone backwards, would be one into it."""
    ways, placement = finder(model), Placement(model.nominal.T_P_A)
    swing = np.array([[0.0, bend, 0.2, 0.0, 0.6, 0.0] for bend in np.linspace(0.0, -1.2, 2000)])
    clearance = model.geometry.clearance([[0.0, -0.75, 0.2, 0.0, 0.6, 0.0]], swing, placement)
    close = swing[np.flatnonzero((clearance > 0.018) & (clearance < ways.margin - 1e-3))[0]]
    goal = Posture.of([0.0, -0.75, 0.2, 0.0, 0.6, 0.0], close)
    assert ways.find(goal, model.home) is not None
    assert ways.find(model.home, goal) is None


def test_an_arm_that_was_jogged_beyond_the_procedures_limits_comes_in_but_is_not_sent_there(model):
    ways = finder(model, apart=2.0)
    beyond = np.array(model.home.passive)
    beyond[0] = model.passive.upper[0] + np.deg2rad(1.0)
    jogged = replace(model.home, passive=tuple(beyond))
    assert ways.find(jogged, model.home) is not None
    assert ways.find(model.home, jogged) is None
    assert ways.blocked_by(model.home, jogged) == "the goal of 'right' is outside its limits"


def test_checked_postures_keep_besides_the_clearance_what_may_be_lost_between_two_of_them(model):
    """25 mm where no point moves further than 10 mm from one check to the next: one at 22 mm does not do."""
    placement = Placement(model.nominal.T_P_A)
    swing = np.array([[0.0, bend, 0.2, 0.0, 0.6, 0.0] for bend in np.linspace(0.0, -1.2, 2000)])
    clearance = model.geometry.clearance([[0.0, -0.75, 0.2, 0.0, 0.6, 0.0]], swing, placement)
    near, far = (
        int(np.flatnonzero((clearance > least) & (clearance < most))[0])
        for least, most in ((0.021, 0.024), (0.026, 0.029))
    )
    ways = finder(model)
    start = Posture.of([0.0, -0.75, 0.2, 0.0, 0.6, 0.0], swing[0])
    assert ways.clear("right", start, [swing[far]])
    assert not ways.clear("right", start, [swing[near]])


# -- what is said about ways ------------------------------------------------------------------------


def test_the_clearance_along_a_way_is_the_least_of_a_finer_walk_to_half_a_sample(model, ways, blocked):
    placement = Placement(model.nominal.T_P_A, *FITTED)
    for start, goal in blocked:
        way = ways.find(start, goal)
        finer = min(float(model.geometry.clearance(a, p, placement).min()) for a, p in walked(model, start, way))
        assert ways.margin <= ways.clearance_along(start, way) <= finer + 0.005


def test_travel_is_the_time_at_speed_and_two_ramps_of_the_slowest_joint(model, ways):
    arm = model.passive
    far, near = np.array(arm.home), np.array(arm.home)
    far[0] += 1.0
    near[4] += 0.01
    cruise = 1.0 / arm.speed[0] + arm.speed[0] / arm.acceleration[0]
    triangle = 2 * np.sqrt(0.01 / arm.acceleration[4])
    there = Leg("right", (tuple(far),))
    assert ways.travel(model.home, [there]) == pytest.approx(cruise)
    assert ways.travel(model.home, [Leg("right", (tuple(near),))]) == pytest.approx(triangle)
    assert ways.travel(model.home, [Leg("right", (tuple(far), arm_home(model)))]) == pytest.approx(2 * cruise)
    assert ways.travel(model.home, [there, Leg("left", (model.home.active,))]) == pytest.approx(cruise)


def arm_home(model):
    return tuple(map(float, model.passive.home))


def test_what_blocks_is_named_for_either_order_with_the_part_of_the_other_arm(model):
    reaching = (0.0, -1.2, 0.8, 0.0, 0.0, 0.0)
    said = finder(model).blocked_by(model.home, Posture.of(reaching, reaching))
    first, second = said.split("; ")
    assert first.startswith("after 'left' has moved, 'right' may touch ")
    assert second.startswith("after 'right' has moved, 'left' may touch ")
    assert first.endswith(("on 'left'", "of 'left'"))


def test_a_move_into_the_floor_is_blocked_by_it(model):
    down = replace(model.home, passive=(0.0, -1.6, 0.2, 0.0, 0.0, 0.0))
    assert "'right' may touch the floor" in finder(model, apart=2.0).blocked_by(model.home, down)


def test_nothing_blocks_a_way_that_is_free(model):
    near = Posture.of(np.array(model.home.active) + 0.1, np.array(model.home.passive) + 0.1)
    assert finder(model, apart=2.0).blocked_by(model.home, near) == ""
