"""Sigmas found from the captures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from procedures.estimation.refined import Noise, refined
from procedures.estimation.refined.fit import minimise
from procedures.estimation.refined.model import Model
from tools.benchmarks.refined import NOISES, noises_found, reference

STATED = Noise(0.05, 3e-5, 3e-5)


@pytest.mark.parametrize("noise", NOISES[:2])
def test_pixel_and_joint_sigma_are_found_whatever_was_stated(noise: Noise) -> None:
    found = noises_found(reference(), noise, STATED, runs=3, seed=1)
    for one in found:
        assert one.pixel.value == pytest.approx(noise.pixel, rel=0.15)
        assert one.joint.value == pytest.approx(noise.passive, rel=0.45)
        assert one.joint.identified
    assert np.median([one.joint.value for one in found]) == pytest.approx(noise.passive, rel=0.2)


def test_a_joint_sigma_too_small_to_be_seen_has_an_upper_bound() -> None:
    noise = NOISES[2]
    for one in noises_found(reference(), noise, STATED, runs=2, seed=2):
        assert one.pixel.value == pytest.approx(noise.pixel, rel=0.15)
        assert noise.passive < one.joint.upper < 5e-5
        assert not one.joint.identified
        assert one.noise.passive == one.joint.upper


def test_the_ratio_of_both_arms_stays_what_was_stated() -> None:
    noise = Noise(0.1, 2e-4, 1e-4)
    (found,) = noises_found(reference(), noise, Noise(0.05, 2e-5, 1e-5), runs=1, seed=3)
    assert found.noise.active == pytest.approx(2 * found.noise.passive)
    assert found.joint.value == pytest.approx(1e-4, rel=0.45)


def test_the_estimate_is_that_of_the_noise_that_was_found() -> None:
    cell, noise = reference(), NOISES[0]
    data = cell.noisy(np.random.default_rng(0), noise)
    wrong = Noise(1.0, 1e-5, 1e-5)
    found, right = refined(data, cell.knowns, wrong, estimate_noise=True), refined(data, cell.knowns, noise)
    assert found.found is not None
    assert found.noise == found.found.noise
    np.testing.assert_allclose(found.T_P_A, right.T_P_A, atol=5e-5)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), np.sqrt(np.diag(right.covariance)), rtol=0.35)


def test_outliers_are_not_taken_for_noise() -> None:
    cell, noise = reference(), NOISES[0]
    data = cell.noisy(np.random.default_rng(0), noise)
    data.pixels[4] += 8
    found = refined(data, cell.knowns, STATED, estimate_noise=True)
    assert np.flatnonzero(~found.used).tolist() == [4]
    assert found.noise.pixel == pytest.approx(noise.pixel, rel=0.15)


@pytest.mark.parametrize("noise", [Noise(0.1, 3e-4, 3e-4), Noise(0.4, 1e-4, 1e-4)], ids=["joints", "pixels"])
def test_the_covariance_holds_where_the_noise_was_stated_three_or_four_times_too_small(noise: Noise) -> None:
    """The mean of 5 chi-squares of 12 has a sigma of 2.2, and what is found of the noise varies too."""
    cell, rng, squares = reference(), np.random.default_rng(0), []
    for _ in range(5):
        found = refined(cell.noisy(rng, noise), cell.knowns, NOISES[0])
        error = cell.error(found.T_P_A, found.T_H_E)
        squares.append(error @ np.linalg.solve(found.covariance, error))
        assert found.scale > 1
        assert found.used.all()
    assert np.mean(squares) == pytest.approx(12, abs=7)


def test_the_covariance_is_widened_where_arrivals_differ_by_more_than_the_noise_that_was_found() -> None:
    """The active arm misses its readings by far more than the passive one, and is stated to be as good."""
    cell, noise = reference(), NOISES[0]
    data = cell.noisy(np.random.default_rng(0), replace(noise, active=8 * noise.active))
    found = refined(data, cell.knowns, noise, estimate_noise=True)
    assert found.scale > 2
    assert any("the covariance is widened" in words for words in found.warnings)
    model = Model(found.captures, cell.knowns, found.noise)
    plain = np.linalg.inv(minimise(model, model.state(found.T_P_A, found.T_H_E)).at.normal)
    assert np.sqrt(np.trace(found.covariance) / np.trace(plain)) == pytest.approx(np.sqrt(found.scale), rel=0.2)
