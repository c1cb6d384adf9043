"""The refined estimate from captures alone: no nominal, unknown order, and sets that say too little."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualcal_hal.kinematics import Chain
from dualcal_hal.transforms import Array, inverse, rotation_from_vector, transform
from procedures.estimation import Degenerate
from procedures.estimation.refined.closed_form import solve
from procedures.estimation.refined.data import CaptureArrays, Noise
from procedures.estimation.refined.estimate import refined
from procedures.estimation.refined.fit import minimise
from procedures.estimation.refined.model import Model
from procedures.estimation.refined.motion import moved
from procedures.estimation.refined.resection import few_point_poses, plane_poses, resect
from procedures.estimation.refined.start import camera_candidates
from tools.benchmarks.refined import LIMITS, NOISES, Cell, boards, cell_of, find, random_cell, reference

NOISE = NOISES[0]
seeds = st.integers(0, 2**32 - 1)


def any_pose(rng: np.random.Generator, *shape: int) -> Array:
    return transform(rotation_from_vector(rng.normal(0, 2, (*shape, 3))), rng.normal(size=(*shape, 3)))


class TestClosedForm:
    @settings(max_examples=50, deadline=None)
    @given(seeds, st.integers(3, 8))
    def test_exact_pairs_give_both_transforms(self, seed: int, count: int) -> None:
        rng = np.random.default_rng(seed)
        X, Y, A = any_pose(rng), any_pose(rng), any_pose(rng, count)
        found = solve(A, inverse(A @ X) @ Y)
        np.testing.assert_allclose(found[0], X, atol=1e-5)
        np.testing.assert_allclose(found[1], Y, atol=1e-5)


class TestResection:
    def test_a_target_that_is_not_plane_gives_the_cameras_pose(self) -> None:
        rng = np.random.default_rng(0)
        T_E_P = transform(rotation_from_vector([0.3, -0.2, 0.5]), [0.1, 0.2, 0.1])
        in_camera = rng.uniform([-0.1, -0.1, 0.3], [0.1, 0.1, 0.5], (3, 9, 3))
        points = (in_camera - T_E_P[:3, 3]) @ T_E_P[:3, :3]
        rays = in_camera[..., :2] / in_camera[..., 2:]
        found = resect(points, rays, np.ones((3, 9)), np.zeros(3, dtype=np.intp), 1)
        np.testing.assert_allclose(found[0], T_E_P, atol=1e-9)

    @settings(max_examples=50, deadline=None)
    @given(seeds, st.integers(5, 8))
    def test_the_cameras_pose_is_among_those_from_few_points(self, seed: int, count: int) -> None:
        rng = np.random.default_rng(seed)
        T_E_P = any_pose(rng)
        in_camera = rng.uniform([-0.1, -0.1, 0.3], [0.1, 0.1, 0.5], (count, 3))
        points = (in_camera - T_E_P[:3, 3]) @ T_E_P[:3, :3]
        found = few_point_poses(points, in_camera[:, :2] / in_camera[:, 2:])
        assert np.abs(found - T_E_P).max(axis=(1, 2)).min() < 0.1

    def test_a_plane_board_gives_its_pose_and_the_twin(self) -> None:
        corners = reference().knowns.corners
        T_E_T = transform(rotation_from_vector([np.pi - 0.5, 0.1, 0.2]), [0.02, -0.01, 0.4])
        in_camera = corners @ T_E_T[:3, :3].T + T_E_T[:3, 3]
        first, twin = plane_poses(corners, in_camera[None, :, :2] / in_camera[None, :, 2:], np.ones((1, 9), bool))[0]
        np.testing.assert_allclose(first, T_E_T, atol=1e-9)
        sight = T_E_T[:3, 3] / np.linalg.norm(T_E_T[:3, 3])
        assert twin[:3, 2] @ sight == pytest.approx(first[:3, 2] @ sight)
        assert np.linalg.norm(twin[:3, 2] - first[:3, 2]) > 0.1


class TestWithoutNominal:
    def test_the_reference_captures_need_none(self) -> None:
        cell = reference()
        found = refined(cell.noisy(np.random.default_rng(0), NOISE), cell.knowns, NOISE)
        error = cell.error(found.T_P_A, found.T_H_E)
        assert error @ np.linalg.solve(found.covariance, error) < 40
        assert found.warnings == ()
        assert found.dropped == ()

    @pytest.mark.parametrize("positions", [3, 4])
    def test_random_cells_come_to_the_optimum_that_is_reached_from_the_truth(self, positions: int) -> None:
        rng = np.random.default_rng(positions)
        for _ in range(4):
            found = find(random_cell(rng, 3, positions), NOISE, rng)
            assert found.optimum
            assert found.warned

    def test_one_position_a_constraint_is_enough(self) -> None:
        cell = reference()
        data = cell.noisy(np.random.default_rng(0), NOISE)
        first = np.unique(data.arrivals, return_index=True)[1]
        found = refined(data.only(np.isin(np.arange(len(data)), first)), cell.knowns, NOISE)
        error = cell.error(found.T_P_A, found.T_H_E)
        assert error @ np.linalg.solve(found.covariance, error) < 40

    def test_board_poses_handed_in_serve_as_a_start_where_the_plane_alone_would_not(self) -> None:
        cell = reference()
        data = cell.noisy(np.random.default_rng(0), NOISE)
        first = np.isin(np.arange(len(data)), np.unique(data.arrivals, return_index=True)[1])
        data = data.only(first)
        T_P_E = cell.T_P_A @ cell.knowns.active.forward(data.active) @ cell.T_H_E
        poses = inverse(T_P_E) @ cell.knowns.passive.forward(data.passive) @ cell.knowns.T_F_T
        hidden = data.pixels.copy()
        hidden[:, 2:] = np.nan  # two points show no pose of the camera
        with pytest.raises(Degenerate, match="at no arrival three points were seen"):
            refined(replace(data, pixels=hidden), cell.knowns, NOISE)
        found = refined(replace(data, pixels=hidden, board_poses=list(poses)), cell.knowns, NOISE)
        error = cell.error(found.T_P_A, found.T_H_E)
        assert error @ np.linalg.solve(found.covariance, error) < 40

    @settings(max_examples=20, deadline=None)
    @given(st.floats(-15, -1), st.integers(0, 8), st.floats(-0.5, 0.5))
    def test_a_candidate_with_a_corner_all_but_in_the_cameras_plane_is_just_a_bad_one(
        self, depth: float, corner: int, tilt: float
    ) -> None:
        cell = reference()
        knowns = replace(cell.knowns, distortion=np.array([-0.2, 0.05, 1e-3, -1e-3, 0.0]))
        board = transform(rotation_from_vector([tilt, 1.0, 0.0]), np.zeros(3))
        # As near to the plane as that, and the others in front of it or behind it.
        board[:3, 3] = [0.1, 0.1, 10**depth] - board[:3, :3] @ knowns.corners[corner] * [0, 0, 1]
        data = replace(cell.data, board_poses=[board] * len(cell.data))
        poses = camera_candidates(Model(data, knowns, NOISE), data.order, data.board_poses, True)
        assert np.isfinite(poses.normal).all()
        found = refined(replace(data, pixels=replace(cell, knowns=knowns).seen()), knowns, NOISE)
        np.testing.assert_allclose(cell.error(found.T_P_A, found.T_H_E), 0, atol=1e-6)

    def test_unknown_order_is_found(self) -> None:
        cell = reference()
        rng = np.random.default_rng(0)
        data = cell.noisy(rng, NOISE)
        turned = rng.uniform(size=len(data)) < 0.5
        shown = replace(data.turned(turned), order_known=np.zeros(len(data), bool))
        found, plain = refined(shown, cell.knowns, NOISE), refined(data, cell.knowns, NOISE)
        np.testing.assert_array_equal(found.flipped, turned)
        np.testing.assert_allclose(found.T_P_A, plain.T_P_A, atol=1e-6)

    def test_a_distorting_lens_is_no_matter(self) -> None:
        cell = reference()
        lens = replace(cell.knowns, distortion=np.array([-0.2, 0.05, 1e-3, -1e-3, 0.0]))
        cell = replace(cell, knowns=lens)
        cell = replace(cell, data=replace(cell.data, pixels=cell.seen()))
        found = refined(cell.data, cell.knowns, NOISE)
        np.testing.assert_allclose(cell.error(found.T_P_A, found.T_H_E), 0, atol=1e-7)


def showing(cell: Cell, corners: list[int], seed: int) -> CaptureArrays:
    """Noisy captures of which nothing but these corners of their boards was seen."""
    data = cell.noisy(np.random.default_rng(seed), NOISE)
    pixels = np.full_like(data.pixels, np.nan)
    pixels[:, corners] = data.pixels[:, corners]
    return replace(data, pixels=pixels)


class TestFewPointsOfEachBoard:
    """The captures of an arrival are one target, however little each of them shows of its board."""

    @pytest.mark.parametrize("positions", [3, 4, 8])
    @pytest.mark.parametrize("corners", [[0], [3, 4]], ids=["one corner", "two corners"])
    def test_they_lead_to_the_optimum_that_is_reached_from_the_truth(self, positions: int, corners: list[int]) -> None:
        cell = random_cell(np.random.default_rng(positions), 7, positions)
        data = showing(cell, corners, positions)
        found = refined(data, cell.knowns, NOISE, further_starts=[(np.eye(4), np.eye(4))])
        model = Model(data, cell.knowns, NOISE)
        best = minimise(model, model.state(cell.T_P_A, cell.T_H_E))
        assert found.dropped == ()
        assert found.cost == pytest.approx(best.at.cost, rel=1e-6)
        error = cell.error(found.T_P_A, found.T_H_E)
        assert error @ np.linalg.solve(found.covariance, error) < 40

    def test_arrivals_of_fewer_points_than_show_a_pose_only_join_later(self) -> None:
        cell = random_cell(np.random.default_rng(0), 7, 8)
        data = showing(cell, [0], 0)
        first = np.unique(data.arrivals, return_index=True)[1]
        data.pixels[(data.arrivals >= 5) & ~np.isin(np.arange(len(data)), first)] = np.nan
        found = refined(data, cell.knowns, NOISE)
        assert found.used.sum() == 5 * 8 + 2
        error = cell.error(found.T_P_A, found.T_H_E)
        assert error @ np.linalg.solve(found.covariance, error) < 40

    @pytest.mark.parametrize("positions", [4, 8])
    def test_feature_points_on_the_optical_axis_are_refused_with_what_helps(self, positions: int) -> None:
        """Turned about that axis or shifted along it the camera sees them alike."""
        cell = random_cell(np.random.default_rng(0), 7, positions)
        data = showing(cell, [4], 0)
        model = Model(data, cell.knowns, NOISE)
        sigmas = np.sqrt(np.diag(np.linalg.inv(model.linearised(model.state(cell.T_P_A, cell.T_H_E)).normal)))
        assert sigmas[8] > 0.01
        assert sigmas[11] > np.radians(1)
        with pytest.raises(Degenerate, match=r"lie on one line.*captures that show more corners.*method paper"):
            refined(data, cell.knowns, NOISE)


def turned_to(turns: Array, shifts: Array | None = None, seed: int = 0, most_tilt: float = 45.0) -> Cell:
    """The reference cell with the camera turned by rotation vectors (n, 3), in its own frame, from where it first
    stood, and shifted there.
    """
    cell, rng = reference(), np.random.default_rng(seed)
    chain, first = cell.knowns.active, cell.data.active[0]
    assert isinstance(chain, Chain)
    shifts = rng.uniform(-0.03, 0.03, (len(turns), 3)) if shifts is None else shifts
    T_A_E = moved(chain.forward(first) @ cell.T_H_E, np.concatenate([shifts, turns], axis=1))
    active, reached = chain.inverse(T_A_E @ inverse(cell.T_H_E), np.tile(first, (len(turns), 1)), *LIMITS.T)
    passive, found = boards(rng, cell.knowns, cell.T_P_A @ T_A_E, 3, most_tilt)
    good = reached & found
    return cell_of(cell.knowns, cell.T_P_A, cell.T_H_E, active[good], passive[good])


FAN = np.radians(np.linspace(-20, 20, 12))[:, None]
ROLLS = np.radians(np.tile([-30, 20, 0, 35], 3))[:, None]


class TestSecondSolution:
    TURNS = np.random.default_rng(0).uniform(-0.4, 0.4, (10, 3))

    def test_boards_square_to_the_axis_and_of_unknown_order_leave_two_both_of_which_are_told(self) -> None:
        """A camera turned by half a turn about its axis sees them alike."""
        cell = turned_to(self.TURNS, most_tilt=0.0)
        data = replace(cell.noisy(np.random.default_rng(0), NOISE), order_known=np.zeros(len(cell.data), bool))
        found = refined(data, cell.knowns, NOISE)
        assert len(found.alternatives) == 1
        other = found.alternatives[0]
        assert 1 <= other.ratio < 1.5
        half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
        np.testing.assert_allclose(found.T_H_E, other.T_H_E @ half_turn, atol=2e-3)
        np.testing.assert_allclose(found.T_P_A, other.T_P_A, atol=2e-3)
        assert any("second solution" in words for words in found.warnings)

    def test_there_is_none_where_the_order_is_known_or_boards_are_tilted(self) -> None:
        square, tilted = turned_to(self.TURNS, most_tilt=0.0), turned_to(self.TURNS)
        unknown = np.zeros(len(tilted.data), dtype=bool)
        for cell, data in ((square, square.data), (tilted, replace(tilted.data, order_known=unknown))):
            found = refined(data, cell.knowns, NOISE)
            assert found.alternatives == ()
            np.testing.assert_allclose(cell.error(found.T_P_A, found.T_H_E), 0, atol=1e-6)

    def test_a_bad_further_start_does_no_harm(self) -> None:
        cell = reference()
        data = cell.noisy(np.random.default_rng(0), NOISE)
        data.pixels[3] += 9
        plain = refined(data, cell.knowns, NOISE)
        other = refined(data, cell.knowns, NOISE, further_starts=[(np.eye(4), np.eye(4))])
        np.testing.assert_allclose(other.T_P_A, plain.T_P_A, atol=1e-7)
        assert np.flatnonzero(~other.used).tolist() == [3]


class TestSetsThatSayTooLittle:
    @pytest.mark.parametrize("noise", [None, NOISE], ids=["exact", "noise"])
    @pytest.mark.parametrize(
        ("turns", "reason"),
        [
            (FAN * [0, 1, 0], "about one axis only"),
            (ROLLS * [0, 0, 1], "optical axes of all arrivals are parallel"),
            (FAN * [0, 0, 0], "was only shifted"),
        ],
    )
    def test_they_are_refused_with_the_reason(self, turns: Array, reason: str, noise: Noise | None) -> None:
        cell = turned_to(turns)
        assert len(np.unique(cell.data.arrivals)) >= 5
        data = cell.data if noise is None else cell.noisy(np.random.default_rng(0), noise)
        with pytest.raises(Degenerate, match=reason):
            refined(data, cell.knowns, NOISE)

    def test_a_joint_noise_larger_than_the_turns_of_the_flange_is_named(self) -> None:
        cell = reference()
        with pytest.raises(
            Degenerate, match=r"a joint noise of 3000 mrad \(1 sigma\) hides how the active flange turns"
        ):
            refined(cell.data, cell.knowns, Noise(0.1, 3.0, 3.0))

    @pytest.mark.parametrize("arrivals", [0, 1, 2])
    def test_fewer_than_three_constraints_are_refused(self, arrivals: int) -> None:
        cell = reference()
        data = cell.data.only(cell.data.arrivals < arrivals)
        with pytest.raises(Degenerate, match=f"{arrivals} arrival"):
            refined(data, cell.knowns, NOISE)

    def test_two_constraints_come_to_twice_are_still_two(self) -> None:
        cell = reference()
        data = cell.data.only(cell.data.arrivals < 2)
        twice = replace(data, arrivals=np.arange(len(data)))
        with pytest.raises(Degenerate, match="only two orientations"):
            refined(twice, cell.knowns, NOISE)

    def test_captures_without_corners_do_not_count(self) -> None:
        cell = reference()
        pixels = np.where(cell.data.arrivals[:, None, None] < 2, cell.data.pixels, np.nan)
        with pytest.raises(Degenerate, match="2 arrivals"):
            refined(replace(cell.data, pixels=pixels), cell.knowns, NOISE)


class TestUnusualButGoodSets:
    def test_axes_through_one_point(self) -> None:
        turns = np.random.default_rng(0).uniform(-0.4, 0.4, (10, 3))
        shifts = [0, 0, 0.4] - rotation_from_vector(turns) @ [0, 0, 0.4]
        self.is_found(turned_to(turns, shifts), ())

    def test_axes_in_one_plane_with_roll(self) -> None:
        turns = FAN * [0, 1, 0] + ROLLS * [0, 0, 1]
        self.is_found(turned_to(turns), ())

    def test_a_fan_with_five_degrees_about_a_second_axis_is_accepted_with_a_warning(self) -> None:
        sides = np.radians(np.tile([2.5, -2.5], 6))[:, None]
        self.is_found(turned_to(FAN * [0, 1, 0] + sides * [1, 0, 0]), ("weak",))

    def is_found(self, cell: Cell, warnings: tuple[str, ...]) -> None:
        found = refined(cell.noisy(np.random.default_rng(0), NOISE), cell.knowns, NOISE)
        error = cell.error(found.T_P_A, found.T_H_E)
        assert error @ np.linalg.solve(found.covariance, error) < 40
        assert tuple(words.split(":")[0] for words in found.warnings if words.startswith("weak")) == warnings


def test_readings_that_differ_within_an_arrival_make_two() -> None:
    cell = reference()
    data: CaptureArrays = cell.data
    together = replace(data, arrivals=np.zeros(len(data), dtype=np.intp))
    found = refined(together, cell.knowns, NOISE)
    np.testing.assert_allclose(cell.error(found.T_P_A, found.T_H_E), 0, atol=1e-7)
