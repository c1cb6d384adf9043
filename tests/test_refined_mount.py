"""Both transforms and the target's mount from captures, with nothing given of any."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualcal_hal.transforms import Array, inverse, rotation_from_vector, transform
from procedures.estimation import Degenerate
from procedures.estimation.refined import Knowns, Refined, refined, target_mount
from procedures.estimation.refined.data import CaptureArrays
from procedures.estimation.refined.mount import find_mount
from tools.benchmarks.refined import NOISES, cell_of, contaminated, find_with_free_mount, random_cell, reference

NOISE = NOISES[0]
FREE = target_mount(np.inf, np.inf)
OFF = transform(rotation_from_vector(np.radians([30, -40, 33])), [0.2, -0.1, 0.2])
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])


def given() -> Knowns:
    """The reference cell's, but with a mount that is off by 60 degrees and 0.3 m."""
    return replace(reference().knowns, T_F_T=reference().knowns.T_F_T @ OFF)


def found_from(data: CaptureArrays, knowns: Knowns | None = None) -> Refined:
    return refined(data, given() if knowns is None else knowns, NOISE, inexact=[FREE])


def normalised(found: Refined) -> float:
    """The squared error of all eighteen numbers."""
    cell = reference()
    error = np.concatenate([cell.error(found.T_P_A, found.T_H_E), cell.mount_error(found.knowns.T_F_T)])
    return float(error @ np.linalg.solve(found.joint_covariance, error))


@pytest.mark.parametrize("positions", [3, 4])
def test_random_cells_come_to_the_optimum_that_is_reached_from_the_truth(positions: int) -> None:
    rng = np.random.default_rng(positions)
    found = [find_with_free_mount(random_cell(rng, 3, positions), NOISE, rng) for _ in range(3)]
    assert all(one.optimum for one in found)
    assert np.mean([one.squares for one in found]) < 40


def test_all_eighteen_numbers_are_found_and_the_mounts_counted_from_what_was_given() -> None:
    found = found_from(reference().noisy(np.random.default_rng(0), NOISE))
    assert normalised(found) < 45
    expected = inverse(OFF)
    np.testing.assert_allclose([known.value for known in found.known[:3]], expected[:3, 3], atol=1e-3)
    np.testing.assert_allclose(
        rotation_from_vector([known.value for known in found.known[3:]]), expected[:3, :3], atol=1e-2
    )
    assert all(known.seen for known in found.known)


def test_what_is_given_of_the_mount_does_not_matter() -> None:
    data = reference().noisy(np.random.default_rng(0), NOISE)
    far, near = found_from(data), found_from(data, reference().knowns)
    np.testing.assert_allclose(far.T_P_A, near.T_P_A, atol=1e-6)
    np.testing.assert_allclose(far.knowns.T_F_T, near.knowns.T_F_T, atol=1e-6)


def test_captures_that_are_wrong_are_dropped() -> None:
    data, wrong = contaminated(np.random.default_rng(1), reference().noisy(np.random.default_rng(0), NOISE))
    found = found_from(data)
    np.testing.assert_array_equal(~found.used, wrong)
    assert normalised(found) < 45


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_unknown_order_is_found(share: float) -> None:
    """Where no order is known, that mount of two half a turn apart which is nearer to the given one."""
    rng = np.random.default_rng(0)
    data = reference().noisy(rng, NOISE)
    unknown = rng.uniform(size=len(data)) < share
    turned = unknown & (rng.uniform(size=len(data)) < 0.5)
    near = replace(reference().knowns, T_F_T=moved_a_little(reference().knowns.T_F_T))
    found = found_from(replace(data.turned(turned), order_known=~unknown), near)
    np.testing.assert_array_equal(found.flipped, turned)
    assert normalised(found) < 45


def moved_a_little(T: Array) -> Array:
    return np.asarray(T @ transform(rotation_from_vector([0.2, 0.3, -0.4]), [0.05, 0.02, 0.1]))


def test_board_poses_serve_where_the_corners_alone_would_not() -> None:
    cell = reference()
    data = cell.noisy(np.random.default_rng(0), NOISE)
    T_P_E = cell.T_P_A @ cell.knowns.active.forward(data.active) @ cell.T_H_E
    poses = inverse(T_P_E) @ cell.knowns.passive.forward(data.passive) @ cell.knowns.T_F_T
    hidden = data.pixels.copy()
    hidden[:, [1, 3, 4, 5, 7, 8]] = np.nan  # three corners are too few for a homography
    assert find_mount(replace(data, pixels=hidden), given(), NOISE) is None
    assert normalised(found_from(replace(data, pixels=hidden, board_poses=list(poses)))) < 45


def test_a_passive_arm_that_turns_one_joint_only_does_not_show_the_mount() -> None:
    """Along and about that joint's axis the mount is anywhere."""
    cell = reference()
    passive = np.tile(cell.data.passive[:1], (len(cell.data), 1))
    passive[:, 0] += np.linspace(-0.02, 0.02, len(passive))
    shown = cell_of(cell.knowns, cell.T_P_A, cell.T_H_E, cell.data.active[::4], passive.reshape(7, 4, 6))
    with pytest.raises(Degenerate):
        found_from(shown.data)
