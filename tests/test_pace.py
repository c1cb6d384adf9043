"""How fast arms may be."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualcal_hal.geometry import CellGeometry
from dualcal_hal.limits import JointLimits
from dualcal_hal.pace import FULL_PACE, REDUCED_SPEED, Pace, fastest_part, part_speed
from dualcal_hal.trajectory import Trajectory
from tests.cells import paper_cell

CELL = paper_cell().cell
BODY = CellGeometry.of(CELL).active
LIMITS = JointLimits.of(CELL.active)
angles = st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6).map(tuple)


def observed_speeds(path, start):
    """Of the fastest part, along the whole motion as an arm makes it."""
    trajectory = Trajectory(np.array(start), np.array(path.acceleration))
    trajectory.follow(path, 0.0)
    times = np.linspace(0, max(trajectory.end, 0.1), 400)
    return [part_speed(BODY, *(trajectory.sample(t)[0] for t in pair), pair[1] - pair[0]) for pair in pairwise(times)]


@settings(max_examples=25)
@given(angles, st.lists(angles, min_size=1, max_size=3).map(tuple))
def test_no_part_is_faster_than_it_may_be(start, waypoints):
    path = Pace(largest=REDUCED_SPEED).path(start, waypoints, LIMITS, BODY)
    assert max(observed_speeds(path, start)) <= REDUCED_SPEED * (1 + 1e-3)


def test_a_way_is_no_slower_than_it_has_to_be():
    start, goal = (0.0, 0.0, 1.0, 0.0, 0.5, 0.0), (1.5, 0.3, 1.0, 0.0, 0.5, 0.0)
    path = Pace(largest=REDUCED_SPEED).path(start, (goal,), LIMITS, BODY)
    assert max(observed_speeds(path, start)) >= REDUCED_SPEED * 0.93


def test_the_share_is_below_all_other_limits():
    start, goal = (0.0,) * 6, (1.0,) * 6
    half = Pace(0.5, REDUCED_SPEED).path(start, (goal,), LIMITS, BODY)
    assert REDUCED_SPEED * 0.48 < fastest_part(BODY, start, half) < REDUCED_SPEED / 2
    np.testing.assert_allclose(Pace(0.5).path(start, (goal,), LIMITS, BODY).speed, 0.5 * LIMITS.speed)


def test_at_full_pace_arms_are_as_fast_as_they_are():
    np.testing.assert_array_equal(FULL_PACE.path((0.0,) * 6, ((1.0,) * 6,), LIMITS, BODY).speed, LIMITS.speed)
    assert FULL_PACE.bound is FULL_PACE.to_be_confirmed is None


def test_an_arm_that_stays_where_it_is_has_no_speed():
    path = Pace(largest=REDUCED_SPEED).path((0.5,) * 6, ((0.5,) * 6,), LIMITS, BODY)
    assert fastest_part(BODY, (0.5,) * 6, path) == 0.0


def test_a_controller_with_a_speed_of_its_own_has_to_keep_the_reduced_speed_or_the_share_of_it():
    assert Pace(largest=REDUCED_SPEED).to_be_confirmed == REDUCED_SPEED
    assert Pace(share=0.2).to_be_confirmed == pytest.approx(0.05)


def test_a_way_too_short_for_the_speed_is_not_slowed():
    start = (0.0, 0.0, 1.0, 0.0, 0.5, 0.0)
    path = Pace(largest=REDUCED_SPEED).path(start, (tuple(q + 1e-3 for q in start),), LIMITS, BODY)
    np.testing.assert_array_equal(path.speed, LIMITS.speed)
    assert max(observed_speeds(path, start)) <= fastest_part(BODY, start, path) * (1 + 1e-3) < REDUCED_SPEED
