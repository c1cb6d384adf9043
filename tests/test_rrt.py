"""Two trees find a way through a plane with walls, and shortcuts make it shorter."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from procedures.planning.rrt import connect, shorten

START, GOAL = np.array([-1.0, 0.0]), np.array([1.0, 0.0])
GAP = 0.5
"""The wall along y at x = 0 is open above this."""


SPACING = 0.02
"""No two samples of a move are further apart."""


def near_the_wall(points):
    return (np.abs(points[:, 0]) < 0.05 + SPACING) & (points[:, 1] < GAP + SPACING)


def nowhere_open(points):
    return np.abs(points[:, 0]) < 0.05


def advance(blocked):
    def towards(here, target):
        count = 1 + int(np.linalg.norm(target - here) / SPACING)
        steps = here + (np.arange(1, count + 1) / count)[:, None] * (target - here)
        steps[-1] = target
        hits = np.flatnonzero(blocked(steps))
        free = steps[: hits[0]] if len(hits) else steps
        return [free[-1]] if len(free) else []

    return towards


def samples(seed, count=200):
    return np.random.default_rng(seed).uniform(-2, 2, (count, 2))


def is_free(path):
    """Exactly: where a segment passes between the wall's two faces it is above the wall."""
    for one, other in itertools.pairwise(path):
        run = other[0] - one[0]
        faces = (np.array([-0.05, 0.05]) - one[0]) / run if run else np.array([0.0, 1.0])
        enter, leave = np.clip(np.sort(faces), 0.0, 1.0)
        passes = leave > enter if run else abs(one[0]) < 0.05
        if passes and np.any((one + np.array([[enter], [leave]]) * (other - one))[:, 1] < GAP):
            return False
    return True


def length(path):
    return float(np.sum(np.linalg.norm(np.diff(path, axis=0), axis=1)))


def straight(one, other):
    return [np.array([one, other])]


@given(st.integers(0, 2**32))
def test_a_way_around_a_wall_is_found_from_end_to_end_and_touches_nothing(seed):
    path = connect(START, GOAL, samples(seed), advance(near_the_wall), np.ones(2))
    assert path is not None
    np.testing.assert_array_equal(path[[0, -1]], [START, GOAL])
    assert is_free(path)


def test_a_closed_wall_is_given_up_when_the_samples_are_used_up():
    left = iter(samples(0, 50))
    assert connect(START, GOAL, left, advance(nowhere_open), np.ones(2)) is None
    assert next(left, None) is None


@given(st.integers(0, 2**32))
def test_shortcuts_keep_the_ends_and_the_way_free_and_never_lengthen_it(seed):
    path = connect(START, GOAL, samples(seed), advance(near_the_wall), np.ones(2))
    draws = np.random.default_rng(seed).random((30, 2))
    shorter = shorten(path, straight, is_free, length, draws)
    np.testing.assert_array_equal(shorter[[0, -1]], [START, GOAL])
    assert is_free(shorter)
    assert length(shorter) <= length(path)


def test_enough_shortcuts_come_near_the_shortest_way():
    path = np.array([START, [-1.5, 1.0], [0.0, 1.5], [1.5, 1.5], GOAL])
    shorter = shorten(path, straight, is_free, length, np.random.default_rng(1).random((300, 2)))
    shortest = 2 * np.hypot(0.95, GAP) + 0.1
    assert length(shorter) < 1.05 * shortest


@pytest.mark.parametrize("scale", [np.array([1.0, 100.0]), np.array([100.0, 1.0])])
def test_which_point_is_nearest_follows_the_scale_of_the_axes(scale):
    asked = []

    def towards(here, target):
        asked.append(here)
        return [target] if np.array_equal(target, [1.0, 3.0]) and not np.any(here) else []

    # The first tree has (0, 0) and (1, 3) when it is asked to grow towards (2, 0).
    connect(np.zeros(2), np.full(2, 9.0), np.array([[1.0, 3.0], [9.0, 9.0], [2.0, 0.0]]), towards, scale)
    np.testing.assert_array_equal(asked[-2], [1.0, 3.0] if scale[1] > scale[0] else [0.0, 0.0])
