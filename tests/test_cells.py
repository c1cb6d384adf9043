"""The example cells: each can be loaded, edited with help, and says what it is for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dualcal_hal.cellfile import load_cell
from dualcal_hal.config.errors import ErrorsConfig
from dualcal_hal.transforms import inverse, vector_from_rotation
from tools.benchmarks.accuracy import run

CELLS = Path(__file__).parents[1] / "cells"
EXAMPLES = sorted(CELLS.glob("*.yaml"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_complete_and_named_as_its_file(path: Path) -> None:
    # Those over real wires are the paper's cell, and must differ from it in their devices alone.
    name = "paper" if path.stem.startswith(("paper-tcp", "paper-can")) else path.stem
    assert load_cell(path).cell.name == name


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_tells_editors_its_schema(path: Path) -> None:
    first = path.read_text().splitlines()[0]
    assert first == "# yaml-language-server: $schema=cell.schema.json"


def test_the_papers_cell_has_no_errors_but_noise() -> None:
    simulation = load_cell(CELLS / "paper.yaml").simulation
    assert simulation is not None
    assert simulation.errors == ErrorsConfig()


def test_the_papers_full_cell_has_a_rolled_camera_further_along_its_axis_and_a_lens_that_distorts() -> None:
    paper, full = (load_cell(CELLS / f"{name}.yaml") for name in ("paper", "paper-full"))
    assert paper.simulation is not None
    assert full.simulation is not None
    np.testing.assert_allclose(full.simulation.truth.T_P_A, paper.simulation.truth.T_P_A)
    moved = inverse(paper.simulation.truth.T_H_E) @ full.simulation.truth.T_H_E
    np.testing.assert_allclose(moved[:3, 3], [0, 0, 0.008], atol=1e-12)
    np.testing.assert_allclose(vector_from_rotation(moved[:3, :3]), [0, 0, np.radians(3)], atol=1e-12)
    assert full.cell.camera.intrinsics.distortion.any()


def test_the_realistic_cell_has_the_errors_that_real_cells_have() -> None:
    simulation = load_cell(CELLS / "realistic.yaml").simulation
    assert simulation is not None
    wrong = {name for name in ErrorsConfig.model_fields if name in simulation.errors.model_fields_set}
    assert wrong == {"kinematics", "target_mount", "backlash", "compliance", "mount_flex", "flatness"}


def test_the_tiny_cell_runs_and_is_verified() -> None:
    found = run(CELLS / "tiny.yaml", 1, [])
    assert found.verdict == "ok"
    assert found.given_up == 0


@pytest.mark.slow
@pytest.mark.parametrize("stepper", ["kinematic", "bullet"])
def test_the_tiny_cell_runs_with_encoders_that_report_late(stepper: str) -> None:
    settings = [f"simulation.stepper={stepper}", "simulation.errors.time_skew.delay_s=0.05"]
    assert run(CELLS / "tiny.yaml", 5, settings).verdict == "ok"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "method", "verdict"),
    [
        ("paper-full", "refined", "ok"),
        ("realistic", "paper", "ok"),  # within its limit of 3 mm
        ("realistic", "refined", "fail"),  # nothing in the file states what is wrong with its arms
    ],
)
def test_the_other_examples_run_and_are_judged_by_what_they_state(name: str, method: str, verdict: str) -> None:
    settings = ["simulation.stepper=kinematic", f"procedure.method={method}"]
    assert run(CELLS / f"{name}.yaml", 1, settings).verdict == verdict
