"""Intrinsics from views of the target: what is estimated, what it rests on, and when it is refused."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from dualcal_hal.camera import Intrinsics
from dualcal_hal.cellfile import load_cell
from dualcal_hal.config.camera import CameraConfig
from dualcal_hal.errors import DegenerateCaptures
from dualcal_hal.target import Charuco, Checkerboard
from dualcal_hal.transforms import Array, rotation_from_vector, transform
from procedures.estimation.projection import project
from procedures.intrinsics import SeenView, intrinsics_result
from procedures.intrinsics.coverage import LEAST_SHARE, Coverage, tilts_of
from procedures.intrinsics.estimate import NAMES, SIGNIFICANT, estimate, information_of, parameters
from procedures.intrinsics.report import intrinsics_figure
from procedures.intrinsics.result import patch, set_options, settings
from procedures.intrinsics.views import Shown, ViewPlanner
from procedures.planning.first_look import find_stand_off
from procedures.planning.model import CellModel, Posture
from procedures.planning.sight import in_sight
from procedures.planning.ways import WayFinder
from tests.cells import PAPER, paper_cell, small_cell
from tests.walking import seen_from_camera

BOARD = Checkerboard(rows=3, columns=3, square=0.025, feature=4)
CAMERA = Intrinsics(
    np.array([[812.0, 0.0, 511.5], [0.0, 812.0, 383.5], [0.0, 0.0, 1.0]]),
    np.array([-0.12, 0.05, 0.0005, -0.0003, 0.0]),
    (1024, 768),
)
PINHOLE = Intrinsics(CAMERA.matrix, np.zeros(5), CAMERA.size)
WRONG = Intrinsics(
    np.array([[812.0 * 1.05, 0.0, 531.5], [0.0, 812.0 * 0.95, 363.5], [0.0, 0.0, 1.0]]), np.zeros(5), CAMERA.size
)
NOISE = 0.02  # px


def poses(count: int, *, tilt_deg: float = 30.0, across: float = 1.0, seed: int = 1) -> list[Array]:
    """``T_E_T`` of so many views over the image, or so much of its width, tilted up to so much to all sides."""
    rng = np.random.default_rng(seed)
    found = []
    for i in range(count):
        distance = rng.uniform(0.3, 0.45)
        pixel = np.array([70 + across * rng.uniform(0, 884), rng.uniform(70, 698), 1.0])
        azimuth, tilt = 2.4 * i, np.deg2rad(tilt_deg) * rng.uniform(0.6, 1.0)
        lean = rotation_from_vector(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
        roll = rotation_from_vector([0.0, 0.0, rng.uniform(-3, 3)])
        ray = np.linalg.solve(CAMERA.matrix, pixel)
        found.append(transform(lean @ np.diag([1.0, -1.0, -1.0]) @ roll, distance * ray))
    return found


def seen(T_E_T: Array, camera: Intrinsics, rng: np.random.Generator, noise: float = NOISE) -> Array:
    """Corners (n, 2) px, NaN for one outside the image."""
    points = BOARD.corners @ T_E_T[:3, :3].T + T_E_T[:3, 3]
    pixels = project(points, camera.matrix, camera.distortion) + noise * rng.standard_normal((len(points), 2))
    inside = np.all((pixels >= 0) & (pixels <= np.array(camera.size) - 1), axis=1)
    return np.where(inside[:, None], pixels, np.nan)


def views(
    count: int, camera: Intrinsics = CAMERA, *, noise: float = NOISE, seed: int = 1, **of_poses: float
) -> list[Array]:
    rng = np.random.default_rng([seed, 2])
    return [seen(T, camera, rng, noise) for T in poses(count, seed=seed, **of_poses)]


def camera_of(sigma_px: float = 0.02, intrinsics: Intrinsics = WRONG) -> CameraConfig:
    camera = load_cell(PAPER, settings(intrinsics)).cell.camera
    return camera.model_copy(update={"sigma_px": sigma_px})


def result_of(corners: list[Array], **of_camera: float):
    named = [SeenView(f"views/0-{i:02d}", view) for i, view in enumerate(corners)]
    return intrinsics_result(named, camera_of(**of_camera), BOARD, "0" * 64, None)


# -- estimate ----------------------------------------------------------------------------------------------------------


def test_exact_corners_give_the_exact_camera_from_one_that_is_wrong_by_5_percent_and_20_px():
    found = estimate(views(36, noise=0.0), BOARD, WRONG)
    np.testing.assert_allclose(found.intrinsics.matrix, CAMERA.matrix, atol=1e-6)
    np.testing.assert_allclose(found.intrinsics.distortion, CAMERA.distortion, atol=1e-8)
    assert found.rms < 1e-8


@pytest.mark.parametrize("camera", [CAMERA, PINHOLE], ids=["lens", "pinhole"])
def test_errors_are_as_large_as_their_sigmas_say(camera):
    normalised = []
    for seed in range(8):
        found = estimate(views(36, camera, seed=seed), BOARD, WRONG)
        normalised.append((parameters(found.intrinsics) - parameters(camera)) / found.sigma)
        assert found.rms == pytest.approx(NOISE * np.sqrt(1 - (36 * 6 + 9) / (36 * 18)), rel=0.15)
    assert np.max(np.abs(normalised)) < 4.0
    free = np.array(normalised)[:, :4]
    assert np.sqrt(np.mean(free**2)) < 1.5
    if camera is CAMERA:  # of a pinhole nothing is told apart from zero, and its sigmas allow for what may be there
        assert np.sqrt(np.mean(free**2)) > 0.6


def test_of_a_pinhole_no_distortion_is_made_up():
    found = estimate(views(36, PINHOLE, seed=3), BOARD, WRONG)
    assert set(found.fixed) == {"k1", "k2", "p1", "p2", "k3"}
    assert not np.any(found.intrinsics.distortion)


def test_what_cannot_be_told_is_zero_and_keeps_its_sigma():
    found = estimate(views(36), BOARD, WRONG)
    assert found.fixed == ("k3",)
    k3 = NAMES.index("k3")
    assert parameters(found.intrinsics)[k3] == 0.0
    assert found.sigma[k3] > 0.0
    # It is not known to be zero: the sigmas of the others are those with it free.
    total = sum(information_of(T, BOARD.corners, found.intrinsics) for T in found.poses)
    expected = np.sqrt(np.diag(np.linalg.inv(total))) * NOISE
    np.testing.assert_allclose(found.sigma, expected, rtol=0.15)


def test_a_coefficient_that_is_significant_is_never_dropped():
    for seed in range(6):
        found = estimate(views(36, seed=seed), BOARD, WRONG)
        assert "k1" not in found.fixed
        assert abs(found.intrinsics.distortion[0]) > SIGNIFICANT * found.sigma[NAMES.index("k1")]


def test_views_gone_astray_are_left_out_and_named():
    corners = views(36)
    corners[7] = corners[7] + np.random.default_rng(0).normal(0.0, 2.0, corners[7].shape)
    found = estimate(corners, BOARD, WRONG)
    assert np.flatnonzero(~found.used).tolist() == [7]
    assert found.view_rms[7] > 0.5
    assert np.all(np.isnan(found.poses[7]))
    assert found.rms < 1.2 * NOISE


def test_half_the_views_gone_astray_are_no_strays():
    rng = np.random.default_rng(0)
    corners = [view + rng.normal(0.0, 1.0 * (i % 2), view.shape) for i, view in enumerate(views(36))]
    result = result_of(corners)
    assert result.verdict == "refused"
    assert any("px rms, far above the noise of corners" in reason for reason in result.reasons)


def test_too_few_views_are_refused_with_how_many_are_needed():
    with pytest.raises(DegenerateCaptures, match="4 of 5 views show 6 corners or more, 6 such views are needed"):
        estimate([*views(4), np.full((9, 2), np.nan)], BOARD, WRONG)


def test_views_of_one_pose_determine_no_camera():
    rng = np.random.default_rng(1)
    flat = [transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.4])] * 20
    with pytest.raises(DegenerateCaptures, match="show the target tilted"):
        result_of([seen(T, PINHOLE, rng) for T in flat])


# -- coverage ----------------------------------------------------------------------------------------------------------


def test_good_views_are_enough():
    result = result_of(views(60))
    assert result.verdict == "ok", result.reasons
    assert result.coverage.share >= LEAST_SHARE


def test_half_an_image_is_refused_with_the_cells_that_are_missing():
    result = result_of(views(60, across=0.4))
    assert result.verdict == "refused"
    (reason,) = [reason for reason in result.reasons if "cells" in reason]
    assert "row 1 columns 5 6 7 8" in reason
    assert not any("tilted" in reason for reason in result.reasons)


def test_views_that_face_the_camera_are_refused_for_both_axes():
    result = result_of(views(60, tilt_deg=4.0))
    tilted = [reason for reason in result.reasons if "tilted by 15 deg" in reason]
    assert [axis for axis in ("horizontal", "vertical") for reason in tilted if axis in reason] == [
        "horizontal",
        "vertical",
    ]


def test_few_views_are_refused():
    assert any("only 12 views can be used, 15 are needed" in reason for reason in result_of(views(12)).reasons)


def test_tilts_are_about_the_images_axes():
    facing = np.diag([1.0, -1.0, -1.0])
    leaning = [rotation_from_vector([0.3, 0.0, 0.0]) @ facing, rotation_from_vector([0.0, 0.2, 0.0]) @ facing]
    np.testing.assert_allclose(np.abs(tilts_of(transform(np.array(leaning), [0.0, 0.0, 0.4]))), [[0.3, 0], [0, 0.2]])


def test_coverage_counts_each_corner_once_where_it_is():
    corners = np.full((2, 9, 2), np.nan)
    corners[0, 0], corners[0, 1], corners[1, 5] = (0.0, 0.0), (1023.0, 767.0), (511.4, 400.0)
    coverage = Coverage.of(corners, np.array(poses(2)), CAMERA)
    assert coverage.cells.sum() == 3
    assert (coverage.cells[0, 0], coverage.cells[5, 7], coverage.cells[3, 3]) == (1, 1, 1)
    assert coverage.edges == (True, True, True, True)
    assert coverage.radius == pytest.approx(1.0)


# -- result ------------------------------------------------------------------------------------------------------------


def test_the_patch_and_the_options_are_the_camera_for_the_cell_file(tmp_path):
    found = estimate(views(36), BOARD, WRONG).intrinsics
    camera = load_cell(PAPER, settings(found)).cell.camera.intrinsics
    np.testing.assert_allclose(camera.matrix, found.matrix, atol=1e-4)
    np.testing.assert_allclose(camera.distortion, found.distortion, atol=1e-7)
    text = patch(found, ["From here.", ""])
    assert text.startswith("# From here.\n#\ncamera:\n  matrix: [[")
    lines = text.splitlines()[3:]
    assert [line.strip() for line in lines] == [
        setting.removeprefix("camera.").replace("=", ": ") for setting in settings(found)
    ]
    assert set_options(found).count("--set 'camera.") == 2


def test_the_document_has_every_view_with_its_residuals():
    corners = views(40)
    corners[3][2] = np.nan
    document = result_of(corners).to_document()
    assert document["format"] == "dualcal.intrinsics/1"
    assert list(document["sigma"]) == ["fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3"]
    view = document["views"][3]
    assert (view["id"], view["corners"], view["residuals_px"][2]) == ("views/0-03", 8, None)
    residuals = np.array([pair for pair in view["residuals_px"] if pair])
    assert np.sqrt(np.mean(residuals**2)) == pytest.approx(view["rms_px"])
    assert np.sum(document["coverage"]["corners"]) == sum(view["corners"] for view in document["views"])


def test_the_picture_shows_each_residual_as_an_arrow():
    result = result_of(views(40))
    figure = intrinsics_figure("a $name", result)
    image = figure.axes[0]
    (arrows,) = [each for each in image.collections if type(each).__name__ == "Quiver"]
    residuals = result.estimate.residuals.reshape(-1, 2)
    shown = np.stack([arrows.U, arrows.V], axis=1)
    factor = shown[0, 0] / residuals[0, 0]
    np.testing.assert_allclose(shown, factor * residuals, rtol=1e-6)
    assert factor > 0


# -- views -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def stand_off() -> tuple[CellModel, Posture]:
    cell = small_cell().cell
    model = CellModel(cell)
    ways = WayFinder(model, model.nominal, [model.home])
    return model, find_stand_off(model, model.nominal, ways, model.home, 1).posture


@pytest.fixture(scope="module")
def planned(stand_off):
    return chosen(*stand_off)


def chosen(model: CellModel, at: Posture, margin: float = 28.0, count: int = 38):
    belief = model.nominal.as_if_looked()
    model = model.believing(belief)
    ways = WayFinder(model, belief, [at, model.home])
    shown = Shown.of([], [], model.board.corners, model.intrinsics)
    return model, belief, ways, ViewPlanner(model, belief, ways, margin, [1]).choose(count, shown, at, at)


def test_planned_views_keep_clear_and_show_the_whole_target(planned):
    model, belief, ways, postures = planned
    assert len(set(postures)) == 38
    q_a, q_p = (np.array([getattr(posture, arm) for posture in postures]) for arm in ("active", "passive"))
    assert np.all(model.active.within_limits(q_a))
    assert np.all(model.passive.within_limits(q_p))
    assert np.min(model.geometry.clearance(q_a, q_p, belief.placement)) >= ways.margin
    assert np.all(in_sight(model, q_a, q_p, belief))
    pixels = model.predict_corners(q_a, q_p, belief)
    assert np.all((pixels >= 28) & (pixels <= np.array(model.intrinsics.size) - 1 - 28))


def test_planned_views_cover_the_image_at_several_tilts_and_distances(planned):
    model, belief, _, postures = planned
    T_E_T = np.array([seen_from_camera(model, posture, belief) for posture in postures])
    coverage = Coverage.of(model.project_board(T_E_T), T_E_T, model.intrinsics)
    assert coverage.share >= 0.95
    assert not list(coverage.lacking())
    assert all(coverage.edges)
    distance = np.linalg.norm(T_E_T[:, :3, 3], axis=1)
    assert np.ptp(distance) > 0.1
    # To the ray, not to the image: the target is never seen from flatter than it may be.
    tilt = np.arccos(-np.einsum("ki,ki->k", T_E_T[:, :3, 2], T_E_T[:, :3, 3]) / distance)
    assert np.max(tilt) <= model.tilt_max + 1e-6


def test_the_active_arm_rests(planned):
    _, _, _, postures = planned
    changes = sum(a.active != b.active for a, b in itertools.pairwise(postures))
    assert changes <= 2 * len({posture.active for posture in postures})


def test_a_view_that_says_what_is_known_already_is_not_chosen_first(stand_off):
    model, at = stand_off
    model, belief, ways, first = chosen(model, at, count=8)
    T_E_T = [seen_from_camera(model, posture, belief) for posture in first]
    corners = [model.project_board(T) for T in T_E_T]
    shown = Shown.of(corners, T_E_T, model.board.corners, model.intrinsics)
    again = ViewPlanner(model, belief, ways, 28.0, [1]).choose(8, shown, at, at)
    new = [model.project_board(seen_from_camera(model, posture, belief)) for posture in again]
    both = Coverage.of(np.array([*corners, *new]), np.array(T_E_T), model.intrinsics)
    once = Coverage.of(np.array(corners), np.array(T_E_T), model.intrinsics)
    assert both.share > once.share + 0.1


def test_part_of_a_charuco_may_leave_the_image():
    charuco = "target={kind: charuco, corners: [5, 7], square_mm: 30, marker_mm: 22, dictionary: DICT_4X4_50}"
    cell = paper_cell(charuco, "procedure.distance_mm=[250, 450]").cell
    model = CellModel(cell)
    assert isinstance(model.board, Charuco)
    at = find_stand_off(model, model.nominal, WayFinder(model, model.nominal, [model.home]), model.home, 1).posture
    model, belief, _, postures = chosen(model, at, count=12)
    T_E_T = np.array([seen_from_camera(model, posture, belief) for posture in postures])
    pixels = model.project_board(T_E_T)
    inside = np.all((pixels >= 28) & (pixels <= np.array(model.intrinsics.size) - 1 - 28), axis=-1)
    assert np.all(inside.mean(axis=1) >= 0.4)
    assert np.any(inside.mean(axis=1) < 1.0)
