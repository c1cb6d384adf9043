"""Captures that do not belong: which are dropped, which are not, and what is said of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualcal_hal.transforms import Mask
from procedures.estimation.refined.data import CaptureArrays
from procedures.estimation.refined.estimate import refined
from procedures.estimation.refined.fit import minimise
from procedures.estimation.refined.inexact import Inexact, target_mount
from procedures.estimation.refined.model import Model
from procedures.estimation.refined.motion import moved
from procedures.estimation.refined.outliers import distances, predicted_distances
from tools.benchmarks.misfit import MISFITS, Misfit
from tools.benchmarks.refined import NOISES, contaminated, misread, reference, sort_out
from tools.benchmarks.verification import turned_out

NOISE = NOISES[0]


class TestDistances:
    def test_of_good_captures_they_are_chi_squares(self) -> None:
        """Over 50 draws of 28 captures and of 7 arrivals."""
        cell = reference()
        rng = np.random.default_rng(0)
        captures, arrivals = [], []
        for _ in range(50):
            model = Model(cell.noisy(rng, NOISE), cell.knowns, NOISE)
            found = distances(model, minimise(model, model.state(cell.T_P_A, cell.T_H_E)))
            captures.append(found.captures)
            arrivals.append(found.arrivals)
        assert np.mean(captures) == pytest.approx(18, rel=0.05)
        assert np.var(captures) == pytest.approx(36, rel=0.15)
        assert np.mean(arrivals) == pytest.approx(6, rel=0.15)

    @pytest.mark.parametrize("whole_arrival", [False, True])
    def test_leaving_out_in_the_linear_model_is_leaving_out(self, whole_arrival: bool) -> None:
        cell = reference()
        data = cell.noisy(np.random.default_rng(0), NOISE)
        out = data.arrivals == 1 if whole_arrival else np.arange(len(data)) == 5
        every, model = Model(data, cell.knowns, NOISE), Model(data.only(~out), cell.knowns, NOISE)
        fit = minimise(model, model.state(cell.T_P_A, cell.T_H_E))
        predicted = predicted_distances(every=every, model=model, fit=fit, flipped=np.zeros(len(data), bool))
        if whole_arrival:
            assert 5 < predicted[out].mean() < 40
        else:
            full = minimise(every, every.state(cell.T_P_A, cell.T_H_E))
            assert distances(every, full).captures[out] == pytest.approx(predicted[out], abs=0.01)


class TestSets:
    def test_those_that_are_wrong_are_dropped_and_no_others(self) -> None:
        cell = reference()
        rng = np.random.default_rng(1)
        for spoil in [contaminated] * 4 + [misread] * 2:
            found = sort_out(cell, *spoil(rng, cell.noisy(rng, NOISE)), NOISE)
            assert found.named
            assert found.error[0] <= 1.2 * found.without[0]
            assert found.error[1] <= 1.2 * found.without[1]

    def test_of_clean_sets_none_is_dropped(self) -> None:
        cell = reference()
        rng = np.random.default_rng(2)
        assert all(refined(cell.noisy(rng, NOISE), cell.knowns, NOISE).used.all() for _ in range(25))

    def test_noise_larger_than_stated_is_no_reason_to_drop_but_widens_the_covariance(self) -> None:
        cell = reference()
        loud = replace(NOISE, pixel=4 * NOISE.pixel)
        found = refined(cell.noisy(np.random.default_rng(0), loud), cell.knowns, NOISE)
        assert found.used.all()
        assert 2 < np.sqrt(found.scale) < 5
        assert any("times what the stated noise explains" in words for words in found.warnings)
        error = cell.error(found.T_P_A, found.T_H_E)
        assert error @ np.linalg.solve(found.covariance, error) < 40

    def test_keep_all_keeps_all(self) -> None:
        cell = reference()
        data = cell.noisy(np.random.default_rng(0), NOISE)
        data.pixels[7] += 6
        assert refined(data, cell.knowns, NOISE, keep_all=True).used.all()
        assert not refined(data, cell.knowns, NOISE).used[7]


def shifted_on_another_mount(seed: int, wrong: int) -> tuple[CaptureArrays, Mask]:
    """Captures of a cell whose mount is off by 1 mm and 0.3 deg (1 sigma), so many with their corners 8 px off, and
    which (k,).
    """
    cell, rng = reference(), np.random.default_rng(seed)
    by = rng.normal(0, np.repeat([1e-3, np.radians(0.3)], 3))
    true = replace(cell.knowns, T_F_T=moved(cell.knowns.T_F_T, by))
    data = turned_out(cell, true).noisy(rng, NOISE)
    out = np.isin(np.arange(len(data)), rng.choice(len(data), wrong, replace=False))
    ways = rng.uniform(-np.pi, np.pi, wrong)
    data.pixels[out] += 8 * np.column_stack([np.cos(ways), np.sin(ways)])[:, None]
    return data, out


MOUNTS = [target_mount(1e-3, float(np.radians(0.3))), target_mount(np.inf, np.inf)]


@pytest.mark.parametrize("mount", MOUNTS, ids=["mount with a sigma", "free mount"])
class TestWithAMountThatIsOff:
    """Where what is wrong with the mount and with some captures has to be told apart."""

    @pytest.mark.parametrize(("wrong", "seed"), [(3, 5), (5, 5), pytest.param(5, 6, marks=pytest.mark.slow)])
    def test_just_those_that_are_wrong_are_dropped(self, mount: Inexact, wrong: int, seed: int) -> None:
        data, out = shifted_on_another_mount(seed, wrong)
        found = refined(data, reference().knowns, NOISE, inexact=[mount])
        np.testing.assert_array_equal(~found.used, out)
        assert found.scale == 1

    @pytest.mark.slow
    @pytest.mark.parametrize("wrong", [3, 5])
    def test_in_set_after_set(self, mount: Inexact, wrong: int) -> None:
        for seed in range(20, 30):
            data, out = shifted_on_another_mount(seed, wrong)
            np.testing.assert_array_equal(~refined(data, reference().knowns, NOISE, inexact=[mount]).used, out)

    def test_of_clean_sets_none_is_dropped(self, mount: Inexact) -> None:
        for seed in range(5):
            data, _ = shifted_on_another_mount(seed, 0)
            assert refined(data, reference().knowns, NOISE, inexact=[mount]).used.all()


class TestMisfit:
    """Knowns or noise that are other than stated, which puts all captures off."""

    @pytest.mark.parametrize(
        ("misfit", "seed"),
        [(MISFITS[0], 1), (MISFITS[1], 18), (MISFITS[2], 1), (MISFITS[3], 5), (MISFITS[5], 6)],
        ids=["mount", "zeros", "links", "loose", "joint noise"],
    )
    def test_it_drops_no_capture_but_is_told(self, misfit: Misfit, seed: int) -> None:
        cell = reference()
        found = refined(misfit.drawn(np.random.default_rng(seed), cell), cell.knowns, NOISE)
        assert found.used.all()
        assert found.scale > 1
        assert any("times what the stated noise explains" in words for words in found.warnings)

    def test_what_stands_out_is_dropped_all_the_same(self) -> None:
        """A capture whose corners are 60 px off, and the mount by 0.5 mm."""
        cell = reference()
        data = MISFITS[0].drawn(np.random.default_rng(0), cell)
        data.pixels[5] += 60
        assert np.flatnonzero(~refined(data, cell.knowns, NOISE).used).tolist() == [5]

    def test_captures_that_agree_and_are_the_most_are_believed(self) -> None:
        cell, rng = reference(), np.random.default_rng(0)
        data, wrong = contaminated(rng, cell.noisy(rng, NOISE), share=0.43)
        np.testing.assert_array_equal(~refined(data, cell.knowns, NOISE).used, wrong)


class TestReasons:
    def test_each_dropped_capture_is_named_with_its_reason(self) -> None:
        cell = reference()
        data = cell.noisy(np.random.default_rng(0), NOISE)
        data.pixels[2] = data.pixels[2, ::-1]
        data.pixels[9, :, 0] += 20
        data.active[data.arrivals == 5, 1] += np.radians(2)
        data.pixels[27] = np.nan
        found = refined(data, cell.knowns, NOISE)
        reasons = {dropped.capture: dropped.reason for dropped in found.dropped}
        wrong = [2, 9, *np.flatnonzero(data.arrivals == 5).tolist(), 27]
        assert sorted(reasons) == wrong
        assert "from the other end" in reasons[2]
        assert "sigma (rms)" in reasons[9]
        assert "active arm stood elsewhere" in reasons[20]
        assert "no corner was seen" in reasons[27]

    def test_a_board_that_should_be_behind_the_camera_is_said_to_be_there(self) -> None:
        cell = reference()
        data = cell.noisy(np.random.default_rng(0), NOISE)
        data.passive[14, 0] += 1.5
        (dropped,) = refined(data, cell.knowns, NOISE).dropped
        assert dropped.capture == 14
        assert dropped.reason == "its board should be behind the camera, by where the other captures put it"
