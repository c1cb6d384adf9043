"""The paper's two-step estimator on the reference captures, on random cells, and on sets that cannot work."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualcal_hal.transforms import Array, rotation_angle, rotation_from_vector, transform
from procedures.estimation import Degenerate, Estimate, estimate, mismatch
from procedures.estimation.rotation import MOST_ALTERNATIONS
from tests.reference_cell import (
    EXPECTED,
    NOMINAL_T_H_E,
    NOMINAL_T_P_A,
    T_H_E,
    T_P_A,
    Aligned,
    Data,
    aligned,
    reference,
)

seeds = st.integers(0, 2**32 - 1)


def run(data: Data | Aligned, nominal_T_P_A: Array = NOMINAL_T_P_A, nominal_T_H_E: Array = NOMINAL_T_H_E) -> Estimate:
    return estimate(data.T_A_H, data.T_P_T, data.constraints, nominal_T_P_A, nominal_T_H_E)


def angle(T: Array, truth: Array) -> float:
    return float(rotation_angle(T[:3, :3], truth[:3, :3]))


def unit(v: Array) -> Array:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


class TestReference:
    def test_transforms_are_found_to_a_millionth_of_a_degree_and_of_a_millimetre(self) -> None:
        found = run(reference("calibration"))
        assert np.degrees(angle(found.T_P_A, T_P_A)) < 1e-6
        assert np.degrees(angle(found.T_H_E, T_H_E)) < 1e-6
        assert 1e3 * np.linalg.norm(found.T_P_A[:3, 3] - T_P_A[:3, 3]) < 1e-6
        shift = found.T_H_E[:3, 3] - T_H_E[:3, 3]
        assert 1e3 * np.linalg.norm(np.cross(shift, T_H_E[:3, 2])) < 1e-6
        np.testing.assert_allclose(found.optical_axis, EXPECTED["optical_axis_in_active_flange"], atol=1e-8)

    def test_the_camera_along_its_axis_keeps_the_nominal_value(self) -> None:
        found = run(reference("calibration"))
        along = (found.T_H_E[:3, 3] - NOMINAL_T_H_E[:3, 3]) @ found.optical_axis
        assert abs(along) < 1e-12

    def test_mismatch_before_and_after_is_as_expected(self) -> None:
        data = reference("verification")
        found = run(reference("calibration"))
        before = 1e3 * mismatch(NOMINAL_T_P_A, NOMINAL_T_H_E, data.T_A_H, data.p_P_T)
        expected = EXPECTED["mismatch_before_mm"]
        assert before.mean() == pytest.approx(expected["mean"], abs=1e-9)
        assert np.sqrt(np.mean(before**2)) == pytest.approx(expected["rms"], abs=1e-9)
        assert before.max() == pytest.approx(expected["max"], abs=1e-9)
        assert 1e3 * mismatch(found.T_P_A, found.T_H_E, data.T_A_H, data.p_P_T).max() < 1e-6

    def test_it_converges_in_about_thirteen_iterations_whose_history_ends_at_the_result(self) -> None:
        found = run(reference("calibration"))
        assert 10 <= len(found.iterations) <= 16
        updates = [iteration.rotation_update for iteration in found.iterations]
        assert updates[-1] < 1e-10 < updates[-2]
        np.testing.assert_allclose(found.iterations[-1].rotation_error, [-0.0122, 0.0805, -0.1579], atol=1e-9)
        np.testing.assert_array_equal(found.iterations[-1].optical_axis, found.optical_axis)

    def test_translation_step_has_five_significant_singular_values(self) -> None:
        s = run(reference("calibration")).translation_singular_values
        np.testing.assert_allclose(s[:5], [6.1, 5.9, 4.2, 4.1, 2.5], atol=0.06)
        assert s[5] < 1e-8

    def test_the_unobservable_directions_move_no_predicted_axis(self) -> None:
        data = reference("verification")
        found = run(reference("calibration"))
        off_axis = np.array([0.01, 0.02, 0.03])
        before = mismatch(found.T_P_A, found.T_H_E, data.T_A_H, data.p_P_T + off_axis)
        assert len(found.unobservable) == 2
        for unobservable in found.unobservable:
            step = 0.1 * np.array(unobservable.direction)
            moved = found.T_H_E @ transform(rotation_from_vector(step[3:]), step[:3])
            after = mismatch(found.T_P_A, moved, data.T_A_H, data.p_P_T + off_axis)
            np.testing.assert_allclose(after, before, atol=1e-12)

    def test_a_capture_order_of_its_own_changes_nothing(self) -> None:
        data = reference("calibration")
        order = np.random.default_rng(0).permutation(len(data.constraints))
        shuffled = Data(data.active[order], data.passive[order], tuple(data.constraints[i] for i in order))
        np.testing.assert_allclose(run(shuffled).T_P_A, run(data).T_P_A, atol=1e-9)


class TestNoise:
    def test_the_camera_along_its_axis_stays_within_a_millimetre_of_the_nominal(self) -> None:
        for seed in range(50):
            found = run(reference("calibration").noisy(np.random.default_rng(seed), pixel=0.1, joint=1e-4))
            assert abs((found.T_H_E[:3, 3] - NOMINAL_T_H_E[:3, 3]) @ T_H_E[:3, 2]) < 1e-3

    @pytest.mark.parametrize(
        ("pixel", "joint", "mean_mismatch", "degrees", "millimetres"),
        [(0.1, 1e-4, 0.154, 0.0250, 0.364), (0.03, 1e-4, 0.125, 0.0175, 0.246), (0.1, 1e-6, 0.093, 0.0183, 0.277)],
    )
    def test_errors_are_those_known_of_the_method(
        self, pixel: float, joint: float, mean_mismatch: float, degrees: float, millimetres: float
    ) -> None:
        """Of 200 runs; two such samples differ by about 5 %, so 20 % holds for any seed and finds a wrong step."""
        data, verification = reference("calibration"), reference("verification")
        errors = []
        rng = np.random.default_rng(1)
        for _ in range(200):
            found = run(data.noisy(rng, pixel, joint))
            off = mismatch(found.T_P_A, found.T_H_E, verification.T_A_H, verification.p_P_T).mean()
            distance = np.linalg.norm(found.T_P_A[:3, 3] - T_P_A[:3, 3])
            errors.append([1e3 * off, np.degrees(angle(found.T_P_A, T_P_A)), 1e3 * distance])
        mean, rms = np.mean(errors, axis=0), np.sqrt(np.mean(np.square(errors), axis=0))
        assert mean[0] == pytest.approx(mean_mismatch, rel=0.2)
        assert rms[1] == pytest.approx(degrees, rel=0.2)
        assert rms[2] == pytest.approx(millimetres, rel=0.2)


class TestRandomCells:
    @settings(deadline=None, max_examples=60)
    @given(seeds, st.integers(4, 8), st.integers(3, 5))
    def test_any_cell_is_recovered_from_exact_captures(self, seed: int, constraints: int, positions: int) -> None:
        rng = np.random.default_rng(seed)
        nominal_T_P_A = transform(
            rotation_from_vector(rng.normal(size=3)), unit(rng.normal(size=3)) * rng.uniform(0.8, 1.4)
        )
        nominal_T_H_E = transform(rotation_from_vector(rng.normal(size=3)), rng.uniform(-0.1, 0.1, 3))
        true_T_P_A = nominal_T_P_A @ deviation(rng, 15, 0.15)
        true_T_H_E = nominal_T_H_E @ deviation(rng, 8, 0.01)
        data = aligned(rng, spread_flanges(rng, constraints), true_T_P_A, true_T_H_E, positions)
        found = run(data, nominal_T_P_A, nominal_T_H_E)
        assert angle(found.T_P_A, true_T_P_A) < 1e-7
        assert np.linalg.norm(np.cross(found.optical_axis, true_T_H_E[:3, 2])) < 1e-7
        assert np.linalg.norm(found.T_P_A[:3, 3] - true_T_P_A[:3, 3]) < 1e-7
        assert np.linalg.norm(np.cross(found.T_H_E[:3, 3] - true_T_H_E[:3, 3], true_T_H_E[:3, 2])) < 1e-7
        assert abs((found.T_H_E - nominal_T_H_E)[:3, 3] @ found.optical_axis) < 1e-12

    @settings(deadline=None, max_examples=30)
    @given(seeds)
    def test_the_hand_eye_rotation_is_the_nominal_turned_as_little_as_the_axis_needs(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        data = aligned(rng, spread_flanges(rng, 6), T_P_A, T_H_E)
        found = run(data)
        between_axes = np.arccos(np.clip(found.optical_axis @ NOMINAL_T_H_E[:3, 2], -1, 1))
        assert angle(found.T_H_E, NOMINAL_T_H_E) == pytest.approx(between_axes, abs=1e-7)
        np.testing.assert_allclose(found.T_H_E[:3, 2], found.optical_axis, atol=1e-12)

    def test_a_start_that_asks_for_a_sine_above_one_still_arrives(self) -> None:
        rng = np.random.default_rng(3)
        data = aligned(rng, spread_flanges(rng, 6), T_P_A, T_H_E)
        far = T_P_A @ transform(rotation_from_vector([0, 0, np.radians(80)]), [0, 0, 0])
        assert angle(run(data, far, T_H_E).T_P_A, T_P_A) < 1e-7

    def test_the_active_flange_may_differ_a_little_within_a_constraint(self) -> None:
        rng = np.random.default_rng(4)
        exact = aligned(rng, spread_flanges(rng, 7), T_P_A, T_H_E)
        T_A_H = exact.T_A_H.copy()
        T_A_H[:, :3, :3] = T_A_H[:, :3, :3] @ rotation_from_vector(rng.normal(0, 1e-5, (len(T_A_H), 3)))
        found = estimate(T_A_H, exact.T_P_T, exact.constraints, NOMINAL_T_P_A, NOMINAL_T_H_E)
        assert angle(found.T_P_A, T_P_A) < 3e-5
        assert np.linalg.norm(found.T_P_A[:3, 3] - T_P_A[:3, 3]) < 5e-5


def deviation(rng: np.random.Generator, most_degrees: float, most_distance: float) -> Array:
    vector = np.radians(most_degrees) * rng.uniform() * unit(rng.normal(size=3))
    return transform(rotation_from_vector(vector), most_distance * rng.uniform() * unit(rng.normal(size=3)))


def any_orientation(rng: np.random.Generator) -> Array:
    return rotation_from_vector(np.pi * rng.uniform() * unit(rng.normal(size=3)))


def spread_flanges(rng: np.random.Generator, count: int) -> Array:
    """Turned by 30 degrees about two axes, and at random within 40 degrees."""
    fixed = np.radians(30) * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, -1, 0]])
    others = np.radians(40) * rng.uniform(size=(count - 4, 1)) * unit(rng.normal(size=(count - 4, 3)))
    return any_orientation(rng) @ rotation_from_vector(np.vstack([fixed, others]))


def one_axis(rng: np.random.Generator, count: int) -> Array:
    turns = np.radians(rng.uniform(-60, 60, count))[:, None] * unit(rng.normal(size=3))
    return rotation_from_vector(turns) @ any_orientation(rng)


def roll_only(rng: np.random.Generator, count: int) -> Array:
    turns = np.radians(rng.uniform(-90, 90, count))[:, None] * T_H_E[:3, 2]
    return any_orientation(rng) @ rotation_from_vector(turns)


def constant(rng: np.random.Generator, count: int) -> Array:
    return np.repeat(any_orientation(rng)[None], count, axis=0)


class TestDegenerateSets:
    @pytest.mark.parametrize("noise", [0.0, 1e-4], ids=["exact", "0.1 mrad and 0.1 mm"])
    @pytest.mark.parametrize(
        ("flanges", "reason"),
        [
            (one_axis, "turned about one axis only"),
            (roll_only, "optical axes of all constraints are parallel"),
            (constant, "same orientation in all constraints"),
        ],
    )
    def test_flanges_not_turned_about_two_axes_are_refused(self, flanges, reason: str, noise: float) -> None:
        for seed in range(40):
            rng = np.random.default_rng(seed)
            data = aligned(rng, flanges(rng, 3 + seed % 5), T_P_A, T_H_E).noisy(rng, noise, noise)
            with pytest.raises(Degenerate, match=reason):
                run(data)

    def test_only_joint_one_turned_is_refused_although_the_axes_spread(self) -> None:
        data = reference("calibration")
        joints = np.tile(data.active[0], (28, 1))
        joints[:, 0] += np.radians(np.repeat(np.linspace(-40, 40, 7), 4))
        T_A_H = Data(joints, data.passive, data.constraints).T_A_H
        made_up = aligned(np.random.default_rng(0), T_A_H[::4, :3, :3], T_P_A, T_H_E)
        axes = (T_P_A @ made_up.T_A_H @ T_H_E)[:, :3, 2]
        assert np.degrees(np.arccos((axes @ axes.T).min())) > 45
        with pytest.raises(Degenerate, match="one axis only"):
            run(made_up)

    @pytest.mark.parametrize("constraints", [1, 2])
    def test_fewer_than_three_constraints_are_refused(self, constraints: int) -> None:
        rng = np.random.default_rng(0)
        data = aligned(rng, spread_flanges(rng, 4)[:constraints], T_P_A, T_H_E)
        with pytest.raises(Degenerate, match=f"{constraints} constraints, at least 3"):
            run(data)

    def test_no_captures_at_all_are_refused(self) -> None:
        with pytest.raises(Degenerate, match="0 constraints"):
            estimate(np.empty((0, 4, 4)), np.empty((0, 4, 4)), [], NOMINAL_T_P_A, NOMINAL_T_H_E)

    def test_too_few_positions_are_refused_with_the_constraints_name(self) -> None:
        data = reference("calibration")
        short = Data(data.active[:-2], data.passive[:-2], data.constraints[:-2])
        with pytest.raises(Degenerate, match=r"constraint calibration/06: 2 positions"):
            run(short)

    def test_coincident_points_are_refused_with_the_constraints_name(self) -> None:
        data = reference("calibration")
        passive = data.passive.copy()
        passive[4:8] = passive[4]
        with pytest.raises(Degenerate, match=r"constraint calibration/01: coincident positions"):
            run(Data(data.active, passive, data.constraints))


class TestUnusualButGoodSets:
    @pytest.mark.parametrize("noise", [0.0, 1e-4], ids=["exact", "0.1 mrad and 0.1 mm"])
    def test_random_sets_are_accepted(self, noise: float) -> None:
        for seed in range(40):
            rng = np.random.default_rng(seed)
            data = aligned(rng, spread_flanges(rng, 4 + seed % 5), T_P_A, T_H_E).noisy(rng, noise, noise)
            found = run(data)
            assert found.conditioning > 0.01
            assert angle(found.T_P_A, T_P_A) < 1e-7 + 200 * noise

    def test_axes_through_one_point_are_accepted(self) -> None:
        rng = np.random.default_rng(0)
        exact = aligned(rng, spread_flanges(rng, 6), T_P_A, T_H_E)
        through = exact.T_A_H.copy()
        camera = through @ T_H_E
        through[:, :3, 3] += [0.4, 0, 0.4] - (camera[:, :3, 3] + 0.4 * camera[:, :3, 2])
        shift = (T_P_A @ (through - exact.T_A_H) @ T_H_E)[:, :3, 3]
        T_P_T = exact.T_P_T.copy()
        T_P_T[:, :3, 3] += shift
        found = estimate(through, T_P_T, exact.constraints, NOMINAL_T_P_A, NOMINAL_T_H_E)
        assert angle(found.T_P_A, T_P_A) < 1e-7
        assert np.linalg.norm(found.T_P_A[:3, 3] - T_P_A[:3, 3]) < 1e-7

    def test_axes_in_one_plane_with_roll_are_accepted(self) -> None:
        rng = np.random.default_rng(1)
        fan = np.radians(np.linspace(-30, 30, 6))[:, None] * [0, 1, 0]
        roll = np.radians([50, -40, 0, 60, -20, 30])[:, None] * T_H_E[:3, 2]
        found = run(aligned(rng, rotation_from_vector(fan) @ rotation_from_vector(roll), T_P_A, T_H_E))
        assert angle(found.T_P_A, T_P_A) < 1e-7
        assert found.warnings == ()

    @pytest.mark.parametrize("noise", [0.0, 1e-4], ids=["exact", "0.1 mrad and 0.1 mm"])
    def test_a_fan_with_five_degrees_about_a_second_axis_is_accepted_with_a_warning(self, noise: float) -> None:
        rng = np.random.default_rng(2)
        found = run(aligned(rng, fan(roll=2.5), T_P_A, T_H_E).noisy(rng, noise, noise))
        assert len(found.iterations) > MOST_ALTERNATIONS
        assert 0.01 < found.conditioning < 0.04
        assert "weak conditioning" in found.warnings[0]
        assert angle(found.T_P_A, T_P_A) < 1e-7 + 200 * noise
        assert abs((found.T_H_E - NOMINAL_T_H_E)[:3, 3] @ found.optical_axis) < 1e-3

    def test_a_fan_so_weak_that_the_noise_decides_is_accepted_only_without_noise(self) -> None:
        rng = np.random.default_rng(2)
        data = aligned(rng, fan(tilt=2.5), T_P_A, T_H_E)
        assert angle(run(data).T_P_A, T_P_A) < 1e-7
        with pytest.raises(Degenerate, match=r"too little about a second axis.*\(uncertain by"):
            run(data.noisy(rng))


def fan(roll: float = 0.0, tilt: float = 0.0) -> Array:
    """Seven flanges over 60 degrees about one axis, with roll about or tilt across the optical axis to either side."""
    turns = np.radians(np.linspace(-30, 30, 7))[:, None] * [0, 1, 0]
    sides = np.radians([1, -1, 1, -1, 1, -1, 1])[:, None]
    return rotation_from_vector(turns) @ rotation_from_vector(sides * [tilt, 0, 0] + sides * roll * T_H_E[:3, 2])
