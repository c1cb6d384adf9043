"""Capsules, distances and clearance, against an exact collision library."""

from __future__ import annotations

import itertools

import coal
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dualcal_hal.geometry import (
    BETWEEN_SAMPLES,
    LARGEST_MOTION,
    ArmBody,
    Capsules,
    CellGeometry,
    Placement,
    camera_box,
    camera_capsule,
    link_capsules,
    plate_box,
    plate_capsules,
    segment_distance,
)
from dualcal_hal.geometry.body import LEAST_APART
from dualcal_hal.geometry.exact import ExactCell
from dualcal_hal.target import Checkerboard
from dualcal_hal.transforms import apply, rotation_from_vector, smallest_rotation, transform
from tests.cells import paper_cell
from tests.reference_cell import ACTIVE, NOMINAL_T_H_E, NOMINAL_T_P_A, PASSIVE, T_F_T

segments = arrays(float, (2, 3), elements=st.floats(-1, 1).map(lambda x: round(x, 3)))
BOARD = Checkerboard(3, 3, 0.025, 4)


def bodies(floor: float | None = 0.0) -> CellGeometry:
    radii = [0.055, 0.055, 0.055, 0.045, 0.045, 0.045]
    active = ArmBody(ACTIVE, link_capsules(ACTIVE, radii), camera_capsule(6, NOMINAL_T_H_E, 0.035, 0.02), floor)
    passive = ArmBody(PASSIVE, link_capsules(PASSIVE, radii), plate_capsules(6, T_F_T, BOARD.outline), floor)
    return CellGeometry(active, passive)


def coal_distance(first: np.ndarray, second: np.ndarray, radius: float) -> float:
    """Distance between two capsules of one radius by coal."""
    shapes, places = [], []
    for ends in (first, second):
        length = float(np.linalg.norm(ends[1] - ends[0]))
        axis = (ends[1] - ends[0]) / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])
        shapes.append(coal.Capsule(radius, length))
        places.append(coal.Transform3s(smallest_rotation([0, 0, 1], axis), ends.mean(axis=0)))
    return coal.distance(shapes[0], places[0], shapes[1], places[1], coal.DistanceRequest(), coal.DistanceResult())


@settings(max_examples=200)
@given(segments, segments)
def test_the_distance_of_segments_is_that_of_an_exact_library(first, second):
    expected = coal_distance(first, second, 0.001) + 0.002
    if expected > 0.003:
        assert segment_distance(first, second) == pytest.approx(expected, abs=1e-5)


@given(segments, segments)
def test_the_distance_does_not_depend_on_the_order(first, second):
    assert segment_distance(first, second) == pytest.approx(segment_distance(second, first), abs=1e-9)
    assert segment_distance(first[::-1], second) == pytest.approx(segment_distance(first, second), abs=1e-9)


def test_links_run_from_frame_to_frame():
    body = bodies().active
    q = np.array([0.3, -0.4, 0.5, 0.2, 0.6, -0.7])
    placed = body.segments(q[None])[0]
    frames = ACTIVE.frames(q)
    np.testing.assert_allclose(placed[0, 0], np.zeros(3), atol=1e-12)
    starts_and_ends = {i: body.capsules.frame[i] for i in range(len(placed) - 1)}
    for i, frame in starts_and_ends.items():
        end = frames[frame][:3, 3]
        assert min(np.linalg.norm(placed[i] - end, axis=1)) < 1e-12
    for one, following in itertools.pairwise(placed[:7]):
        assert segment_distance(one, following) < 0.006


def inside(points, capsules):
    """How deep (n,) points lie inside the nearest of the capsules, m."""
    distance = segment_distance(np.stack([points, points], axis=1)[:, None], capsules.ends[None])
    return np.max(capsules.radius - distance, axis=1)


def surface(sizes, T, count=41):
    """Points (n, 3) all over a box."""
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, count)] * 3), axis=-1).reshape(-1, 3)
    on_it = np.any(np.abs(grid) > 0.5 - 1e-9, axis=1)
    return apply(T, grid[on_it] * sizes)


@pytest.mark.parametrize("board", [BOARD, Checkerboard(5, 8, 0.012, 12), Checkerboard(3, 3, 0.004, 4)])
def test_the_plates_capsules_contain_the_plate(board):
    covering = plate_capsules(6, np.eye(4), board.outline)
    assert np.min(inside(surface(*plate_box(board.outline)), covering)) > -1e-9
    assert np.max(covering.ends[..., :2] - board.outline.max(axis=0)[:2]) < 0


def test_the_cameras_capsule_contains_its_housing():
    covering = camera_capsule(6, np.eye(4), 0.035, 0.02)
    assert np.min(inside(surface(*camera_box(0.035, 0.02)), covering)) > -1e-9


def test_clearance_is_the_least_of_arms_floor_and_self():
    geometry = bodies()
    rng = np.random.default_rng(5)
    q_a, q_p = rng.uniform(-1, 1, (2, 20, 6))
    clearance = geometry.clearance(q_a, q_p, Placement(NOMINAL_T_P_A))
    parts = [
        geometry.between(q_a, q_p, Placement(NOMINAL_T_P_A)),
        geometry.active.own_clearance(q_a),
        geometry.passive.own_clearance(q_p),
    ]
    np.testing.assert_array_equal(clearance, np.min(parts, axis=0))
    one_by_one = [
        geometry.clearance(a[None], p[None], Placement(NOMINAL_T_P_A))[0] for a, p in zip(q_a, q_p, strict=True)
    ]
    np.testing.assert_allclose(clearance, one_by_one, atol=1e-12)


def test_arms_far_apart_are_further_apart():
    geometry = bodies()
    far = NOMINAL_T_P_A.copy()
    far[0, 3] += 1.0
    q = np.zeros((1, 6))
    assert geometry.between(q, q, Placement(far))[0] > geometry.between(q, q, Placement(NOMINAL_T_P_A))[0] + 0.5


def test_an_arm_that_reaches_down_meets_the_floor_only_where_there_is_one():
    q = np.array([[0.0, -2.0, 0.0, 0.0, 0.0, 0.0]])
    assert bodies(floor=0.0).active.own_clearance(q)[0] < 0
    assert bodies(floor=None).active.own_clearance(q)[0] > 0


def test_a_camera_folded_onto_the_forearm_is_too_close():
    q = np.zeros((37, 6))
    q[1:, 4] = np.deg2rad(-90)
    q[1:, 5] = np.deg2rad(np.arange(0, 360, 10))
    straight, *folded = bodies(floor=None).active.own_clearance(q)
    assert min(folded) < 0 < straight


# The bases' error

NOTHING = Capsules(np.zeros(0, dtype=np.int64), np.zeros((0, 2, 3)), np.zeros(0))
HERE = np.zeros((1, 6))
places = arrays(float, (2, 2, 3), elements=st.floats(-1, 1).map(lambda x: round(x, 3)))
directions = arrays(float, 3, elements=st.floats(-1, 1)).filter(lambda v: np.linalg.norm(v) > 0.1)


def two_capsules(ends):
    """A cell with one capsule on each base, radii of 50 and 30 mm."""
    active, passive = (
        ArmBody(chain, Capsules(np.array([0]), e[None], np.array([r])), NOTHING, None)
        for chain, e, r in zip((ACTIVE, PASSIVE), ends, (0.05, 0.03), strict=True)
    )
    return CellGeometry(active, passive)


def moved(translation, rotation):
    return NOMINAL_T_P_A @ transform(rotation_from_vector(rotation), translation)


def of_length(direction, length):
    return direction / np.linalg.norm(direction) * length


@settings(max_examples=300)
@given(
    places,
    directions,
    directions,
    st.floats(0, 0.2),
    st.floats(0, 0.5) | st.floats(0, 2 * np.pi),
    st.floats(0, 1),
    st.floats(0, 1),
)
def test_clearance_holds_for_every_error_of_the_bases(ends, along, about, translation, rotation, part, share):
    geometry = two_capsules(ends)
    promised = geometry.between(HERE, HERE, Placement(NOMINAL_T_P_A, translation, rotation))[0]
    true = moved(of_length(along, translation * part), of_length(about, rotation * share))
    assert geometry.between(HERE, HERE, Placement(true))[0] >= promised - 1e-9


@given(places)
def test_without_an_error_clearance_is_the_distance(ends):
    geometry = two_capsules(ends)
    distance = segment_distance(apply(NOMINAL_T_P_A, ends[0]), ends[1])
    clearance = geometry.between(HERE, HERE, Placement(NOMINAL_T_P_A))[0]
    if distance > 1e-6:
        assert clearance == pytest.approx(distance - 0.08, abs=1e-9)
    else:
        assert clearance <= -0.08 + 1e-6


@pytest.mark.parametrize(
    ("translation", "rotation", "share"), [(0.015, 0.01, 0.98), (0.0, 0.02, 0.98), (0.12, 0.21, 0.75)]
)
def test_clearance_gives_away_little_more_than_the_worst_error_takes(translation, rotation, share):
    rng = np.random.default_rng(4)
    for _ in range(50):
        ball, post = rng.uniform(-0.6, 0.6, 3), rng.uniform(-0.6, 0.6, 3)
        ends = np.array([[ball, ball], [post, post]])
        geometry = two_capsules(ends)
        from_pivot = apply(np.linalg.inv(NOMINAL_T_P_A), post[None])[0] - ball
        exact = geometry.between(HERE, HERE, Placement(NOMINAL_T_P_A))[0]
        turn = np.cross(ball, from_pivot)
        turned = rotation_from_vector(of_length(turn, rotation)) @ ball
        true = moved(of_length(from_pivot - (turned - ball), translation), of_length(turn, rotation))
        worst = geometry.between(HERE, HERE, Placement(true))[0]
        promised = geometry.between(HERE, HERE, Placement(NOMINAL_T_P_A, translation, rotation))[0]
        if exact > 0.4:
            assert share * (exact - promised) - 1e-4 < exact - worst <= exact - promised + 1e-9


def one_by_one(active, passive, placement):
    """Clearance of the closest pair of capsules, all of them on the bases, each pair in a cell of its own."""
    return min(
        CellGeometry(
            ArmBody(ACTIVE, only(active, i), NOTHING, None), ArmBody(PASSIVE, only(passive, j), NOTHING, None)
        ).between(HERE, HERE, placement)[0]
        for i, j in itertools.product(range(len(active)), range(len(passive)))
    )


@pytest.mark.parametrize(
    ("active", "passive", "error"),
    [
        # The end of a long capsule, with the middle of a short one closer.
        ([[[0.0, 0, 0.1], [0.8, 0, 0.1]], [[0.85, 0.1, 0.1]] * 2], [[[0.85, 0, 0.1]] * 2], 0.0),
        # What the bases' rotation moves far, with what it hardly moves closer.
        ([[[1.0, 0, 0]] * 2, [[0.01, 0, 0]] * 2], [[[1.0, 0.3, 0]] * 2, [[-0.2, 0, 0]] * 2], 0.2),
    ],
)
def test_the_closest_pair_is_never_passed_over(active, passive, error):
    T_P_A = np.eye(4)
    first, second = (
        Capsules(np.zeros(len(ends), dtype=np.int64), np.array(ends), np.full(len(ends), 0.01))
        for ends in (active, passive)
    )
    together = CellGeometry(ArmBody(ACTIVE, first, NOTHING, None), ArmBody(PASSIVE, second, NOTHING, None))
    placement = Placement(T_P_A, 0.0, error)
    clearance = together.between(HERE, HERE, placement)[0]
    assert clearance == pytest.approx(one_by_one(first, second, placement), abs=1e-12)


def only(capsules, index):
    return Capsules(capsules.frame[[index]], capsules.ends[[index]], capsules.radius[[index]])


# Paths

waypoints = arrays(float, (3, 6), elements=st.floats(-3, 3))


@settings(deadline=None)
@given(waypoints)
def test_no_part_moves_further_than_10_mm_from_one_sample_to_the_next(points):
    body = bodies().active
    samples = body.sampled(points)
    motion = np.linalg.norm(np.diff(body.segments(samples), axis=0), axis=-1)
    assert np.max(motion, initial=0.0) <= 0.010 == LARGEST_MOTION
    for waypoint in points:
        assert np.min(np.max(np.abs(samples - waypoint), axis=1)) < 1e-12


@settings(deadline=None, max_examples=30)
@given(waypoints)
def test_samples_lie_on_the_straight_moves_in_order(points):
    samples = bodies().active.sampled(points[:2])
    along = points[1] - points[0]
    fraction = (samples - points[0]) @ along / max(along @ along, 1e-30)
    np.testing.assert_allclose(samples, points[0] + fraction[:, None] * along, atol=1e-9)
    assert np.all(np.diff(fraction) >= 0)


@settings(deadline=None, max_examples=50)
@given(waypoints)
def test_between_samples_no_part_is_further_than_half_of_that_from_where_it_was_seen(points):
    body = bodies().active
    samples = body.sampled(points[:2])
    seen = body.segments(samples)
    fine = samples[:-1, None] + np.linspace(0, 1, 21)[:, None] * np.diff(samples, axis=0)[:, None]
    ends = body.segments(fine.reshape(-1, 6)).reshape(len(samples) - 1, 21, *seen.shape[1:])
    away = [np.linalg.norm(ends - at[:, None], axis=-1).max(axis=(2, 3)) for at in (seen[:-1], seen[1:])]
    assert np.max(np.minimum(*away), initial=0.0) <= BETWEEN_SAMPLES * 1.02


def test_clearance_along_a_path_falls_short_of_that_at_its_samples_by_5_mm_at_most():
    geometry, placement = bodies(), Placement(NOMINAL_T_P_A)
    rng = np.random.default_rng(11)
    for start, goal, q_p in rng.uniform(-1.5, 1.5, (20, 3, 6)):
        sampled, dense = (geometry.active.sampled([start, goal], step) for step in (LARGEST_MOTION, 0.0005))
        reported, true = (geometry.clearance(path, [q_p], placement).min() for path in (sampled, dense))
        assert reported - BETWEEN_SAMPLES <= true <= reported + 0.0003


def test_an_arm_that_stays_has_one_place():
    np.testing.assert_array_equal(np.unique(bodies().active.sampled([HERE[0], HERE[0]]), axis=0), HERE)
    np.testing.assert_array_equal(bodies().active.sampled(HERE), HERE)


# Exact shapes


def test_what_is_clear_for_the_capsules_is_clear_for_the_true_shapes():
    cell = paper_cell().cell
    capsules, exact = CellGeometry.of(cell), ExactCell.of(cell)
    rng = np.random.default_rng(3)
    q_a, q_p = rng.uniform(-1.6, 1.6, (2, 250, 6))
    near = NOMINAL_T_P_A.copy()
    near[0, 3] = 0.8
    by_capsules = capsules.clearance(q_a, q_p, Placement(near))
    truly = np.array([exact.clearance(a, p, near) for a, p in zip(q_a, q_p, strict=True)])
    apart = by_capsules > 0
    assert np.sum(apart) > 30
    assert np.min((truly - by_capsules)[apart]) > -1e-6
    # The tool's capsules are thicker than what they hold, by the corners of a square housing at most.
    assert np.max((truly - by_capsules)[apart]) < 0.04


def test_links_are_the_same_in_both():
    cell = paper_cell().cell
    capsules, exact = CellGeometry.of(cell), ExactCell.of(cell)
    q_a, q_p = np.zeros(6), np.array([np.pi, 0.0, 0.5, 0.0, 0.5, 0.0])  # the passive arm turns its back
    near = NOMINAL_T_P_A.copy()
    near[0, 3] = 0.5
    links_alone = CellGeometry(*(ArmBody(b.chain, b.links, NOTHING, None) for b in (capsules.active, capsules.passive)))
    expected = links_alone.between([q_a], [q_p], Placement(near))[0]
    assert capsules.clearance([q_a], [q_p], Placement(near))[0] == pytest.approx(expected, abs=1e-9)
    assert exact.clearance(q_a, q_p, near) == pytest.approx(expected, abs=1e-6)


# Parts of one arm


def own_parts(clearance: float) -> ArmBody:
    """The passive arm of the paper's cell with its plate, which is to keep this clearance to itself."""
    links = link_capsules(PASSIVE, [0.055, 0.055, 0.055, 0.045, 0.045, 0.045])
    return ArmBody(PASSIVE, links, plate_capsules(6, T_F_T, BOARD.outline), None, clearance=clearance)


def part_distances(body: ArmBody, q: np.ndarray, first: int, second: int) -> np.ndarray:
    """Between links, or a link and all that the arm carries, one by one."""
    segments = body.segments(q)
    others = range(len(body.links), len(body.capsules)) if second == len(body.links) else [second]
    return np.min(
        [
            segment_distance(segments[:, first], segments[:, j]) - body.capsules.radius[first] - body.capsules.radius[j]
            for j in others
        ],
        axis=0,
    )


def test_any_two_parts_of_an_arm_that_some_posture_brings_apart_are_held_against_each_other() -> None:
    body = own_parts(0.02)
    q = np.random.default_rng(3).uniform(-np.pi, np.pi, (600, 6))
    count = len(body.links)
    held = {(i, min(j, count)) for i, j in body.pairs.tolist()}
    for i in range(count):
        for j in range(i + 2, count + 1):
            possible = part_distances(body, q, i, j).max()
            if abs(possible - LEAST_APART) > 0.002:
                assert ((i, j) in held) == (possible > LEAST_APART), (i, j, possible)


def test_parts_built_closer_together_than_the_clearance_need_half_of_what_is_possible() -> None:
    body = own_parts(0.02)
    close = {
        (i, min(j, len(body.links))): r for (i, j), r in zip(body.pairs.tolist(), body.relief, strict=True) if r > 0
    }
    assert close
    q = np.random.default_rng(4).uniform(-np.pi, np.pi, (2000, 6))
    for (i, j), relief in close.items():
        distance = part_distances(body, q, i, j)
        needed = 0.02 + BETWEEN_SAMPLES - relief
        assert needed == pytest.approx(distance.max() / 2, abs=0.002)
        assert 0 < needed < 0.02 + BETWEEN_SAMPLES
    assert np.any(body.relief == 0.0)
    assert not np.any(own_parts(0.0).relief > BETWEEN_SAMPLES)


def test_the_cameras_housing_stands_where_it_is_believed_and_may_be_made_thicker() -> None:
    cell = paper_cell().cell
    nominal, thick = CellGeometry.of(cell), CellGeometry.of(cell, camera_error=0.015)
    moved = CellGeometry.of(cell, T_H_E=cell.nominal.T_H_E @ transform(np.eye(3), [0.0, 0.0, 0.05]))
    np.testing.assert_allclose(thick.active.tool.radius - nominal.active.tool.radius, 0.015)
    np.testing.assert_allclose(thick.active.tool.ends, nominal.active.tool.ends)
    along = cell.nominal.T_H_E[:3, 2] * 0.05
    np.testing.assert_allclose(moved.active.tool.ends - nominal.active.tool.ends, np.broadcast_to(along, (1, 2, 3)))
