"""Captures that were not estimated from: when they count as where they are predicted, and what is said if not."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dualcal_hal.transforms import Array
from procedures.estimation.refined import refined, target_mount, verification
from procedures.estimation.refined.data import CaptureArrays
from procedures.estimation.refined.model import Model
from procedures.estimation.refined.suspects import next_suspects
from procedures.estimation.refined.verification import Consistency, verify
from tools.benchmarks.refined import NOISES, reference
from tools.benchmarks.verification import (
    Check,
    Wrong,
    check,
    check_uncertain,
    links_off,
    mount_off,
    scatter,
    turned_out,
    zero_off,
)

NOISE = NOISES[0]
OTHER = reference("verification")


@cache
def good(tolerance: float | None = None, runs: int = 50) -> list[Check]:
    rng = np.random.default_rng(0)
    return [check(rng, NOISE, OTHER, tolerance) for _ in range(runs)]


def judged(captures: CaptureArrays) -> Consistency:
    return verify(refined(reference().noisy(np.random.default_rng(0), NOISE), reference().knowns, NOISE), captures)


class TestGoodSets:
    def test_both_parts_are_chi_squares(self) -> None:
        """Of 50 sets: their means have sigmas of 1.8 and 2.6, the sigmas themselves of 10 %."""
        found = [one.found for one in good()]
        assert found[0].poses.freedom == 14 * 6
        assert found[0].corners.freedom == 14 * 12
        assert np.mean([one.poses.squares for one in found]) == pytest.approx(84, abs=5)
        assert np.std([one.poses.squares for one in found]) == pytest.approx(np.sqrt(168), rel=0.3)
        assert np.mean([one.corners.squares for one in found]) == pytest.approx(168, abs=7)
        assert np.mean([one.captures for one in found]) == pytest.approx(18, abs=0.8)
        assert all(one.fits for one in found)

    def test_squares_are_those_of_the_residuals_with_their_full_covariance(self) -> None:
        cell = reference()
        result = refined(cell.noisy(np.random.default_rng(0), NOISE), cell.knowns, NOISE)
        data = OTHER.noisy(np.random.default_rng(1), NOISE)
        model = Model(data, cell.knowns, NOISE)
        state = model.state(result.T_P_A, result.T_H_E)
        at, J = model.linearised(state), model.jacobian(state)
        size = J.shape[0] * J.shape[1]
        r = model.residuals(state).ravel()
        of_cell = (J @ at.towards_cell[model.arrival]).reshape(size, -1)
        S = np.eye(size) + of_cell @ result.covariance @ of_cell.T
        alone = []
        for k in range(model.captures):
            rows = slice(k * J.shape[1], (k + 1) * J.shape[1])
            of_passive = J[k] @ at.towards_passive[k]
            S[rows, rows] += of_passive @ of_passive.T
            for j in np.flatnonzero(model.arrival == model.arrival[k]):
                of_active = [J[i] @ at.towards_active[model.arrival[i]] for i in (k, j)]
                S[rows, j * J.shape[1] : (j + 1) * J.shape[1]] += of_active[0] @ of_active[1].T
            alone.append(r[rows] @ np.linalg.solve(S[rows, rows], r[rows]))
        found = verify(result, data)
        assert found.statistic == pytest.approx(r @ np.linalg.solve(S, r), rel=1e-6)
        np.testing.assert_allclose(found.captures, alone, rtol=1e-6)

    def test_aligned_captures_have_smaller_squares_but_by_no_more_than_two_numbers_of_each_board(self) -> None:
        tolerance = 2 * scatter(OTHER, NOISE)
        plain, chosen = (np.array([one.found.statistic for one in good(each)]) for each in (None, tolerance))
        error = np.sqrt((plain.var() + chosen.var()) / len(plain))
        assert -2 * error < plain.mean() - chosen.mean() < 2 * len(OTHER.data) + 2 * error
        assert all(one.found.fits for one in good(tolerance))

    def test_what_is_only_reckoned_with_is_reckoned_with_here_too(self) -> None:
        """A mount that is off by as much as its sigma says, which shows in the verification captures' own places."""
        rng, mount = np.random.default_rng(0), target_mount(5e-4, 1e-3)
        for _ in range(2):
            true = mount.shifted(reference().knowns, rng.normal(0, mount.sigmas))
            taken = [turned_out(cell, true).noisy(rng, NOISE) for cell in (reference(), OTHER)]
            plain = refined(taken[0], reference().knowns, NOISE)
            for estimated in (True, False):
                result = refined(taken[0], reference().knowns, NOISE, inexact=[mount], estimate_inexact=estimated)
                assert verify(result, taken[1]).fits
            assert not verify(plain, taken[1]).fits

    def test_corners_listed_from_the_other_end_are_put_in_order(self) -> None:
        data = OTHER.noisy(np.random.default_rng(1), NOISE)
        turned = np.arange(len(data)) % 2 == 0
        shown = replace(data.turned(turned), order_known=np.zeros(len(data), dtype=bool))
        assert judged(shown).statistic == pytest.approx(judged(data).statistic)
        assert not judged(data.turned(turned)).fits

    def test_corners_that_were_not_seen_do_not_count(self) -> None:
        data = OTHER.noisy(np.random.default_rng(1), NOISE)
        data.pixels[3, 4:] = np.nan
        data.pixels[5, 1:] = np.nan
        found = judged(data)
        assert found.freedom == 2 * (14 * 9 - 5 - 8)
        assert found.poses.freedom == 13 * 6 + 2
        assert np.isnan(found.residuals[3, 4:]).all()
        assert found.fits


class TestUncertainEstimates:
    """Of few constraints between which the active flange turns little: predictions bend before the error's end."""

    def test_good_captures_fit_however_far_the_estimate_may_be_off(self) -> None:
        rng, mount = np.random.default_rng(0), target_mount(3e-3, np.radians(1.0))
        found = [one for one in (check_uncertain(rng, mount) for _ in range(6)) if one is not None]
        assert len(found) > 3
        assert all(sigma > 5 for sigma, _ in found)
        assert all(one.found.fits for _, one in found)
        for _, one in found:
            assert np.mean(one.found.captures) < 1.5 * np.mean(one.found.freedoms)

    def test_nothing_changes_where_predictions_are_linear(self, monkeypatch: pytest.MonkeyPatch) -> None:
        result = refined(reference().noisy(np.random.default_rng(0), NOISE), reference().knowns, NOISE)
        data = OTHER.noisy(np.random.default_rng(1), NOISE)
        linear = verify(result, data)
        monkeypatch.setattr(verification, "LEAST_PROBABILITY", 2.0)  # which nothing reaches
        assert verify(result, data).poses.squares == pytest.approx(linear.poses.squares, rel=1e-3)


class TestBadSets:
    @pytest.mark.parametrize(
        ("wrong", "named"),
        [
            (mount_off(5e-4), "the target's mount"),
            (zero_off(0.1), "the zeros of the joints"),
            (links_off(0.04, 2e-4), "the calibration of the arms"),
        ],
        ids=["mount", "zero", "links"],
    )
    def test_what_is_wrong_shows_and_is_named(self, wrong: Wrong, named: str) -> None:
        rng = np.random.default_rng(1)
        found = check(rng, NOISE, OTHER, None, wrong, suspects=True)
        assert not found.found.fits
        assert found.suspects[0].startswith(named)
        assert "would explain the captures" in found.suspects[0]

    def test_looseness_is_named_where_nothing_else_explains_with_the_joint_sigmas_that_would(self) -> None:
        """Backlash: joints of the passive arm stand off by as much as they can, this way or that."""
        rng, cell = np.random.default_rng(0), reference()
        taken = [each.noisy(rng, NOISE) for each in (cell, OTHER)]
        for data in taken:
            data.passive[:] += 6e-4 * rng.choice([-1, 1], data.passive.shape)
        result = refined(taken[0], cell.knowns, NOISE, keep_all=True)
        assert not verify(result, taken[1]).fits
        suspects = next_suspects(result, taken[0].followed_by(taken[1]))
        assert suspects[0].words.startswith("looseness")
        assert suspects[0].words.endswith("the stated joint sigmas: 5.2 times as much would explain the captures")

    def test_where_not_even_these_would_it_says_so(self) -> None:
        """A target that slips now and then: most captures are as good as ever."""
        rng, cell = np.random.default_rng(0), reference()
        taken = [each.noisy(rng, NOISE) for each in (cell, OTHER)]
        result = refined(taken[0], cell.knowns, NOISE)
        for data in taken:
            slipped = rng.permutation(len(data))[: len(data) // 5]
            data.passive[slipped] += np.radians(1.0) * rng.choice([-1, 1], (len(slipped), 6))
        suspects = next_suspects(result, taken[0].followed_by(taken[1]))
        assert suspects[0].words.startswith("looseness")
        assert suspects[0].words.endswith("nothing else alone explains the captures")

    def test_gross_errors_of_joints_are_not_laid_at_the_corners(self) -> None:
        """A board is then so far from where the fit has it that its corners do not move in proportion."""
        cell, rng = reference(), np.random.default_rng(0)
        result = refined(cell.noisy(rng, NOISE), cell.knowns, NOISE)
        data = OTHER.noisy(rng, NOISE)
        data.passive[3, 2] += np.radians(35)
        suspects = next_suspects(result, result.captures.followed_by(data))
        assert not any(suspect.words.startswith(("the corners", "the stated pixel")) for suspect in suspects)
        assert suspects[0].words == "capture 31: it alone being off would explain the captures"

    @pytest.mark.parametrize("turned", [3, 8])
    def test_a_capture_with_its_corners_listed_from_the_other_end_is_named_as_such(self, turned: int) -> None:
        cell, rng = reference(), np.random.default_rng(turned)
        result = refined(cell.noisy(rng, NOISE), cell.knowns, NOISE)
        data = OTHER.noisy(rng, NOISE)
        data = data.turned(np.arange(len(data)) == turned)
        suspects = next_suspects(result, result.captures.followed_by(data))
        listed = "its corners alone being listed from the other end would explain the captures"
        assert suspects[0].words == f"capture {28 + turned}: {listed}"
        assert suspects[0].explains

    def test_no_pixel_sigma_is_named_where_the_corners_of_one_capture_alone_are_off(self) -> None:
        cell, rng = reference(), np.random.default_rng(0)
        taken = [each.noisy(rng, NOISE) for each in (cell, OTHER)]
        result = refined(taken[0], cell.knowns, NOISE)
        taken[1].pixels[3] += rng.normal(0, 2.0, (9, 2))
        suspects = next_suspects(result, taken[0].followed_by(taken[1]))
        assert suspects[0].words == "capture 31: it alone being off would explain the captures"
        assert suspects[1].words.startswith("the corners")

    def test_a_capture_and_an_arrival_that_alone_are_off_are_named(self) -> None:
        cell, rng = reference(), np.random.default_rng(0)
        result = refined(cell.noisy(rng, NOISE), cell.knowns, NOISE)
        names = [f"c{k}" for k in range(28 + 14)]
        for spoil, words in ((_one_capture, "capture c31"), (_one_arrival, "where the active arm stood at c28, c29")):
            data = OTHER.noisy(rng, NOISE)
            spoil(data)
            found = verify(result, data)
            assert not found.fits
            suspects = next_suspects(result, cell.noisy(rng, NOISE).followed_by(data), names)
            assert suspects[0].words.startswith(words)
            assert suspects[0].explains

    def test_corners_off_their_boards_are_told_from_boards_elsewhere_with_the_pixel_sigma_that_explains_them(
        self,
    ) -> None:
        cell, rng = reference(), np.random.default_rng(0)
        taken = [each.noisy(rng, replace(NOISE, pixel=0.25)) for each in (cell, OTHER)]
        result = refined(taken[0], cell.knowns, NOISE)
        found = verify(result, taken[1])
        assert found.corners.squares / found.corners.freedom > 1.5 * found.poses.squares / found.poses.freedom
        assert not found.fits
        suspects = next_suspects(result, taken[0].followed_by(taken[1]))
        assert suspects[0].words == "the stated pixel sigma: 0.25 px would explain the captures"
        assert suspects[1].words.startswith("the corners")

    def test_a_board_that_should_be_behind_the_camera_is_as_far_off_as_can_be(self) -> None:
        data = OTHER.noisy(np.random.default_rng(1), NOISE)
        data.active[:7, 0] += np.pi  # the camera looks the other way
        found = judged(data)
        assert np.flatnonzero(np.isinf(found.captures)).tolist() == list(range(7))
        assert found.probability == 0
        assert not found.fits


def _one_capture(data: CaptureArrays) -> None:
    data.pixels[3] += 10


def _one_arrival(data: CaptureArrays) -> None:
    of_first: Array = data.arrivals == data.arrivals[0]
    data.active[of_first, 2] += np.radians(1)
