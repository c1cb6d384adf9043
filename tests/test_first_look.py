"""The stand-off is clear whatever the bases' error, and from it the board is found and looked at."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from dualcal_hal.cellfile import load_cell
from dualcal_hal.errors import NoPlan
from dualcal_hal.geometry import Placement, camera_capsule
from dualcal_hal.geometry.exact import ExactCell
from dualcal_hal.transforms import inverse, rotation_from_vector, transform
from procedures.planning import first_look
from procedures.planning.first_look import _MILDER, find_stand_off, look_postures
from procedures.planning.model import CellModel, Posture
from procedures.planning.refine import LEAST_VIEWS, View, refine
from procedures.planning.ways import WayFinder
from tests.cells import paper_cell
from tests.walking import least_clearance, seen_from_camera, walk
from tools.benchmarks.edge_cells import edge_cell

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
        placement = Placement(model.nominal.T_P_A @ error_of(rng, 0.12, np.deg2rad(12.0)))
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
    with pytest.raises(NoPlan, match=r"procedure\.stand_off: only -?\d+ mm between the arms are sure to be clear"):
        found_from(model.home, given(near), closer)


def test_a_given_stand_off_at_which_the_camera_does_not_see_the_target_is_refused(model, stand_off):
    away = Posture.of(np.array(stand_off.posture.active) + [1.5, 0, 0, 0, 0, 0], stand_off.posture.passive)
    with pytest.raises(NoPlan, match="does not see the whole front of the target"):
        found_from(model.home, given(away))


def test_a_given_stand_off_beyond_the_procedures_limits_is_refused(model, stand_off):
    beyond = Posture.of(stand_off.posture.active, [*stand_off.posture.passive[:5], np.deg2rad(349.0)])
    with pytest.raises(
        NoPlan, match=r"joint 6 of 'right' is not within.* at 349\.0 deg, allowed are -347\.0 to 347\.0"
    ):
        found_from(model.home, given(beyond))


@pytest.mark.parametrize(
    ("active", "passive", "what"),
    [
        ((0, 90, 60, 0, 30, 0), (0, 0, 60, 0, 30, 0), "'left' is only -23 mm clear of the floor"),
        ((0, 0, 60, 0, 30, 0), (0, 0, 60, 0, -60, 0), r"'right' is only -\d+ mm clear of itself"),
    ],
)
def test_a_given_stand_off_at_which_an_arm_is_in_the_floor_or_in_itself_says_so(model, active, passive, what):
    with pytest.raises(NoPlan, match=rf"procedure\.stand_off: {what}, 25 mm are needed"):
        found_from(model.home, given(Posture.of(np.deg2rad(active), np.deg2rad(passive))))


def test_a_given_stand_off_from_which_something_hides_the_board_is_refused(model, stand_off):
    with pytest.raises(NoPlan, match="a fixture stands between the camera and the target there"):
        found_from(model.home, given(stand_off.posture), post_before_the_lens(model, stand_off))


def test_bases_that_stand_above_each_other_have_no_stand_off():
    with pytest.raises(NoPlan, match=r"above each other.*move one of them sideways, or give procedure\.stand_off"):
        found_from(Posture(HOME, HOME), "nominal.active_base_in_passive_base.translation_mm=[0, 0, 1200]")


def test_bases_too_close_for_the_error_allowed_have_no_stand_off_and_are_told_to_move_apart():
    with pytest.raises(NoPlan) as refusal:
        found_from(Posture(HOME, HOME), "nominal.active_base_in_passive_base.translation_mm=[600, 0, 0]")
    why = str(refusal.value)
    assert "the arms are too close to each other: " in why
    assert "What would help most: move the bases " in why
    assert "mm farther apart; or give procedure.stand_off" in why


def test_bases_of_which_too_little_is_known_are_to_be_measured():
    with pytest.raises(NoPlan) as refusal:
        found_from(Posture(HOME, HOME), "nominal.uncertainty={translation_mm: 900, rotation_deg: 25}")
    why = str(refusal.value)
    assert "the arms are too close to each other: " in why
    assert "measure the bases, correct the nominal transforms and lower nominal.uncertainty to 40 mm and 4 deg" in why


def test_a_fixture_that_leaves_no_room_for_a_stand_off_is_named():
    shelf = "at: {translation_mm: [450, 0, 500], rotation_vector_deg: [0, 0, 0]}, box_mm: [600, 1200, 600]"
    with pytest.raises(NoPlan, match=r"'right' is too close to 'shelf': \d+"):
        found_from(Posture(HOME, HOME), f"fixtures={{shelf: {{in: passive_base, {shelf}}}}}")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mount", "help_"),
    [
        ("nominal.camera_in_active_flange", "mount the camera on 'left' so that it looks away"),
        ("robots.right.target_mount", "mount the target on 'right' so that it faces away"),
    ],
)
def test_what_is_mounted_the_wrong_way_round_has_no_stand_off_and_is_named(mount, help_):
    with pytest.raises(NoPlan, match=rf"Refused: .*What would help most: {help_}"):
        found_from(Posture(HOME, HOME), f"{mount}.rotation_vector_deg=[180, 0, 0]")


def test_of_the_stand_offs_compared_the_one_is_taken_from_which_most_looks_can_follow(
    model, ways, stand_off, monkeypatch
):
    compared = []

    def looks(model, belief, ways, at, number, refused=None):
        """As if none could be taken but from the last that was asked about before."""
        if compared and at == compared[-1]:
            yield at

    def noted(model, belief, ways, at, number, refused=None):
        compared.append(at)
        return iter(())

    monkeypatch.setattr("procedures.planning.first_look.look_postures", noted)
    assert find_stand_off(model, model.nominal, ways, model.home, 1).posture == compared[0]
    assert compared[-1] != compared[0]
    monkeypatch.setattr("procedures.planning.first_look.look_postures", looks)
    assert find_stand_off(model, model.nominal, ways, model.home, 1).posture == compared[-1]


def test_a_stand_off_that_is_too_close_in_the_true_shapes_is_not_taken(model, ways, stand_off, monkeypatch):
    """As if the shape of something were not inside its capsules where both arms stand best."""
    exact = ExactCell.clearances

    def narrower(self, q_a, q_p, T_P_A):
        clearances = exact(self, q_a, q_p, T_P_A)
        return np.full_like(clearances, 0.019) if Posture.of(q_a, q_p) == stand_off.posture else clearances

    monkeypatch.setattr(ExactCell, "clearances", narrower)
    assert find_stand_off(model, model.nominal, ways, model.home, 1).posture != stand_off.posture


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


def test_where_home_itself_leaves_no_way_another_home_is_asked_for(monkeypatch):
    monkeypatch.setattr(WayFinder, "find", lambda self, start, goal: None)
    with pytest.raises(NoPlan, match=r"\): choose another home_deg in the cell file"):
        found_from(Posture(HOME, HOME))


def test_where_only_the_bases_error_leaves_no_way_from_home_they_are_to_be_measured():
    with pytest.raises(NoPlan, match=r"\): measure the bases better and lower nominal\.uncertainty, or choose another"):
        found_from(Posture(HOME, HOME), "nominal.uncertainty={translation_mm: 400, rotation_deg: 30}")


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


def test_no_look_is_taken_where_the_board_would_not_be_wholly_in_view(model, ways, stand_off, monkeypatch):
    monkeypatch.setattr(CellModel, "in_view", lambda self, T_E_T: np.zeros(len(T_E_T), dtype=bool))
    refused = Counter()
    assert list(look_postures(model, model.nominal, ways, stand_off.posture, 1, refused)) == []
    assert refused["the target is not wholly in view"] >= 1


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


def post_before_the_lens(model, stand_off):
    """A thin post on the line between lens and board, clear of both arms where the bases stand as told."""
    lens = model.camera_in_passive(stand_off.posture.active, model.nominal)[:3, 3]
    middle = (lens + model.target_in_passive(stand_off.posture.passive)[:3, 3]) / 2
    at = f"at: {{translation_mm: {(1e3 * middle).tolist()}, rotation_vector_deg: [0, 0, 0]}}"
    return f"fixtures={{post: {{in: passive_base, {at}, cylinder_mm: {{radius: 3, length: 100}}}}}}"


@pytest.mark.parametrize("number", [1, 11])
def test_from_one_of_the_tilts_the_board_is_seen_whatever_the_error_of_the_bases_and_the_camera(number, tmp_path):
    """Or nearly: where the bases are wrong by all that is allowed a few in a hundred truths may be missed."""
    (tmp_path / "cell.yaml").write_text(edge_cell(number, stepper="kinematic"))
    model = CellModel(load_cell(tmp_path / "cell.yaml").cell)
    nominal = model.nominal
    ways = WayFinder(model, nominal, [model.home])
    at = find_stand_off(model, nominal, ways, model.home, 1).posture
    tilts = list(look_postures(model, nominal, ways, at, 0))
    rng, seen = np.random.default_rng(5), 0
    for _ in range(300):
        errors = [error_of(rng, *largest) for largest in ((0.12, np.deg2rad(12.0)), (0.01, np.deg2rad(5.6)))]
        truth = replace(nominal, T_P_A=nominal.T_P_A @ errors[0], T_H_E=nominal.T_H_E @ errors[1])
        seen += bool(np.any(model.in_view(np.array([seen_from_camera(model, tilt, truth) for tilt in tilts]))))
    assert seen >= 0.97 * 300


def error_of(rng, translation, rotation):
    """(4, 4): exactly this much (m, rad), in random directions."""
    turn, shift = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    return transform(rotation_from_vector(rotation * turn), translation * shift)


def test_no_look_is_taken_at_a_board_that_something_hides(model, stand_off):
    belief = model.nominal.as_if_looked()
    behind = CellModel(paper_cell(post_before_the_lens(model, stand_off)).cell).believing(belief)
    ways = WayFinder(behind, belief, [])
    assert behind.geometry.clearance([stand_off.posture.active], [stand_off.posture.passive], belief.placement) > 0.02
    for number in (0, 1, 2):
        refused = Counter()
        postures = list(look_postures(behind, belief, ways, stand_off.posture, number, refused))
        assert postures == ([stand_off.posture] if number == 0 else [])
        assert refused["an arm or a fixture hides the target"] >= 8


def test_where_no_look_will_do_the_board_is_tilted_less_and_from_farther_away(model, ways, stand_off, monkeypatch):
    """As if only postures with camera and board a decimetre farther apart than at the stand-off were clear."""
    monkeypatch.setattr("procedures.planning.first_look._clear_postures", only_from_a_decimetre_farther(stand_off))
    view = distance_between(model, stand_off.posture)
    postures = list(look_postures(model, model.nominal, ways, stand_off.posture, 2))
    assert postures
    assert all(distance_between(model, posture) > view + 0.1 for posture in postures)


def distance_between(model, posture):
    T_E_T = inverse(model.camera_in_passive(posture.active, model.nominal)) @ model.target_in_passive(posture.passive)
    return T_E_T[2, 3]


def only_from_a_decimetre_farther(stand_off):
    clear = first_look._clear_postures

    def farther(model, belief, ways, near, cameras, boards, refused):
        postures = clear(model, belief, ways, near, cameras, boards, refused)
        least = distance_between(model, stand_off.posture) + 0.1
        return [posture for posture in postures if distance_between(model, posture) > least]

    return farther


def test_postures_that_will_not_do_for_a_look_are_counted_with_the_reason(model, ways):
    home = Posture(HOME, HOME)
    refused = Counter()
    postures = list(look_postures(model, model.nominal, ways, home, 1, refused))
    assert not postures
    assert refused["'right' does not get there"] == 8 * (1 + len(_MILDER))


@pytest.mark.parametrize("length_mm", [20, 120])
def test_before_the_looks_the_cameras_shape_holds_the_housing_however_wrong_the_nominal_hand_eye_is(length_mm):
    body = f"camera.body={{radius_mm: 35, length_mm: {length_mm}}}"
    model = CellModel(paper_cell(body).cell)
    planned = model.geometry.active
    (near, far), radius = planned.tool.ends[0], planned.tool.radius[0] - 0.035
    rng = np.random.default_rng(1)
    for _ in range(300):
        T_H_E = model.nominal.T_H_E @ error_of(rng, 0.01, np.deg2rad(6.0))
        for end in camera_capsule(6, T_H_E, 0.035, length_mm / 1000).ends[0]:
            along = np.clip((end - near) @ (far - near) / ((far - near) @ (far - near)), 0, 1)
            assert np.linalg.norm(end - near - along * (far - near)) <= radius + 1e-9


# -- what the looks tell --------------------------------------------------------------------------------


def seen_by(model, truth, postures):
    return [View(p.active, p.passive, model.predict_corners(p.active, p.passive, truth)) for p in postures]


def test_a_nominal_that_is_said_to_be_exact_does_not_hold_the_fit_back(model, stand_off, ways):
    exact = CellModel(paper_cell("nominal.uncertainty={translation_mm: 0, rotation_deg: 0}").cell)
    truth = replace(model.nominal, T_P_A=model.nominal.T_P_A @ transform(np.eye(3), [0.01, 0, 0]))
    looks = [next(look_postures(model, model.nominal, ways, stand_off.posture, n)) for n in range(LEAST_VIEWS)]
    belief, rms = refine(exact, seen_by(model, truth, looks))
    assert rms < 0.1
    np.testing.assert_allclose(belief.T_P_A, truth.T_P_A, atol=1e-3)


def test_before_three_views_what_is_kept_clear_of_is_all_that_the_cell_file_allows(model, ways, stand_off):
    """However much less the fit says: with so few views it may be in a wrong place."""
    wide = CellModel(paper_cell("nominal.uncertainty={translation_mm: 300, rotation_deg: 25}").cell)
    error = transform(rotation_from_vector([0, 0, 0.05]), [0.05, 0, 0])
    truth = replace(model.nominal, T_P_A=model.nominal.T_P_A @ error)
    looks = [
        next(look_postures(model, model.nominal, ways, stand_off.posture, number)) for number in range(LEAST_VIEWS)
    ]
    views = seen_by(model, truth, looks)
    for count in range(1, LEAST_VIEWS):
        belief, _ = refine(wide, views[:count])
        assert belief.placement is wide.nominal.placement
    belief, rms = refine(wide, views)
    assert rms < 1e-3
    np.testing.assert_allclose(belief.T_P_A, truth.T_P_A, atol=1e-3)
    np.testing.assert_array_equal(belief.placement.T_P_A, belief.T_P_A)
    assert 0.015 <= belief.placement.translation < 0.05
    assert np.deg2rad(0.6) <= belief.placement.rotation < np.deg2rad(3.0)
