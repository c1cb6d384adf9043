"""Nothing stands between the camera and the target in a planned posture."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dualcal_hal.geometry import segment_distance
from dualcal_hal.transforms import apply, inverse, transform
from procedures.planning.belief import Belief
from procedures.planning.model import CellModel
from procedures.planning.sight import SIGHT_MARGIN, in_sight
from tests.cells import paper_cell
from tests.reference_cell import T_H_E, T_P_A

REFERENCE = json.loads((Path(__file__).parent / "data" / "reference-7x4.json").read_text())["captures"]


@pytest.fixture(scope="module")
def model() -> CellModel:
    return CellModel(paper_cell().cell)


def reference_postures() -> tuple[np.ndarray, np.ndarray]:
    return tuple(np.array([c[f"{role}_joints_rad"] for c in REFERENCE]) for role in ("active", "passive"))


def truly_hidden(
    model: CellModel, belief: Belief, q_a: np.ndarray, q_p: np.ndarray, points: int = 15, wrist: bool = True
) -> bool:
    """Whether a line from the lens to one of a grid of points on the plate runs through a link.

    Not one of the active arm's last two; through the passive arm's, its ``wrist``, farther than two of its radii from
    the plate.
    """
    low, high = model.board.outline.min(axis=0), model.board.outline.max(axis=0)
    grid = np.meshgrid(np.linspace(low[0], high[0], points), np.linspace(low[1], high[1], points))
    plate = np.stack([*map(np.ravel, grid), np.zeros(points**2)], axis=1)
    lens = model.camera_in_passive(q_a, belief)[:3, 3]
    seen = apply(model.target_in_passive(q_p), plate)
    back = (lens - seen) / np.linalg.norm(lens - seen, axis=1, keepdims=True)
    arms = ((model.geometry.active, belief.T_P_A, q_a), (model.geometry.passive, np.eye(4), q_p))
    for body, T_P_base, q in arms:
        segments = apply(T_P_base, body.segments(q[None])[0].reshape(-1, 3)).reshape(-1, 2, 3)
        for capsule, (frame, radius) in enumerate(zip(body.links.frame, body.links.radius, strict=True)):
            last_two = frame > body.chain.joints - 2
            if last_two and (body is model.geometry.active or not wrist):
                continue
            end = seen + 2 * radius * back if last_two else seen
            lines = np.stack([np.broadcast_to(lens, end.shape), end], axis=1)
            if segment_distance(lines, segments[capsule][None]).min() < radius:
                return True
    return False


def test_what_a_link_hides_is_not_in_sight_and_the_rest_is(model):
    q_a, q_p = reference_postures()
    truth = replace(model.nominal, T_P_A=T_P_A, T_H_E=T_H_E)
    seen = in_sight(model, q_a, q_p, truth)
    hidden = np.array([truly_hidden(model, truth, a, p) for a, p in zip(q_a, q_p, strict=True)])
    assert 3 <= hidden.sum() <= len(hidden) - 3
    assert not np.any(seen & hidden)
    # What is refused besides is hidden but for the margin.
    assert np.mean(seen[~hidden]) > 0.8


@pytest.mark.parametrize("boom", [0.08, 0.15])
def test_the_wrist_hides_a_target_on_a_boom_that_faces_it(boom):
    """The lens is 10 cm behind the flange, past the forearm."""
    mount = f"{{translation_mm: [0, 0, {1e3 * boom}], rotation_vector_deg: [180, 0, 0]}}"
    model = CellModel(paper_cell(f"robots.right.target_mount={mount}").cell)
    q_a, q_p = model.active.home, model.passive.home
    T_T_E = transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, boom + 0.1])
    T_H_E = inverse(T_P_A @ model.active.chain.forward(q_a)) @ model.target_in_passive(q_p) @ T_T_E
    belief = replace(model.nominal, T_P_A=T_P_A, T_H_E=T_H_E)
    assert not truly_hidden(model, belief, q_a, q_p, wrist=False)
    assert truly_hidden(model, belief, q_a, q_p)
    assert not in_sight(model, q_a, q_p, belief)[0]


def test_a_fixture_between_camera_and_target_hides_it(model):
    q_a, q_p = (np.array([q]) for q in (paper_cell().cell.active.home, paper_cell().cell.passive.home))
    cell = paper_cell().cell
    facing = inverse(model.camera_in_passive(q_a, model.nominal))[0] @ model.target_in_passive(q_p)[0]
    middle = model.camera_in_passive(q_a, model.nominal)[0] @ np.array([*facing[:3, 3] / 2, 1.0])
    assert in_sight(model, q_a, q_p, model.nominal)[0]
    at = ", ".join(f"{value * 1e3:.3f}" for value in middle[:3])
    pole = f"{{in: passive_base, at: {{translation_mm: [{at}], rotation_vector_deg: [0, 0, 0]}}, box_mm: [30, 30, 30]}}"
    blocked = CellModel(paper_cell(f"fixtures={{pole: {pole}}}").cell)
    assert not in_sight(blocked, q_a, q_p, blocked.nominal)[0]
    assert cell.fixtures == {}
    assert SIGHT_MARGIN > 0
