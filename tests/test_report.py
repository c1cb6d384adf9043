"""The picture of a run."""

from __future__ import annotations

import itertools
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.transforms import Bbox
from scipy.stats import chi2

from dualcal_hal.camera import Image
from dualcal_hal.session.result import Result
from procedures.analysis import analyse
from procedures.estimation.refined.motion import moved
from procedures.estimation.refined.uncertainty import spatial_error
from procedures.report import draw_summary
from procedures.report.accuracy_pictures import Slice
from procedures.report.expected_mismatch import expected_mismatch
from procedures.report.style import RED
from procedures.report.summary import SIZE_PX, summary_figure
from tests.reference_cell import ACTIVE, PASSIVE, T_F_T
from tests.reference_run import captures, cell, plan, result
from tests.refined_run import noisy_captures, refined_result, with_some_off

PRINCIPAL_POINT = (511.5, 383.5)
SHOWN = captures().captures[9]
BOARD, OFFSETS = f"u, px   (capture {SHOWN.id})", "u, px"
MISMATCH = "verification capture (a line between constraints)"
IMAGE: Image = np.random.default_rng(0).integers(0, 256, (768, 1024), dtype=np.uint8)


def figure(**changed: Any) -> Figure:
    content = {
        "cell": cell(),
        "plan": plan(),
        "captures": captures(),
        "result": result(),
        "image": IMAGE,
        "feature_px": SHOWN.feature,
    }
    return summary_figure(**{**content, **changed})


@pytest.fixture(scope="module")
def drawn() -> Figure:
    return figure()


def refined_figure(**changed: Any) -> Figure:
    return figure(**{"captures": noisy_captures(), "result": refined_result(), **changed})


@pytest.fixture(scope="module")
def refined() -> Figure:
    return refined_figure()


def panel(figure: Figure, x_label: str) -> Axes:
    (found,) = [axes for axes in figure.axes if axes.get_xlabel() == x_label]
    return found


def heads(figure: Figure) -> list[str]:
    return [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]


def legend(figure: Figure, head: str) -> list[str]:
    (axes,) = [axes for axes in figure.axes if axes.get_title(loc="left").startswith(head)]
    found = axes.get_legend()
    assert found is not None
    return [text.get_text() for text in found.get_texts()]


def points_3d(figure: Figure, label: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    axes: Any = panel(figure, "x, mm")
    (points,) = [collection for collection in axes.collections if collection.get_label() == label]
    return np.array(points._offsets3d).T


# -- the file ----------------------------------------------------------------------------------------------------------


def test_the_picture_is_a_png_of_the_stated_size_and_leaves_nothing_else_behind(tmp_path: Path) -> None:
    path = tmp_path / "summary.png"
    draw_summary(
        path,
        cell=cell(),
        plan=plan(),
        captures=captures(),
        result=result(),
        image=IMAGE,
        feature_px=SHOWN.feature,
    )
    picture = cv2.imread(str(path))
    assert picture is not None
    assert picture.shape[1::-1] == SIZE_PX
    assert picture.std() > 20
    assert list(tmp_path.iterdir()) == [path]


def test_the_command_line_does_not_load_the_plotting_library_before_it_draws() -> None:
    loaded = "import sys, procedures.report; sys.exit(any(name.startswith('matplotlib') for name in sys.modules))"
    assert subprocess.run([sys.executable, "-c", loaded], check=False).returncode == 0


# -- the camera's frame ------------------------------------------------------------------------------------------------


def test_red_is_about_the_principal_point_and_green_about_the_feature_point(drawn: Figure) -> None:
    offset = np.subtract(SHOWN.feature, PRINCIPAL_POINT)
    for label in (BOARD, OFFSETS):
        axes = panel(drawn, label)
        red, green = [patch for patch in axes.patches if isinstance(patch, Circle)]
        assert red.center == (0, 0)
        np.testing.assert_allclose(green.center, offset)
        assert red.get_radius() > green.get_radius()
    assert f"({offset[0]:+.3f}, {offset[1]:+.3f}) px" in heads(drawn)[0]


def test_the_image_lies_so_that_each_corner_of_the_board_is_marked_where_it_was_found(drawn: Figure) -> None:
    axes = panel(drawn, BOARD)
    (marked,) = [line.get_xydata() for line in axes.lines if len(line.get_xydata()) > 1]
    np.testing.assert_allclose(marked + PRINCIPAL_POINT, SHOWN.corners)
    left, right, bottom, top = axes.images[0].get_extent()
    assert (left + PRINCIPAL_POINT[0], top + PRINCIPAL_POINT[1]) == (-0.5, -0.5)  # pixel centres are integers
    assert (right - left, bottom - top) == (1024, 768)
    np.testing.assert_array_equal(axes.images[0].get_array(), IMAGE)


def test_the_offsets_of_all_captures_stand_beside_the_tolerance(drawn: Figure) -> None:
    axes = panel(drawn, OFFSETS)
    (offsets,) = [line.get_xydata() for line in axes.lines if len(line.get_xydata()) > 1]
    np.testing.assert_allclose(offsets + PRINCIPAL_POINT, [capture.feature for capture in captures().captures])
    (tolerance,) = [patch for patch in axes.patches if isinstance(patch, Rectangle)]
    np.testing.assert_allclose(tolerance.get_bbox().extents, [-0.1, -0.1, 0.1, 0.1])
    assert "tolerance 0.1 px" in legend(drawn, "Camera frame")


def test_a_tolerance_that_follows_the_scatter_has_no_square() -> None:
    procedure = cell().procedure.model_copy(update={"tolerance_px": "auto"})
    automatic = figure(cell=cell().model_copy(update={"procedure": procedure}))
    assert not [patch for patch in panel(automatic, OFFSETS).patches if isinstance(patch, Rectangle)]
    assert not [words for words in legend(automatic, "Camera frame") if "tolerance" in words]


# -- convergence and mismatch ------------------------------------------------------------------------------------------


def test_convergence_shows_both_updates_of_every_iteration_and_the_papers_level(drawn: Figure) -> None:
    axes = panel(drawn, "iteration")
    lines = {line.get_label(): line for line in axes.lines}
    for label, key in (("rotation update", "rotation_update"), ("optical axis update", "axis_update")):
        np.testing.assert_array_equal(lines[label].get_ydata(), [iteration[key] for iteration in result().iterations])
        assert lines[label].get_xdata()[0] == 1
    assert lines["0.01: where the paper stops"].get_ydata() == [0.01, 0.01]
    assert axes.get_yscale() == "log"


def test_mismatch_shows_each_value_both_means_the_limit_and_the_papers_means_in_mm(drawn: Figure) -> None:
    axes = panel(drawn, MISMATCH)
    before, after = result().mismatch_before, result().mismatch_after
    assert before is not None
    assert after is not None
    values = [line.get_ydata() for line in axes.lines if len(line.get_ydata()) == 14]
    np.testing.assert_allclose(values, 1e3 * np.array([before.values, after.values]))
    levels = [line.get_ydata()[0] for line in axes.lines if list(line.get_xdata()) == [0, 1]]
    expected = [1e3 * np.mean(before.values), 1e3 * np.mean(after.values), 0.5, 60.8, 6.2]
    np.testing.assert_allclose(sorted(levels), sorted(expected))
    assert axes.get_yscale() == "log"


def test_another_cell_is_not_measured_by_the_papers_mismatch() -> None:
    axes = panel(figure(cell=cell().model_copy(update={"name": "mine"})), MISMATCH)
    assert not [line for line in axes.lines if line.get_ydata()[0] in (60.8, 6.2)]


def test_a_line_separates_the_constraints_of_the_verification(drawn: Figure) -> None:
    axes = panel(drawn, MISMATCH)
    assert [line.get_xdata()[0] for line in axes.lines if list(line.get_ydata()) == [0, 1]] == [7.5]


def test_without_verification_captures_the_panel_says_so() -> None:
    calibration = tuple(capture for capture in captures().captures if capture.use == "calibration")
    only = replace(captures(), captures=calibration)
    drawn = figure(captures=only, result=analyse(only, cell(), "paper"))
    (axes,) = [axes for axes in drawn.axes if axes.get_title(loc="left") == "Mismatch: not verified"]
    assert "no verification captures" in axes.texts[0].get_text()
    assert not axes.lines


def test_without_iterations_there_is_no_convergence(refined: Figure) -> None:
    assert not [words for words in heads(refined) if "Convergence" in words]


# -- what a refined result is worth ------------------------------------------------------------------------------------


def accuracy_with(**fields: Any) -> Result:
    accuracy = refined_result().accuracy
    assert accuracy is not None
    return replace(refined_result(), accuracy=accuracy.model_copy(update=fields))


def requiring(millimetres: float) -> Result:
    accuracy = refined_result().accuracy
    assert accuracy is not None
    return accuracy_with(error_3d=accuracy.error_3d.model_copy(update={"required_mm": millimetres}))


def slices(figure: Figure) -> tuple[Axes, Axes]:
    above, side = (axes for axes in figure.axes if axes.get_xlabel().startswith("x, mm   (at"))
    return above, side


def test_a_slice_goes_through_the_middle_of_the_region_and_shows_the_error_predicted_there() -> None:
    accuracy = refined_result().accuracy
    assert accuracy is not None
    region = np.array([accuracy.error_3d.region.low_mm, accuracy.error_3d.region.high_mm])
    cut = Slice.of(refined_result().T_P_A, accuracy, (0, 2))
    assert cut.at == pytest.approx(region[:, 1].mean())
    place = [cut.x[7] / 1e3, cut.at / 1e3, cut.y[30] / 1e3]
    predicted = spatial_error(refined_result().T_P_A, np.array(accuracy.covariance), place).p95
    assert cut.values[30, 7] == pytest.approx(1e3 * float(predicted))
    corners = np.array(accuracy.error_3d.map.points_mm)[:, [0, 2]]
    assert cut.x[0] < corners[:, 0].min() < corners[:, 0].max() < cut.x[-1]
    assert cut.y[0] < corners[:, 1].min() < corners[:, 1].max() < cut.y[-1]


def test_both_slices_outline_the_region_where_accuracy_is_required(refined: Figure) -> None:
    accuracy = refined_result().accuracy
    assert accuracy is not None
    low, high = accuracy.error_3d.region.low_mm, accuracy.error_3d.region.high_mm
    for axes, (across, up) in zip(slices(refined), ((0, 1), (0, 2)), strict=True):
        (box,) = [patch for patch in axes.patches if isinstance(patch, Rectangle)]
        np.testing.assert_allclose(box.get_bbox().extents, [low[across], low[up], high[across], high[up]])
        assert axes.get_ylabel() == f"{'xyz'[up]}, mm"


@pytest.mark.parametrize(
    ("required", "words", "red_lines"),
    [(1.0, "kept all over", 0), (0.06, "the red line", 2), (0.01, "exceeded all over", 0)],
)
def test_the_map_says_where_the_required_accuracy_is_kept(required: float, words: str, red_lines: int) -> None:
    drawn = refined_figure(result=requiring(required))
    assert f"required: {required:g} mm, {words}" in legend(drawn, "Predicted 3D error")
    reds = [
        line
        for axes in slices(drawn)
        for line in axes.collections
        if isinstance(line, ContourSet) and to_hex(line.get_edgecolor()[0]) == RED.lower()  # type: ignore[arg-type]
    ]
    assert len(reds) == red_lines


FIT = "capture (a line between constraints)"


def test_each_capture_stands_beside_the_band_of_what_is_expected(refined: Figure) -> None:
    accuracy, verification = refined_result().accuracy, refined_result().verification
    assert accuracy is not None
    assert verification is not None
    lines = {line.get_label(): line for line in panel(refined, FIT).lines}
    for label, records in (("calibration: fit", accuracy.captures), ("verification: fit", verification.captures)):
        expected = [np.sqrt(record.chi_square / record.degrees_of_freedom) for record in records]
        np.testing.assert_allclose(lines[label].get_ydata(), expected)
        ids = [noisy_captures().captures[int(number) - 1].id for number in lines[label].get_xdata()]
        assert ids == [record.id for record in records]
    band = panel(refined, FIT).collections[0].get_paths()[0].vertices
    freedom = accuracy.captures[0].degrees_of_freedom
    low, high = np.sqrt(chi2.ppf([0.025, 0.975], freedom) / freedom)
    np.testing.assert_allclose([np.min(band[:, 1]), np.max(band[:, 1])], [low, high])  # type: ignore[index]


def test_the_fit_of_all_captures_together_is_told_in_words() -> None:
    words = legend(
        refined_figure(captures=noisy_captures(0.003), result=refined_result(0.003)), "How each capture fits"
    )
    assert {"calibration: do not fit", "verification: do not fit"} <= set(words)


def test_captures_that_were_left_out_are_marked_where_they_stand() -> None:
    taken, found = with_some_off()
    drawn = refined_figure(captures=taken, result=found)
    assert "left out: 5" in legend(drawn, "How each capture fits")
    (marked,) = [line for line in panel(drawn, FIT).lines if line.get_label() == "left out: 5"]
    ids = {taken.captures[int(number) - 1].id for number in marked.get_xdata()}
    assert ids == {rejected.id for rejected in found.captures_rejected}


def test_the_mismatch_of_a_refined_result_has_no_limit_but_what_was_predicted(refined: Figure) -> None:
    words = legend(refined, "Mismatch")
    assert not [entry for entry in words if "limit" in entry]
    assert "predicted (rms)" in words


def test_the_mismatch_is_predicted_as_large_as_it_comes_out() -> None:
    """Over errors drawn from the covariance and the noise of both arms, on the verification captures."""
    accuracy, found, rng = refined_result().accuracy, refined_result(), np.random.default_rng(2)
    assert accuracy is not None
    verification = [capture for capture in noisy_captures().captures if capture.use == "verification"]
    active = np.array([capture.active_joints for capture in verification])
    passive = np.array([capture.passive_joints for capture in verification])
    offset = (np.array([capture.feature for capture in verification]) - PRINCIPAL_POINT) / 812.0
    squares = np.zeros(len(verification))
    for error in rng.multivariate_normal(np.zeros(12), accuracy.covariance, 2000):
        off_active = rng.normal(0, 1e-3 * accuracy.noise.active_joint_mrad, active.shape)
        off_passive = rng.normal(0, 1e-3 * accuracy.noise.passive_joint_mrad, passive.shape)
        T_P_E = moved(found.T_P_A, error[:6]) @ ACTIVE.forward(active + off_active) @ moved(found.T_H_E, error[6:])
        p_P = (PASSIVE.forward(passive + off_passive) @ T_F_T)[:, :3, 3:]
        p_E = (np.swapaxes(T_P_E[:, :3, :3], 1, 2) @ (p_P - T_P_E[:, :3, 3:]))[..., 0]
        # The true axis passes the feature point where it was seen; the predicted one misses it by as much as this.
        at_nominal = expected_point(found, active, passive)
        squares += np.sum((p_E - at_nominal + offset_at(offset, at_nominal))[:, :2] ** 2, axis=1)
    np.testing.assert_allclose(
        expected_mismatch(cell(), verification, found, accuracy), np.sqrt(squares / 2000), rtol=0.08
    )


def expected_point(found: Result, active: np.ndarray[Any, Any], passive: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    T_P_E = found.T_P_A @ ACTIVE.forward(active) @ found.T_H_E
    p_P = (PASSIVE.forward(passive) @ T_F_T)[:, :3, 3:]
    return (np.swapaxes(T_P_E[:, :3, :3], 1, 2) @ (p_P - T_P_E[:, :3, 3:]))[..., 0]


def offset_at(offset: np.ndarray[Any, Any], points: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return np.column_stack([offset * points[:, 2:], np.zeros(len(points))])


# -- the cell in 3D ----------------------------------------------------------------------------------------------------


def test_reached_positions_are_where_the_passive_arms_readings_say_in_mm(drawn: Figure) -> None:
    reached = points_3d(drawn, "reached: 42")
    T_P_T = PASSIVE.forward([capture.passive_joints for capture in captures().captures]) @ T_F_T
    np.testing.assert_allclose(reached, 1e3 * T_P_T[:, :3, 3], atol=1e-9)


def test_planned_positions_are_the_plans_and_the_head_says_how_far_they_were_missed(drawn: Figure) -> None:
    joints = [position.passive for constraint in plan().constraints for position in constraint.positions]
    expected = 1e3 * (PASSIVE.forward(joints) @ T_F_T)[:, :3, 3]
    np.testing.assert_allclose(points_3d(drawn, "planned: 42"), expected, atol=1e-9)
    missed = np.linalg.norm(points_3d(drawn, "reached: 42") - expected, axis=1).mean()
    assert missed > 1
    assert heads(drawn)[-1] == f"Cell in P: reached {missed:.1f} mm from planned"


def test_without_a_plan_only_reached_positions_are_drawn() -> None:
    drawn = figure(plan=None)
    assert len(points_3d(drawn, "reached: 42")) == 42
    assert heads(drawn)[-1] == "Cell in P"


def test_each_optical_axis_starts_at_the_camera_and_passes_its_reached_positions(drawn: Figure) -> None:
    axes: Any = panel(drawn, "x, mm")
    lines = [np.array(line.get_data_3d()).T for line in axes.lines]
    arrivals = {capture.constraint: capture for capture in reversed(captures().captures)}
    assert len(arrivals) == 9
    for name, capture in arrivals.items():
        T_P_E = result().T_P_A @ ACTIVE.forward(capture.active_joints) @ result().T_H_E
        (line,) = [xyz for xyz in lines if len(xyz) == 2 and np.allclose(xyz[0], 1e3 * T_P_E[:3, 3], atol=1e-6)]
        members = [c.constraint == name for c in captures().captures]
        from_camera = points_3d(drawn, "reached: 42")[members] - line[0]
        direction = (line[1] - line[0]) / np.linalg.norm(line[1] - line[0])
        assert np.linalg.norm(np.cross(from_camera, direction), axis=1).max() < 1.0
        assert np.all(from_camera @ direction < np.linalg.norm(line[1] - line[0]))


def test_the_arms_stand_as_at_the_capture_that_is_shown(drawn: Figure) -> None:
    axes: Any = panel(drawn, "x, mm")
    arms = {line.get_label(): np.array(line.get_data_3d()).T for line in axes.lines}
    flange = ACTIVE.forward(SHOWN.active_joints)
    np.testing.assert_allclose(arms["active arm (left)"][-1], 1e3 * (result().T_P_A @ flange)[:3, 3], atol=1e-9)
    np.testing.assert_allclose(arms["active arm (left)"][0], 1e3 * result().T_P_A[:3, 3], atol=1e-9)
    frames = PASSIVE.frames(SHOWN.passive_joints)
    course = arms["passive arm (right)"]
    np.testing.assert_allclose(course[1], [0.0, 0.0, 136.5], atol=1e-9)  # along the first joint's axis by its d
    for frame in frames:
        assert np.linalg.norm(course - 1e3 * frame[:3, 3], axis=1).min() < 1e-9


def test_what_the_papers_method_keeps_of_the_camera_is_called_nominal(drawn: Figure, refined: Figure) -> None:
    assert "camera, its depth and roll nominal" in legend(drawn, "Cell in P")
    assert not [words for words in legend(refined, "Cell in P") if "nominal" in words]


def test_the_scene_has_the_same_scale_in_all_directions(drawn: Figure) -> None:
    axes: Any = panel(drawn, "x, mm")
    spans = [np.ptp(limits) for limits in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())]
    scale = axes._box_aspect / np.array(spans)
    np.testing.assert_allclose(scale, scale[0])


# -- legible -----------------------------------------------------------------------------------------------------------


def _words(figure: Figure) -> list[tuple[str, Bbox]]:
    """Heads, legends, labels and texts with their extents in px; ticks are matplotlib's own care."""
    FigureCanvasAgg(figure).draw()
    found = [(text.get_text(), text.get_window_extent()) for text in figure.texts]
    for axes in figure.axes:
        legend = axes.get_legend()
        named = {"title": axes._left_title, "x": axes.xaxis.label, "y": axes.yaxis.label}  # type: ignore[attr-defined]
        found += [(text.get_text(), text.get_window_extent()) for text in named.values() if axes.axison]
        if not axes.axison:
            found.append((axes._left_title.get_text(), axes._left_title.get_window_extent()))  # type: ignore[attr-defined]
        if legend is not None and legend.get_texts():
            found.append((f"legend of {legend.get_texts()[0].get_text()}", legend.get_window_extent()))
    return [(words, box) for words, box in found if words]


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"result": replace(result(), verdict="fail", reasons=("a reason that needs many words to be told",) * 12)},
        {"result": replace(result(), mismatch_before=None, mismatch_after=None, verdict="unverified")},
        {"cell": cell().model_copy(update={"name": "assembly cell 12, $left$ station"})},
        {"captures": replace(captures(), captures=tuple(replace(c, corners=None) for c in captures().captures))},
        {"captures": noisy_captures(), "result": refined_result()},
        {"captures": noisy_captures(0.003), "result": refined_result(0.003)},
        {"captures": with_some_off()[0], "result": with_some_off()[1]},
        {
            "captures": noisy_captures(),
            "result": replace(
                refined_result(), mismatch_before=None, mismatch_after=None, verification=None, verdict="unverified"
            ),
        },
        {"captures": noisy_captures(), "result": replace(requiring(0.06), verdict="coarse")},
    ],
    ids=[
        "as it is",
        "many reasons",
        "unverified",
        "long name",
        "no corners",
        "refined",
        "refined fails",
        "refined, some left out",
        "refined, unverified",
        "refined, coarse",
    ],
)
def test_no_words_are_cut_off_or_lie_on_others(changed: dict[str, Any]) -> None:
    words = _words(figure(**changed))
    assert len(words) > 12
    for name, box in words:
        assert 0 <= box.x0 < box.x1 <= SIZE_PX[0], name
        assert 0 <= box.y0 < box.y1 <= SIZE_PX[1], name
    for (name, box), (other, other_box) in itertools.combinations(words, 2):
        assert Bbox.intersection(box, other_box) is None, f"{name!r} lies on {other!r}"
