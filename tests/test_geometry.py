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
    LARGEST_STEP,
    ArmBody,
    CellGeometry,
    Placement,
    camera_capsule,
    interpolate,
    link_capsules,
    plate_capsules,
    segment_distance,
)
from dualcal_hal.target import Checkerboard
from dualcal_hal.transforms import smallest_rotation
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


def test_the_plates_capsules_cover_the_plate():
    covering = plate_capsules(6, np.eye(4), BOARD.outline)
    low, high = BOARD.outline.min(axis=0), BOARD.outline.max(axis=0)
    grid = np.stack(np.meshgrid(*[np.linspace(low[i], high[i], 41) for i in (0, 1)]), axis=-1).reshape(-1, 2)
    points = np.column_stack([grid, np.zeros(len(grid))])
    distance = segment_distance(np.stack([points, points], axis=1)[:, None], covering.ends[None])
    # A round end leaves only the outermost tip of a plate's corner uncovered.
    assert np.max(np.min(distance, axis=1) - covering.radius[0]) < 0.0075


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


@given(arrays(float, (3, 6), elements=st.floats(-3, 3)))
def test_a_path_is_sampled_in_steps_no_larger_than_told_and_passes_its_waypoints(waypoints):
    samples = interpolate(waypoints)
    assert np.max(np.abs(np.diff(samples, axis=0)), initial=0.0) <= LARGEST_STEP + 1e-12
    for waypoint in waypoints:
        assert np.min(np.max(np.abs(samples - waypoint), axis=1)) < 1e-12
