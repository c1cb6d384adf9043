"""The stand-off is clear whatever the bases' error, and from it the board is found and looked at."""

from __future__ import annotations

import numpy as np
import pytest

from dualcal_hal.errors import NoPlan
from dualcal_hal.transforms import rotation_from_vector, transform
from procedures.planning.first_look import find_stand_off, look_postures
from procedures.planning.model import CellModel, Posture
from procedures.planning.ways import WayFinder
from tests.cells import paper_cell
from tests.walking import least_clearance, seen_from_camera, walk

HOME = (0.0, 0.0, np.deg2rad(60.0), 0.0, np.deg2rad(30.0), 0.0)
REACHING = (0.0, -1.2, 0.8, 0.0, 0.0, 0.0)


def cell_with(*overrides):
    model = CellModel(paper_cell(*overrides).cell)
    return model, WayFinder(model, model.nominal, [model.home])


def found_from(start, *overrides):
    model, ways = cell_with(*overrides)
    return find_stand_off(model, model.nominal, ways, start, 1)


def given(stand_off):
    """The override that gives a stand-off."""
    active, passive = (np.rad2deg(q).tolist() for q in (stand_off.active, stand_off.passive))
    return f"procedure.stand_off={{active_deg: {active}, passive_deg: {passive}}}"


@pytest.fixture(scope="module")
def model():
    return CellModel(paper_cell().cell)


@pytest.fixture(scope="module")
def ways(model):
    return WayFinder(model, model.nominal, [model.home])


@pytest.fixture(scope="module")
def stand_off(model, ways):
    return find_stand_off(model, model.nominal, ways, model.home, 1)


# -- stand-off -------------------------------------------------------------------------------------


def test_at_the_stand_off_the_board_faces_the_camera_in_view_and_far_from_it(model, stand_off):
    T_E_T = seen_from_camera(model, stand_off.posture, model.nominal)
    assert model.in_view(T_E_T[None])[0]
    assert T_E_T[2, 2] == pytest.approx(-1.0, abs=1e-6)
    assert 0.4 < T_E_T[2, 3] < 0.9
    assert stand_off.distance == pytest.approx(T_E_T[2, 3])
    assert stand_off.clearance > 0.25


def test_the_way_to_the_stand_off_is_clear_for_errors_of_the_bases_as_large_as_allowed(model, stand_off):
    postures = walk(model, model.home, stand_off.way)
    assert postures[-1] == stand_off.posture
    assert least_clearance(model, postures, model.nominal.placement) > model.margin
    rng = np.random.default_rng(5)
    for _ in range(5):
        turn, shift = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
        error = transform(rotation_from_vector(np.deg2rad(12.0) * turn), 0.12 * shift)
        placement = type(model.nominal.placement)(model.nominal.T_P_A @ error)
        assert least_clearance(model, postures[::5], placement) > model.margin


def test_a_stand_off_that_is_given_is_taken(model, stand_off):
    other = Posture.of(np.array(stand_off.posture.active) + [0, 0, 0, 0, 0, 0.1], stand_off.posture.passive)
    taken = found_from(model.home, given(other))
    np.testing.assert_allclose(taken.posture.active, other.active, atol=1e-9)
    np.testing.assert_allclose(taken.posture.passive, other.passive, atol=1e-9)


def test_a_given_stand_off_that_the_largest_error_would_make_touch_is_refused(model, stand_off):
    """It faces and keeps 20 mm by the nominal transforms."""
    near = Posture.of(stand_off.posture.active, stand_off.posture.passive)
    closer = "nominal.active_base_in_passive_base.translation_mm=[840, 0, 0]"
    small = "nominal.uncertainty={translation_mm: 5, rotation_deg: 0.5}"
    assert found_from(model.home, given(near), closer, small).posture.active == pytest.approx(near.active)
    with pytest.raises(NoPlan, match=r"procedure\.stand_off: only -?\d+ mm are sure to be clear"):
        found_from(model.home, given(near), closer)


def test_a_given_stand_off_at_which_the_camera_does_not_see_the_target_is_refused(model, stand_off):
    away = Posture.of(np.array(stand_off.posture.active) + [1.5, 0, 0, 0, 0, 0], stand_off.posture.passive)
    with pytest.raises(NoPlan, match="does not see the whole front of the target"):
        found_from(model.home, given(away))


def test_a_given_stand_off_beyond_the_procedures_limits_is_refused(model, stand_off):
    beyond = Posture.of(stand_off.posture.active, [*stand_off.posture.passive[:5], np.deg2rad(349.0)])
    with pytest.raises(NoPlan, match="joint 6 of 'right' is not within its limits"):
        found_from(model.home, given(beyond))


def test_bases_that_stand_above_each_other_have_no_stand_off():
    with pytest.raises(NoPlan, match="above each other"):
        found_from(Posture(HOME, HOME), "nominal.active_base_in_passive_base.translation_mm=[0, 0, 1200]")


def test_bases_too_close_for_the_error_allowed_have_no_stand_off_and_are_told_to_move_apart():
    with pytest.raises(NoPlan, match=r"no stand-off.*What would help most: move the bases \d+ mm farther apart"):
        found_from(Posture(HOME, HOME), "nominal.active_base_in_passive_base.translation_mm=[600, 0, 0]")


@pytest.mark.parametrize(
    ("free", "advice"),
    [
        ("passive", r"jog 'right' away from 'left', towards its home \[0, 0, 60, 0, 30, 0\] deg"),
        ("active", r"jog 'left' away from 'right', towards its home \[0, 0, 60, 0, 30, 0\] deg"),
        (None, r"jog both arms apart, towards their homes \[0, 0, 60, 0, 30, 0\] and \[0, 0, 60, 0, 30, 0\] deg"),
    ],
)
def test_without_a_way_to_the_stand_off_the_arm_that_would_free_it_is_named(free, advice, monkeypatch):
    """As if there were a way only where that arm is home; what touches on straight moves is told, too."""
    monkeypatch.setattr(
        WayFinder, "find", lambda self, start, goal: () if free and getattr(start, free) == HOME else None
    )
    close = "nominal.active_base_in_passive_base.translation_mm=[900, 0, 0]"
    with pytest.raises(NoPlan, match=rf"'left' may touch link 3 of 'right'.*: {advice}"):
        found_from(Posture(REACHING, REACHING), close)


# -- looks -----------------------------------------------------------------------------------------


def test_the_board_is_tilted_by_twenty_degrees_between_any_two_looks(model, ways, stand_off):
    normals = []
    for number in range(5):
        posture = next(look_postures(model, model.nominal, ways, stand_off.posture, number))
        normals.append(seen_from_camera(model, posture, model.nominal)[:3, 2])
    angles = [np.arccos(np.clip(a @ b, -1, 1)) for i, a in enumerate(normals) for b in normals[:i]]
    assert np.rad2deg(min(angles)) >= 20.0


def test_looks_show_the_whole_board_and_are_clear_whatever_the_error(model, ways, stand_off):
    for number in range(1, 8):
        postures = list(look_postures(model, model.nominal, ways, stand_off.posture, number))
        assert postures
        assert least_clearance(model, postures, model.nominal.placement) >= model.margin
        for posture in postures:
            assert model.in_view(seen_from_camera(model, posture, model.nominal)[None])[0]


def test_where_the_board_is_not_seen_the_camera_is_tilted_in_two_rings_and_the_passive_arm_stays(
    model, ways, stand_off
):
    tried = list(look_postures(model, model.nominal, ways, stand_off.posture, 0))
    assert tried[0] == stand_off.posture
    at = model.camera_in_passive(stand_off.posture.active, model.nominal)
    tilts = []
    for posture in tried[1:]:
        np.testing.assert_allclose(posture.passive, stand_off.posture.passive, atol=1e-9)
        camera = model.camera_in_passive(posture.active, model.nominal)
        np.testing.assert_allclose(camera[:3, 3], at[:3, 3], atol=1e-8)
        tilts.append(np.rad2deg(np.arccos(camera[:3, 2] @ at[:3, 2])))
    np.testing.assert_allclose(tilts, [12.0] * 8 + [20.0] * 8, atol=1e-3)
