"""The joint fit to all corners that planning starts from."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from dualcal_hal.target import Checkerboard
from dualcal_hal.transforms import (
    Array,
    apply,
    inverse,
    rotation_angle,
    rotation_from_vector,
    transform,
    vector_from_rotation,
)
from procedures.estimation import CornerFit, Prior, fit_corners
from procedures.estimation.projection import project
from tests.reference_cell import NOMINAL_T_H_E, NOMINAL_T_P_A

MATRIX = np.array([[812.0, 0, 511.5], [0, 812.0, 383.5], [0, 0, 1]])
DISTORTION = np.array([-0.2, 0.05, 1e-3, -1e-3, 0.0])
BOARD = Checkerboard(3, 3, 0.025, 4).corners
PRIOR = Prior(NOMINAL_T_P_A, NOMINAL_T_H_E, (0.07, np.radians(7), 0.006, np.radians(3.3)))
STAND_OFF = transform([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0.25, 0, 0.5])
PIXEL = 0.05


@dataclass(frozen=True)
class Looks:
    T_P_A: Array
    T_H_E: Array
    T_A_H: Array
    T_P_T: Array
    corners: Array
    candidates: list[Array]

    def fit(self, board_poses: object = None) -> CornerFit:
        return fit_corners(self.T_A_H, self.T_P_T, BOARD, self.corners, MATRIX, DISTORTION, PRIOR, PIXEL, board_poses)


def look(seed: int, count: int, arms: float = 0.0, pixel: float = 0.0) -> Looks:
    """Looks from the stand-off at a board tilted by 25 degrees each time anew, in an edge cell: the nominal base is
    wrong by 120 mm and 12 degrees, the nominal hand-eye by 10 mm and 5.6 degrees. Noise of 1 sigma: arms in rad and
    m, pixel in px.
    """
    rng = np.random.default_rng(seed)
    T_P_A = NOMINAL_T_P_A @ transform(rotation_from_vector(np.radians(12) * direction(rng)), 0.12 * direction(rng))
    T_H_E = NOMINAL_T_H_E @ transform(rotation_from_vector(np.radians(5.6) * direction(rng)), 0.01 * direction(rng))
    wrist = rotation_from_vector(np.radians(rng.uniform([-8, -8, -40], [8, 8, 40], (count, 3))))
    T_A_E = STAND_OFF @ transform(wrist, rng.uniform(-0.02, 0.02, (count, 3)))
    turns = 2.4 * np.arange(count)  # rad; no two boards are tilted the same way
    tilts = np.radians(25) * (np.arange(count) > 0)[:, None] * np.stack([np.cos(turns), np.sin(turns), 0 * turns], 1)
    places = rng.uniform([-0.05, -0.05, 0.6], [0.05, 0.05, 0.75], (count, 3))
    T_E_T = transform(np.diag([1.0, -1, -1]) @ rotation_from_vector(tilts), places)
    corners = project(apply(T_E_T, BOARD), MATRIX, DISTORTION) + rng.normal(0, pixel, (count, 9, 2))
    return Looks(
        T_P_A=T_P_A,
        T_H_E=T_H_E,
        T_A_H=T_A_E @ inverse(T_H_E) @ disturbance(rng, count, arms),
        T_P_T=T_P_A @ T_A_E @ T_E_T @ disturbance(rng, count, arms),
        corners=corners,
        candidates=[board_candidates(pixels) for pixels in corners],
    )


def disturbance(rng: np.random.Generator, count: int, sigma: float) -> Array:
    return transform(rotation_from_vector(rng.normal(0, sigma, (count, 3))), rng.normal(0, sigma, (count, 3)))


def board_candidates(pixels: Array) -> Array:
    """The two poses (2, 4, 4) under which a plane looks alike."""
    _, turns, places, _ = cv2.solvePnPGeneric(BOARD, pixels, MATRIX, DISTORTION, flags=cv2.SOLVEPNP_IPPE)
    return np.stack(
        [
            transform(rotation_from_vector(turn.ravel()), place.ravel())
            for turn, place in zip(turns, places, strict=True)
        ]
    )


def direction(rng: np.random.Generator) -> Array:
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def errors(fit: CornerFit, looks: Looks) -> tuple[float, float]:
    """Of T_P_A, degrees and mm."""
    distance = np.linalg.norm(fit.T_P_A[:3, 3] - looks.T_P_A[:3, 3])
    return float(np.degrees(rotation_angle(fit.T_P_A[:3, :3], looks.T_P_A[:3, :3]))), float(1e3 * distance)


def test_exact_looks_give_the_cell_up_to_what_the_prior_pulls() -> None:
    looks = look(seed=1, count=12)
    fit = looks.fit(looks.candidates)
    degrees, millimetres = errors(fit, looks)
    assert degrees < 0.05
    assert millimetres < 0.5
    assert fit.rms < 0.02


def test_a_single_look_is_explained_and_the_prior_decides_the_rest() -> None:
    looks = look(seed=2, count=1)
    fit = looks.fit(looks.candidates)
    assert fit.rms < 0.02
    assert np.linalg.norm(fit.T_H_E[:3, 3] - NOMINAL_T_H_E[:3, 3]) < 0.03


def test_without_corners_the_nominal_and_its_sigmas_come_back() -> None:
    looks = look(seed=3, count=2)
    unseen = Looks(looks.T_P_A, looks.T_H_E, looks.T_A_H, looks.T_P_T, np.full_like(looks.corners, np.nan), [])
    fit = unseen.fit()
    np.testing.assert_allclose(fit.T_P_A, NOMINAL_T_P_A, atol=1e-12)
    np.testing.assert_allclose(np.sqrt(np.diag(fit.covariance)), np.repeat(PRIOR.sigmas, 3), rtol=1e-9)
    assert np.isnan(fit.view_rms).all()


@pytest.mark.parametrize("seed", range(10))
def test_nominal_one_board_pose_and_two_candidates_lead_to_the_same_fit(seed: int) -> None:
    looks = look(seed, count=4, arms=3e-5, pixel=0.03)
    fits = [looks.fit(), looks.fit(np.stack(looks.candidates)), looks.fit([looks.candidates[0][0], None, None, None])]
    for fit in fits[1:]:
        np.testing.assert_allclose(fit.T_P_A, fits[0].T_P_A, atol=2e-4)


def test_a_start_behind_the_board_is_left_for_another() -> None:
    looks = look(seed=5, count=3)
    backwards = transform(rotation_from_vector([0, 0, np.pi]), [0, 0, 0])
    looking_away = Prior(NOMINAL_T_P_A @ backwards, NOMINAL_T_H_E, (1.0, 3.0, 0.006, np.radians(3.3)))
    fixed = looks.T_A_H, looks.T_P_T, BOARD, looks.corners, MATRIX, DISTORTION, looking_away, PIXEL
    assert fit_corners(*fixed, looks.candidates).rms < 1
    with pytest.raises(ValueError, match="in front of the camera"):
        fit_corners(*fixed)


def test_missing_corners_are_left_out() -> None:
    looks = look(seed=6, count=6)
    wrong = looks.corners.copy()
    wrong[2, 4:] = np.nan
    wrong[3] = np.nan
    fit = Looks(looks.T_P_A, looks.T_H_E, looks.T_A_H, looks.T_P_T, wrong, []).fit()
    assert fit.rms < 0.02
    assert np.isnan(fit.view_rms).tolist() == [False, False, False, True, False, False]


def test_a_view_that_does_not_fit_shows_in_its_own_rms() -> None:
    looks = look(seed=7, count=8)
    shifted = looks.corners.copy()
    shifted[5, 0] += [3.0, 0.0]
    fit = Looks(looks.T_P_A, looks.T_H_E, looks.T_A_H, looks.T_P_T, shifted, []).fit()
    assert np.argmax(fit.view_rms) == 5


def test_the_covariance_is_that_of_the_errors() -> None:
    """chi2 with 12 degrees of freedom over 60 fits: its mean has a sigma of 0.63."""
    chi2 = []
    for seed in range(60):
        looks = look(seed, count=12, pixel=PIXEL)
        fit = looks.fit()
        parts = [inverse(fit.T_P_A) @ looks.T_P_A, inverse(fit.T_H_E) @ looks.T_H_E]
        error = np.concatenate([np.append(T[:3, 3], vector_from_rotation(T[:3, :3])) for T in parts])
        chi2.append(error @ np.linalg.solve(fit.covariance, error))
    assert np.mean(chi2) == pytest.approx(12, abs=3)


@pytest.mark.parametrize(
    ("count", "degrees", "millimetres"), [(1, 5.2, 37), (2, 1.6, 14), (3, 0.17, 3.2), (5, 0.12, 2.0)]
)
def test_accuracy_over_looks_is_what_planning_counts_on(count: int, degrees: float, millimetres: float) -> None:
    """Medians over 40 edge cells, within a factor of two of those known for looks by real wrist moves."""
    found = []
    for seed in range(40):
        looks = look(seed, count, arms=5e-5, pixel=0.03)
        found.append(errors(looks.fit(looks.candidates), looks))
    median = np.median(found, axis=0)
    assert median[0] < 2 * degrees
    assert median[1] < 2 * millimetres
