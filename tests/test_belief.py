"""What is believed of the bases keeps an error to be clear of: the fit's, or the nominal's while that says more."""

from __future__ import annotations

import numpy as np
import pytest

from procedures.planning.belief import LEAST_ERROR, Belief
from procedures.planning.first_look import find_stand_off, look_postures
from procedures.planning.model import CellModel
from procedures.planning.refine import View, refine
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
        views = [View(p.active, p.passive, model.predict_corners(p.active, p.passive, nominal)) for p in postures]
        return refine(model, views)[0].placement

    assert believed([at] * 5) is nominal.placement
    assert believed(looks).translation < nominal.placement.translation / 4
