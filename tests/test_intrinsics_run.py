"""`dualcal run --procedure intrinsics`: whole runs on the simulator, whose camera is not as the cell file says."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from backends.simulator.optics import true_intrinsics
from dualcal_hal.cell import Cell
from dualcal_hal.cellfile import load_cell
from dualcal_hal.errors import NotConfirmed
from dualcal_hal.session.folder import Session
from procedures.events import LooksProposed
from procedures.intrinsics import IntrinsicsProcedure
from procedures.intrinsics.estimate import NAMES, parameters
from procedures.intrinsics.procedure import ViewsProposed
from procedures.planning.model import CellModel
from tests.cells import TINY
from tests.command_line import dualcal
from tools.cli.run import execute

WRONG = (
    "simulation.errors={focal: {x_ppm: 30000, y_ppm: -30000}, principal_point: {right_px: 15, down_px: -15}, "
    "distortion_residual: {corner_px: -12}}"
)
RESULT, PATCH, PICTURE = "intrinsics.json", "intrinsics.patch.yaml", "intrinsics.png"


def run(folder, *overrides, options=()):
    sets = [part for value in (WRONG, *overrides) for part in ("--set", value)]
    return dualcal("run", TINY, "--procedure", "intrinsics", "--out", folder, *sets, *options)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A finished run; not to be changed."""
    folder = tmp_path_factory.mktemp("intrinsics") / "session"
    result = run(folder)
    assert result.exit_code == 0, result.output
    (folder / "output.txt").write_text(result.output)
    return folder


def found(folder):
    document = json.loads((folder / RESULT).read_text())
    document.pop("started")
    return document


@pytest.fixture
def interrupted(session, tmp_path):
    """The session as it was when so many steps were finished."""

    def at(steps):
        folder = tmp_path / "interrupted"
        shutil.copytree(session, folder)
        for name in (RESULT, PATCH, PICTURE):
            (folder / name).unlink()
        lines = (session / "journal.jsonl").read_bytes().splitlines(keepends=True)
        (folder / "journal.jsonl").write_bytes(b"".join(lines[: 1 + steps]))
        return folder

    return at


def test_the_true_camera_is_found_within_three_sigma(session):
    file = load_cell(TINY, (WRONG,))
    truth = parameters(true_intrinsics(file.cell.camera.intrinsics, file.simulation.errors))
    document = found(session)
    (fx, _, cx), (_, fy, cy), _ = document["camera"]["matrix"]
    value = np.array([fx, fy, cx, cy, *document["camera"]["distortion"]])
    sigma = np.array(list(document["sigma"].values()))
    assert np.all(np.abs(value - truth) <= 3 * sigma + 1e-4), dict(zip(NAMES, (value - truth) / sigma, strict=True))
    assert np.all(sigma[:4] < 1.0)
    told = parameters(file.cell.camera.intrinsics)
    assert np.all(np.abs(told - truth)[:5] > 10 * sigma[:5])  # the cell file's would not do


def test_views_reach_the_whole_image_at_several_tilts(session):
    document = found(session)
    assert document["verdict"] == "ok"
    coverage = document["coverage"]
    assert coverage["share"] >= 0.9
    assert all(coverage["outer_tenth"].values())
    assert min(coverage["views_tilted"].values()) >= 8
    assert 30 <= len(document["views"]) <= 40


def test_the_patch_is_the_camera_section_of_the_result(session):
    text = (session / PATCH).read_text()
    assert text.startswith("# The camera of cell 'tiny', by dualcal run --procedure intrinsics, begun ")
    assert "px rms per axis" in text
    assert YAML(typ="safe").load(text) == {"camera": found(session)["camera"]}
    printed = (session / "output.txt").read_text()
    assert f"--set 'camera.matrix={found(session)['camera']['matrix']}'" in printed
    assert (session / PICTURE).read_bytes().startswith(b"\x89PNG")


def test_the_image_of_each_view_is_kept(session):
    for view in found(session)["views"]:
        assert Session(session).read_image(view["id"]).shape == (384, 512)


@pytest.mark.parametrize("steps", [2, pytest.param(30, marks=pytest.mark.slow)])
def test_a_run_that_goes_on_comes_to_the_same(session, interrupted, steps):
    folder = interrupted(steps)
    result = dualcal("run", "--resume", folder)
    assert result.exit_code == 0, result.output
    assert f"{steps} steps are finished" in result.output
    assert found(folder) == found(session)


def test_a_finished_session_is_reported_again_and_nothing_is_done(session):
    before = {path: path.stat().st_mtime_ns for path in session.rglob("*")}
    result = dualcal("run", "--resume", session, "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout) == json.loads((session / RESULT).read_text())
    assert {path: path.stat().st_mtime_ns for path in session.rglob("*")} == before


def test_a_session_keeps_its_procedure(session, recorded):
    other = dualcal("run", "--resume", session, "--procedure", "calibration")
    assert (other.exit_code, "one of --procedure intrinsics" in other.stderr) == (2, True)
    other = dualcal("run", "--resume", recorded, "--procedure", "intrinsics")
    assert (other.exit_code, "one of --procedure calibration" in other.stderr) == (2, True)


def test_a_replay_comes_to_the_same_to_the_last_bit(session):
    result = dualcal("replay", session)
    assert result.exit_code == 0, result.output
    assert "the same to the last bit" in result.stdout


def test_looks_and_views_are_proposed_before_the_first_move_to_them(tmp_path):
    file = load_cell(TINY)
    session = Session.create(tmp_path / "s", file.text)
    proposed = []

    def confirm(shown, aborted):
        proposed.append(shown())
        return isinstance(proposed[-1], LooksProposed)

    with pytest.raises(NotConfirmed):
        execute(
            Cell(file),
            IntrinsicsProcedure(file.cell, CellModel(file.cell)),
            session,
            lambda event: None,
            confirm=confirm,
        )
    _, views = proposed
    assert isinstance(views, ViewsProposed)
    assert str(views).startswith(
        f"The first {views.count} views of at most {views.most}: the target all over the image"
    )
    assert views.clearance >= file.cell.procedure.clearance
    assert [key.kind for key, _ in session.journal.results()] == ["stand-off", "look", "look", "look", "plan"]


@pytest.mark.slow
def test_a_bowed_target_is_refused_without_a_patch(tmp_path):
    result = run(tmp_path / "s", "simulation.errors={flatness: {bow_mm: 8}}", options=["--no-log"])
    assert result.exit_code == 1, result.output
    assert "Verdict: refused" in result.stdout
    assert "far above the noise of corners" in " ".join(result.stdout.split())
    assert found(tmp_path / "s")["verdict"] == "refused"
    assert not (tmp_path / "s" / PATCH).exists()
    assert (tmp_path / "s" / PICTURE).exists()


@pytest.mark.parametrize(("option", "said"), [(["--dry-run"], "--dry-run shows"), (["--method", "paper"], "--method")])
def test_what_is_for_a_calibration_is_refused(tmp_path, option, said):
    result = run(tmp_path / "s", options=option)
    assert result.exit_code == 2
    assert said in result.stderr
    assert not Path(tmp_path / "s").exists()
