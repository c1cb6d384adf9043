"""Cells whose bases are as wrong as the cell file allows: planned, and carried out without touching anything."""

from __future__ import annotations

import numpy as np
import pytest

from dualcal_hal.cellfile import load_cell
from dualcal_hal.transforms import inverse, rotation_angle
from tools.benchmarks.edge_cells import BASE_ERROR, CAMERA_ERROR, edge_cell
from tools.benchmarks.safety import run

MOST_REFUSED = 1
"""Of fifteen."""


def test_an_edge_cells_errors_are_exactly_those_stated(tmp_path):
    path = tmp_path / "cell.yaml"
    for number in range(1, 6):
        path.write_text(edge_cell(number, stepper="kinematic"))
        file = load_cell(path)
        assert file.simulation is not None
        for told, truth, (translation, rotation) in (
            (file.cell.nominal.T_P_A, file.simulation.truth.T_P_A, BASE_ERROR),
            (file.cell.nominal.T_H_E, file.simulation.truth.T_H_E, CAMERA_ERROR),
        ):
            error = inverse(told) @ truth
            assert np.linalg.norm(error[:3, 3]) == pytest.approx(translation)
            assert rotation_angle(error[:3, :3], np.eye(3)) == pytest.approx(rotation)
        assert file.cell.nominal.uncertainty.translation == pytest.approx(BASE_ERROR[0])


@pytest.mark.slow
@pytest.mark.parametrize("first", [1, 16])
def test_random_cells_run_in_physics_without_contact(first):
    pytest.importorskip("pybullet")
    outcomes = [run(number, "bullet", None) for number in range(first, first + 15)]
    assert [one for one in outcomes if one.kind not in ("run", "refused")] == []
    refused = [one for one in outcomes if one.kind == "refused"]
    assert len(refused) <= MOST_REFUSED, refused
    assert all("Refused: " in one.why or "stand-off" in one.why for one in refused)
