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
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.transforms import Bbox

from dualcal_hal.camera import Image
from procedures.analysis import analyse
from procedures.report import draw_summary
from procedures.report.summary import SIZE_PX, summary_figure
from tests.reference_cell import ACTIVE, PASSIVE, T_F_T
from tests.reference_run import captures, cell, plan, result

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
    assert heads(drawn)[-1] == f"Cell in the passive base P: reached {missed:.1f} mm from planned"


def test_without_a_plan_only_reached_positions_are_drawn() -> None:
    drawn = figure(plan=None)
    assert len(points_3d(drawn, "reached: 42")) == 42
    assert heads(drawn)[-1] == "Cell in the passive base P"


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
    ],
    ids=["as it is", "many reasons", "unverified", "long name", "no corners"],
)
def test_no_words_are_cut_off_or_lie_on_others(changed: dict[str, Any]) -> None:
    words = _words(figure(**changed))
    assert len(words) > 12
    for name, box in words:
        assert 0 <= box.x0 < box.x1 <= SIZE_PX[0], name
        assert 0 <= box.y0 < box.y1 <= SIZE_PX[1], name
    for (name, box), (other, other_box) in itertools.combinations(words, 2):
        assert Bbox.intersection(box, other_box) is None, f"{name!r} lies on {other!r}"
