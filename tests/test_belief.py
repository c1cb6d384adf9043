"""What is believed of the bases keeps an error to be clear of: the fit's, or the nominal's while that says more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualcal_hal.transforms import transform
from procedures.planning.belief import LEAST_ERROR, Belief
from procedures.planning.first_look import find_stand_off, look_postures
from procedures.planning.model import CellModel
from procedures.planning.refine import View, nominal_excess, refine
from procedures.planning.ways import WayFinder
from tests.cells import paper_cell


def fitted(translation, rotation):
    """With these standard deviations of ``T_P_A`` along one axis, and next to nothing about all others."""
    sigma = np.full(12, 1e-6)
    sigma[1], sigma[5] = translation, rotation
    return Belief.fitted(np.eye(4), np.eye(4), np.diag(sigma**2), "a fit").placement


def test_three_sigma_of_the_worst_axis_of_a_poor_fit_are_kept_clear_of():
    placement = fitted(0.010, 0.02)
    assert (placement.translation, placement.rotation) == pytest.approx((0.030, 0.06))


def test_a_fit_that_says_less_is_not_trusted_further_than_pixels_can_tell():
    placement = fitted(0.001, 0.001)
    assert (placement.translation, placement.rotation) == LEAST_ERROR


def test_views_that_differ_in_nothing_leave_the_nominals_error_and_such_that_differ_do_not():
    model = CellModel(paper_cell().cell)
    nominal = model.nominal
    ways = WayFinder(model, nominal, [model.home])
    at = find_stand_off(model, nominal, ways, model.home, 1).posture
    looks = [next(look_postures(model, nominal, ways, at, number)) for number in range(5)]

    def believed(postures):
        return refine(model, views_of(model, postures, nominal))[0].placement

    assert believed([at] * 5) is nominal.placement
    assert believed(looks).translation < nominal.placement.translation / 4


def views_of(model, postures, truth):
    return [View(p.active, p.passive, model.predict_corners(p.active, p.passive, truth)) for p in postures]


@pytest.mark.parametrize(
    "uncertainty", ["{translation_mm: 10, rotation_deg: 0.5}", "{translation_mm: 0, rotation_deg: 0}"]
)
def test_a_nominal_that_claims_much_and_is_contradicted_is_not_what_clearance_is_kept_by(uncertainty):
    model = CellModel(paper_cell(f"nominal.uncertainty={uncertainty}").cell)
    ways = WayFinder(model, model.nominal, [model.home])
    at = find_stand_off(model, model.nominal, ways, model.home, 1).posture
    looks = [next(look_postures(model, model.nominal, ways, at, number)) for number in range(5)]
    truth = replace(model.nominal, T_P_A=model.nominal.T_P_A @ transform(np.eye(3), [0.0, 0.0, 0.1]))

    belief, _ = refine(model, views_of(model, looks, truth))
    np.testing.assert_allclose(belief.placement.T_P_A, truth.T_P_A, atol=1e-3)
    assert (belief.placement.translation, belief.placement.rotation) >= LEAST_ERROR
    assert nominal_excess(model, belief) == pytest.approx((0.1, 0.0), abs=1e-3)

    agreed, _ = refine(model, views_of(model, looks, model.nominal))
    np.testing.assert_allclose(agreed.placement.T_P_A, model.nominal.T_P_A, atol=1e-3)
    assert (agreed.placement.translation, agreed.placement.rotation) >= LEAST_ERROR
    assert nominal_excess(model, agreed) is None
