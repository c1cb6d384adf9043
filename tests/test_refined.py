"""The joint maximum likelihood: reference captures, the bound, and what its covariance promises."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualcal_hal.transforms import Array, rotation_from_vector, transform
from procedures.estimation.refined.data import CaptureArrays, Noise
from procedures.estimation.refined.fit import Fit, minimise
from procedures.estimation.refined.model import Model
from procedures.estimation.refined.motion import adjoint, logarithm, motion_between, moved
from procedures.estimation.refined.uncertainty import distance_quantile, spatial_error
from tests.reference_cell import EXPECTED, NOMINAL_T_H_E, NOMINAL_T_P_A
from tools.benchmarks.refined import NOISES, Verification, coverage, draw, ratios, reference

RUNS = 100


@cache
def runs(noise: Noise):
    return draw(reference(), Verification.of(reference("verification")), noise, RUNS, seed=1)


def fit_from_nominal(data: CaptureArrays, noise: Noise) -> Fit:
    model = Model(data, reference().knowns, noise)
    return minimise(model, model.state(NOMINAL_T_P_A, NOMINAL_T_H_E))


class TestMotion:
    @given(st.lists(st.floats(-1, 1), min_size=12, max_size=12))
    def test_a_motion_in_one_frame_is_the_adjoint_of_it_in_another(self, numbers: list[float]) -> None:
        T = transform(rotation_from_vector(numbers[:3]), numbers[3:6])
        motion = 1e-6 * np.array(numbers[6:])
        np.testing.assert_allclose(moved(T, motion), moved(np.eye(4), adjoint(T) @ motion) @ T, atol=1e-11)

    @given(st.lists(st.floats(-1, 1), min_size=6, max_size=6))
    def test_the_logarithm_is_that_of_the_matrix(self, numbers: list[float]) -> None:
        twist = np.zeros((4, 4))
        v, w = np.array(numbers[:3]), np.array(numbers[3:])
        twist[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
        twist[:3, 3] = v
        T = np.eye(4)
        for n in range(24, 0, -1):  # the series of the exponential, by Horner's rule
            T = np.eye(4) + twist @ T / n
        np.testing.assert_allclose(logarithm(np.eye(4), T), numbers, atol=1e-9)

    def test_what_lies_between_two_transforms_takes_one_to_the_other(self) -> None:
        T, goal = transform(rotation_from_vector([0.1, 2, 1]), [1, 2, 3]), transform(np.eye(3), [3, 1, 2])
        np.testing.assert_allclose(moved(T, motion_between(T, goal)), goal, atol=1e-12)


class TestReference:
    def test_exact_captures_give_the_exact_cell_in_full(self) -> None:
        cell = reference()
        fit = fit_from_nominal(cell.data, NOISES[0])
        assert fit.converged
        np.testing.assert_allclose(cell.error(fit.state.T_P_A, fit.state.T_H_E), 0, atol=1e-8)

    @pytest.mark.parametrize("noise", NOISES)
    def test_the_bound_is_that_of_the_file(self, noise: Noise) -> None:
        expected = next(
            bound
            for bound in EXPECTED["bounds"]
            if (bound["observations"], bound["pixel_px"], bound["joint_rad"])
            == ("all_corners", noise.pixel, noise.active)
        )
        covariance = reference().bound(noise)
        translation, rotation = np.sqrt(np.trace(covariance[:3, :3])), np.sqrt(np.trace(covariance[3:6, 3:6]))
        assert 1e3 * translation == pytest.approx(expected["T_P_A_translation_rms_mm"], rel=1e-6)
        assert np.degrees(rotation) == pytest.approx(expected["T_P_A_rotation_rms_deg"], rel=1e-6)

    def test_captures_in_another_order_change_nothing(self) -> None:
        noise = NOISES[0]
        data = reference().noisy(np.random.default_rng(0), noise)
        order = np.random.default_rng(1).permutation(len(data))
        shuffled = CaptureArrays(data.active[order], data.passive[order], data.arrivals[order], data.pixels[order])
        np.testing.assert_allclose(
            fit_from_nominal(shuffled, noise).state.T_P_A, fit_from_nominal(data, noise).state.T_P_A, atol=1e-9
        )

    def test_a_corner_that_was_not_seen_is_no_measurement(self) -> None:
        noise = NOISES[0]
        data = reference().noisy(np.random.default_rng(0), noise)
        data.pixels[3, 4:] = np.nan
        data.pixels[5] = np.nan
        model = Model(data, reference().knowns, noise)
        assert model.measurements == 2 * (28 * 9 - 5 - 9)
        fit = minimise(model, model.state(NOMINAL_T_P_A, NOMINAL_T_H_E))
        error = reference().error(fit.state.T_P_A, fit.state.T_H_E)
        assert error @ fit.at.normal @ error < 40


class TestLinearisation:
    def test_the_normal_equations_are_those_of_all_unknowns_with_the_arms_eliminated(self) -> None:
        """Against plain differences over the cell and every error of both arms."""
        cell, noise = reference(), Noise(0.1, 2e-4, 1e-4)
        chosen = np.isin(cell.data.arrivals, [0, 1])
        model = Model(cell.noisy(np.random.default_rng(0), noise).only(chosen), cell.knowns, noise)
        state = model.state(cell.T_P_A, cell.T_H_E)
        sizes = [12, model.arrivals * 6, model.captures * 6]

        def residuals(x: Array) -> Array:
            cell_step, active, passive = np.split(x, np.cumsum(sizes)[:-1])
            shifted = type(state)(
                moved(state.T_P_A, cell_step[:6]),
                moved(state.T_H_E, cell_step[6:]),
                active.reshape(-1, 6),
                passive.reshape(-1, 6),
            )
            return np.concatenate([model.residuals(shifted).ravel(), active, passive])

        sizes_of_steps = np.repeat([1e-6, 0.1, 0.1], sizes)  # m and rad; of a sigma
        J = np.stack(
            [(residuals(step) - residuals(-step)) / (2 * step.sum()) for step in np.diag(sizes_of_steps)], axis=1
        )
        r = residuals(np.zeros(sum(sizes)))
        full, gradient = J.T @ J, J.T @ r
        folded = np.linalg.solve(full[12:, 12:], np.column_stack([full[12:, :12], gradient[12:]]))
        at = model.linearised(state)
        expected = full[:12, :12] - full[:12, 12:] @ folded[:, :12]
        np.testing.assert_allclose(at.normal, expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max())
        np.testing.assert_allclose(at.gradient, gradient[:12] - full[:12, 12:] @ folded[:, 12], rtol=1e-4)
        assert at.cost == pytest.approx(r @ r)


class TestNoise:
    @pytest.mark.parametrize("noise", NOISES)
    def test_errors_are_those_of_the_bound(self, noise: Noise) -> None:
        cell, verification = reference(), Verification.of(reference("verification"))
        for what, ratio in ratios(cell, verification, noise, runs(noise)).items():
            assert ratio.lower <= 1.02, what
            assert ratio.upper >= 0.98, what

    @pytest.mark.parametrize("noise", NOISES)
    def test_the_covariance_is_that_of_the_errors(self, noise: Noise) -> None:
        """Of 100 runs: the mean of a chi-square of 12 has a sigma of 0.5, a coverage of 95 % one of 2.2 %."""
        found = runs(noise)
        assert found.squares.mean() == pytest.approx(12, abs=1.4)
        assert 0.89 <= coverage(found.squares, 12) <= 0.995
        assert 0.89 <= coverage(found.base_squares, 6) <= 0.995
        assert np.mean(found.single <= 9) >= 0.99
        assert found.costs.mean() == pytest.approx(28 * 18 - 12, rel=0.03)

    def test_it_holds_for_arms_a_hundred_times_less_repeatable_than_the_camera(self) -> None:
        """3 mrad, by which arms still count as linear."""
        noise = Noise(0.1, 3e-3, 3e-3)
        found = draw(reference(), Verification.of(reference("verification")), noise, 50, seed=2)
        assert found.squares.mean() == pytest.approx(12, abs=2.5)


class TestSpatialError:
    def test_it_is_that_of_drawn_errors(self) -> None:
        cell = reference()
        covariance = cell.bound(NOISES[0])
        points = np.array([[0.4, 0.1, 0.3], [0.8, -0.3, 0.6]])
        drawn = np.random.default_rng(0).multivariate_normal(np.zeros(6), covariance[:6, :6], 4000)
        there = np.append(points, np.ones((2, 1)), axis=1)
        believed = (np.linalg.inv(cell.T_P_A) @ there.T).T[:, :3]
        true = np.einsum("nij,pj->npi", np.linalg.inv(moved(cell.T_P_A, drawn)), there)[..., :3]
        distances = np.linalg.norm(true - believed, axis=-1)
        predicted = spatial_error(cell.T_P_A, covariance, points)
        np.testing.assert_allclose(predicted.rms, np.sqrt(np.mean(distances**2, axis=0)), rtol=0.03)
        np.testing.assert_allclose(predicted.p95, np.percentile(distances, 95, axis=0), rtol=0.04)

    @settings(max_examples=20, deadline=None)
    @given(st.lists(st.floats(0.01, 1), min_size=3, max_size=3))
    def test_quantiles_hold_for_any_shape(self, variances: list[float]) -> None:
        drawn = np.random.default_rng(0).normal(size=(20000, 3)) * np.sqrt(variances)
        share = np.mean(np.linalg.norm(drawn, axis=1) <= distance_quantile(np.array(variances), 0.95))
        assert share == pytest.approx(0.95, abs=0.008)
