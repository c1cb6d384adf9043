"""The optical axis as a line through aligned points."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from procedures.estimation import Degenerate, fit_line

seeds = st.integers(0, 2**32 - 1)


def unit(rng: np.random.Generator) -> np.ndarray:
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


@given(seeds, st.integers(3, 8))
def test_exact_points_give_back_their_line(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    direction, origin = unit(rng), rng.uniform(-2, 2, 3)
    points = origin + np.linspace(0.3, 0.5, count)[:, None] * direction
    line = fit_line(rng.permutation(points), direction)
    np.testing.assert_allclose(line.direction, direction, atol=1e-12)
    assert np.linalg.norm(np.cross(line.point - origin, direction)) < 1e-12
    assert line.rms < 1e-12


@given(seeds)
def test_the_line_follows_a_rigid_motion_of_its_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    direction = unit(rng)
    points = np.linspace(0, 0.2, 4)[:, None] * direction + rng.normal(0, 1e-3, (4, 3))
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    still = fit_line(points, direction)
    moved = fit_line(points @ turn.T + [1, 2, 3], turn @ direction)
    np.testing.assert_allclose(moved.direction, turn @ still.direction, atol=1e-9)
    assert moved.rms == pytest.approx(still.rms, rel=1e-6)


@given(seeds)
def test_the_direction_looks_to_the_side_asked_for_however_the_points_are_ordered(seed: int) -> None:
    rng = np.random.default_rng(seed)
    direction = unit(rng)
    towards = direction + 0.5 * unit(rng)
    points = rng.permutation(np.linspace(0.5, 0.3, 4))[:, None] * direction
    assert fit_line(points, towards).direction @ direction > 0
    assert fit_line(points, -towards).direction @ direction < 0


def test_the_rms_is_the_distance_of_the_points_from_the_line() -> None:
    points = np.array([[0, 0.001, 0], [0.1, -0.001, 0], [0.2, -0.001, 0], [0.3, 0.001, 0]])
    assert fit_line(points, [1, 0, 0]).rms == pytest.approx(0.001, rel=1e-9)


def test_two_positions_are_refused() -> None:
    with pytest.raises(Degenerate, match="2 positions, at least 3"):
        fit_line([[0, 0, 0], [0.2, 0, 0]], [1, 0, 0])


@pytest.mark.parametrize("noise", [0.0, 1e-4])
@pytest.mark.parametrize("count", [3, 7])
def test_coincident_positions_are_refused_with_and_without_noise(noise: float, count: int) -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        with pytest.raises(Degenerate, match="coincident positions: only 1 of"):
            fit_line(rng.normal([1, 2, 3], noise, (count, 3)), [1, 0, 0])


def test_positions_that_coincide_in_pairs_count_once() -> None:
    with pytest.raises(Degenerate, match="only 2 of 4"):
        fit_line([[0, 0, 0], [1e-4, 0, 0], [0.2, 0, 0], [0.2, 1e-4, 0]], [1, 0, 0])
    fit_line([[0, 0, 0], [1e-4, 0, 0], [0.1, 0, 0], [0.2, 1e-4, 0]], [1, 0, 0])


def test_positions_that_are_not_on_a_line_are_refused() -> None:
    with pytest.raises(Degenerate, match="do not lie on a line"):
        fit_line([[0, 0, 0], [0.1, 0.05, 0], [0.2, 0, 0]], [1, 0, 0])
