"""The picture of a plan shows both arms, every axis and every position, from the side and from above."""

from __future__ import annotations

import numpy as np
import pytest

from dualcal_hal.transforms import Array, apply
from procedures.planning.model import CellModel
from procedures.report.plan_picture import plan_figure
from tests.cells import paper_cell
from tests.reference_cell import NOMINAL_T_P_A
from tests.reference_run import cell, plan

VIEWS = {"From the side": [0, 2], "From above": [0, 1]}  # the paper's bases stand along x


def panel(figure, title: str):  # type: ignore[no-untyped-def]
    (axes,) = [axes for axes in figure.axes if axes.get_title(loc="left") == title]
    return axes


def lines_of(figure, title: str) -> list[Array]:  # type: ignore[no-untyped-def]
    """The points (k, 2) of each line in the panel of that title, mm."""
    return [np.array(line.get_xydata()) for line in panel(figure, title).get_lines()]


def is_drawn(points: Array, lines: list[Array]) -> bool:
    return any(line.shape == points.shape and np.allclose(line, points, atol=1e-6) for line in lines)


@pytest.mark.parametrize("title", VIEWS)
def test_every_position_stands_where_the_passive_arm_brings_the_feature_point(title: str) -> None:
    lines = lines_of(plan_figure(cell(), CellModel(cell()).home, plan()), title)
    passive = cell().passive
    for constraint in plan().constraints:
        flanges = passive.chain.forward([position.passive for position in constraint.positions])
        points = 1e3 * (flanges @ passive.target_mount_transform)[:, :3, 3]
        assert is_drawn(points[:, VIEWS[title]], lines)


@pytest.mark.parametrize("title", VIEWS)
def test_every_axis_begins_at_the_camera_and_points_where_it_looks(title: str) -> None:
    lines = lines_of(plan_figure(cell(), CellModel(cell()).home, plan()), title)
    for constraint in plan().constraints:
        T_P_E = NOMINAL_T_P_A @ cell().active.chain.forward(constraint.active) @ cell().nominal.T_H_E
        camera, beyond = T_P_E[:3, 3], T_P_E[:3, 3] + 1.08 * 0.5 * T_P_E[:3, 2]
        assert is_drawn(1e3 * np.array([camera, beyond])[:, VIEWS[title]], lines)


@pytest.mark.parametrize("title", VIEWS)
def test_both_arms_stand_in_their_posture_from_base_to_flange(title: str) -> None:
    home = CellModel(cell()).home
    lines = lines_of(plan_figure(cell(), home, None), title)
    bases = [np.zeros((1, 3)), NOMINAL_T_P_A[None, :3, 3]]
    flanges = [
        cell().passive.chain.forward(home.passive)[None, :3, 3],
        apply(NOMINAL_T_P_A, cell().active.chain.forward(home.active)[None, :3, 3]),
    ]
    for base, flange in zip(bases, flanges, strict=True):
        ends = 1e3 * np.concatenate([base, flange])[:, VIEWS[title]]
        assert any(np.allclose(line[[0, -1]], ends, atol=1e-6) for line in lines)


FIXTURES = """{
  table: {in: passive_base, at: {translation_mm: [100, 0, -50], rotation_vector_deg: [0, 0, 0]},
          box_mm: [600, 800, 100]},
  post: {in: active_base, at: {translation_mm: [300, 200, 300], rotation_vector_deg: [0, 0, 0]},
         cylinder_mm: {radius: 60, length: 600}},
  wall: {in: passive_base, at: {translation_mm: [-500, 0, 500], rotation_vector_deg: [0, 90, 0]}, plane: {}},
}"""


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("table", [-200, -400, -100], [400, 400, 0]),
        ("post", [1200 - 360, -260, 0], [1200 - 240, -140, 600]),  # the active base looks back
        ("wall", [-500, -400, 100], [-500, 400, 900]),
    ],
)
@pytest.mark.parametrize("title", VIEWS)
def test_what_stands_about_the_arms_is_drawn_where_it_stands_with_its_name(title, name, low, high):
    furnished = paper_cell(f"fixtures={FIXTURES}").cell
    axes = panel(plan_figure(furnished, CellModel(furnished).home, None), title)
    outline = axes.patches[list(furnished.fixtures).index(name)].get_xy()
    across = VIEWS[title]
    np.testing.assert_allclose(outline.min(axis=0), np.array(low)[across], atol=1e-6)
    np.testing.assert_allclose(outline.max(axis=0), np.array(high)[across], atol=1e-6)
    (words,) = [text for text in axes.texts if text.get_text() == name]
    np.testing.assert_allclose(words.get_position(), (np.array(low) + high)[across] / 2, atol=1e-6)


def test_a_mesh_is_drawn_as_the_outline_of_its_hull(tmp_path):
    corners = np.array([[0, 0, 0], [300, 0, 0], [0, 300, 0], [0, 0, 600]])
    facets = [corners[[0, 2, 1]], corners[[0, 1, 3]], corners[[0, 3, 2]], corners[[1, 2, 3]]]
    vertices = ["".join(f"vertex {x} {y} {z}\n" for x, y, z in facet) for facet in facets]
    loops = "".join(f"facet normal 0 0 0\nouter loop\n{lines}endloop\nendfacet\n" for lines in vertices)
    (tmp_path / "wedge.stl").write_text(f"solid wedge\n{loops}endsolid wedge\n")
    at = "at: {translation_mm: [-700, 0, 0], rotation_vector_deg: [0, 0, 0]}"
    wedge = f"{{wedge: {{in: passive_base, {at}, mesh: {{file: {tmp_path / 'wedge.stl'}}}}}}}"
    furnished = paper_cell(f"fixtures={wedge}").cell
    axes = panel(plan_figure(furnished, CellModel(furnished).home, None), "From the side")
    outline = {tuple(map(float, np.round(point, 6))) for point in axes.patches[0].get_xy()}
    assert outline == {(-700.0, 0.0), (-400.0, 0.0), (-700.0, 600.0)}


def test_from_the_side_the_floor_is_drawn_under_each_arm_where_there_is_one():
    grounded, floating = paper_cell("floor_mm=-120").cell, paper_cell("floor_mm=null").cell
    for furnished, count in ((grounded, 2), (floating, 0)):
        figure = plan_figure(furnished, CellModel(furnished).home, None)
        assert [text.get_text() for text in panel(figure, "From the side").texts] == ["floor"] * count
        levels = [line for line in lines_of(figure, "From the side") if np.allclose(line[:, 1], -120.0)]
        assert sorted(np.mean(line[:, 0]) for line in levels) == pytest.approx([0.0, 1200.0][:count])


def test_the_title_says_what_the_plan_is_worth_and_whether_there_is_one() -> None:
    home = CellModel(cell()).home
    (text,) = plan_figure(cell(), home, plan()).texts
    assert text.get_text() == "paper  |  plan, 9 constraints, about 58 s, axes spread 0.123"
    (text,) = plan_figure(cell(), home, None).texts
    assert "no provisional plan" in text.get_text()
