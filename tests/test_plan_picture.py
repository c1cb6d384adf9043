"""The picture of a plan shows both arms, every axis and every position, from the side and from above."""

from __future__ import annotations

import numpy as np
import pytest

from dualcal_hal.transforms import Array, apply
from procedures.planning.model import CellModel
from procedures.report.plan_picture import plan_figure
from tests.reference_cell import NOMINAL_T_P_A
from tests.reference_run import cell, plan

VIEWS = {"From the side": [0, 2], "From above": [0, 1]}  # the paper's bases stand along x


def lines_of(figure, title: str) -> list[Array]:  # type: ignore[no-untyped-def]
    """The points (k, 2) of each line in the panel of that title, mm."""
    (axes,) = [axes for axes in figure.axes if axes.get_title(loc="left") == title]
    return [np.array(line.get_xydata()) for line in axes.get_lines()]


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


def test_the_title_says_what_the_plan_is_worth_and_whether_there_is_one() -> None:
    home = CellModel(cell()).home
    (text,) = plan_figure(cell(), home, plan()).texts
    assert text.get_text() == "paper  |  plan, 9 constraints, about 58 s, axes spread 0.123"
    (text,) = plan_figure(cell(), home, None).texts
    assert "no provisional plan" in text.get_text()
